"""Ensemble Kalman filter: equally weighted particles, moved by a sample gain.

On linear-Gaussian models it converges to the Kalman filter at the rate 1/sqrt N. On other
models its limit is a filter whose update is linear in the measurement, so neither the belief
nor the evidence is asymptotically exact. Localisation is not implemented: the filter suits
tens of state components, not millions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor, shared_distribution_covariance
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, StepInfo, summarise
from pfbench.filter.linearisation import around_first, check_moments, mask_covariance
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import BootstrapProposal, deactivate_invalid_particles
from pfbench.filter.whitening import LOG_2PI, log_determinant
from pfbench.model.base import StateSpaceModel


class EnsembleForecast(NamedTuple):
    """Predicted ensemble and innovation in units of the noise, 0 where unobserved.

    Attributes:
        d: Differences of the members from their mean in the chart, [R, N, d].
        s: Differences of the predicted measurements divided by sqrt(N - 1), [R, N, k]. S'S is
            their sample covariance.
        r: Measurement minus its mean prediction, [R, k].
        values: Eigenvalues of S'S, [R, k].
        vectors: Eigenvectors of S'S, [R, k, k].
    """

    d: Tensor
    s: Tensor
    r: Tensor
    values: Tensor
    vectors: Tensor

    def compute_gain(self) -> Tensor:
        """Compute the transposed sample Kalman gain for whitened measurements [R, k, d]."""
        inverse = self.vectors / (1.0 + self.values).unsqueeze(-2) @ self.vectors.mT
        return inverse @ (self.s.mT @ self.d) / math.sqrt(self.d.shape[1] - 1)


class EnsembleUpdate(Protocol):
    """Update of the ensemble by a measurement."""

    def __call__(self, forecast: EnsembleForecast, draws: RandomStream) -> Tensor:
        """Return the differences of the updated members from the predicted mean, [R, N, d].

        Args:
            forecast: Predicted ensemble and innovation.
            draws: Random stream of the step.
        """


@dataclass(frozen=True)
class PerturbedObservationUpdate(EnsembleUpdate):
    """Update each member with a different perturbed measurement.

    x + K (y + e - h(x)), e ~ N(0, R), with the model's R. The errors e are not replaced by their sample
    covariance. [ours]

    Attributes:
        centred: Subtract the mean of the errors e, so that the mean of the ensemble moves without them. The factor
            sqrt(N / (N - 1)) keeps the covariance R of each.

    References:
        Burgers, van Leeuwen and Evensen 1998, Analysis scheme in the ensemble Kalman filter.
    """

    centred: bool = False

    @override
    def __call__(self, forecast: EnsembleForecast, draws: RandomStream) -> Tensor:
        n, k = forecast.s.shape[1:]
        e = draws.normal("perturbed", n, k).to(forecast.s)
        if self.centred:
            e = math.sqrt(n / (n - 1)) * (e - e.mean(1, keepdim=True))
        return (
            forecast.d
            + (forecast.r.unsqueeze(1) + e - math.sqrt(n - 1) * forecast.s)
            @ forecast.compute_gain()
        )


@dataclass(frozen=True)
class EnsembleTransformUpdate(EnsembleUpdate):
    """Update the mean by the gain and the differences by T = (I + S S')^-1/2.

    Without random numbers, unless it rotates. The result is the Kalman update of the ensemble's mean and covariance
    [Bishop, Etherton and Majumdar 2001]. T is the symmetric root, since other roots shift the mean
    [Wang, Bishop and Julier 2004]. T follows from the k x k matrix S'S = V diag(l) V':
    T = I - S V diag(1 / (q^2 + q)) V' S' with q^2 = 1 + l. [ours]

    Attributes:
        rotates: Multiply the updated differences by a uniform random orthogonal matrix that keeps their mean and
            covariance. Without it a nonlinear model drives one member far away from all others.

    References:
        Bishop, Etherton and Majumdar 2001, Adaptive sampling with the ensemble transform Kalman
        filter. Sakov and Oke 2008, Implications of the form of the ensemble transformation in the ensemble square
        root filters.
    """

    rotates: bool = False

    @override
    def __call__(self, forecast: EnsembleForecast, draws: RandomStream) -> Tensor:
        d, s, r, values, vectors = forecast
        q2 = 1.0 + values
        shrink = vectors / (q2 + q2.sqrt()).unsqueeze(-2) @ vectors.mT
        d = d - s @ (shrink @ (s.mT @ d))
        d = _rotate(d, draws) if self.rotates else d
        return d + r.unsqueeze(1) @ forecast.compute_gain()


def _rotate(d: Tensor, draws: RandomStream) -> Tensor:
    """Multiply differences [R, N, d] by a random orthogonal matrix that keeps vectors of equal components.

    It is uniform. Only its product with the left singular vectors is drawn, an orthonormal frame across equal components.
    That is Q of a normal matrix with the signs of the diagonal of its R.
    """
    mean, k = d.mean(1, keepdim=True), min(d.shape[1] - 1, d.shape[2])
    _, values, right = torch.linalg.svd(d - mean, full_matrices=False)
    z = draws.normal("rotation", d.shape[1], k).to(d)
    frame, upper = torch.linalg.qr(z - z.mean(1, keepdim=True))
    signs = torch.where(upper.diagonal(dim1=-2, dim2=-1) < 0.0, -1.0, 1.0)
    return mean + frame @ ((signs * values[:, :k]).unsqueeze(-1) * right[:, :k])


@dataclass(frozen=True)
class EnsembleKalmanFilter:
    """Particle ensemble that is propagated and then moved by its sample Kalman gain.

    The belief is a set of particles of equal weight. The evidence is the normal density of each
    measurement under the mean and covariance of the predicted ensemble. The measurement noise is
    the mean over the members, approximated as normal. If only the noise depends on the state
    (stochastic volatility), the ensemble is not updated. Covariances divide by N - 1. A non-finite
    member is reset to its previous state. [ours]

    Attributes:
        particles: N, the number of members.
        update: PerturbedObservationUpdate or EnsembleTransformUpdate.
        inflation: Factor on the predicted differences from the mean, against sampling error in
            the covariance [Anderson and Anderson 1999]. 1 means no inflation.
        inflates_update: Apply the factor to the updated differences instead, before the next prediction, where
            something is measured. In a linear model measured in each step, without process noise, that is
            the same.

    Raises:
        ValueError: If there are fewer than two members or the inflation is not positive.
    """

    particles: int
    update: EnsembleUpdate = field(default_factory=PerturbedObservationUpdate)
    inflation: float = 1.0
    inflates_update: bool = False
    is_exact = False  # exact in the limit on linear-Gaussian models only

    def __post_init__(self) -> None:
        require_ranges(
            "filter",
            self,
            particles="[2, inf] A sample covariance requires 2 members.",
            inflation="(0, inf) Use 1 for no inflation.",
        )

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        """Draw N members from the initial distribution, as a particle filter does.

        Args:
            model: State-space model.
            runs: Number of runs.
            draws: Random numbers of the initial step.
            start: States about which the distribution is centred, [R, D]. None takes the origin.
            spread: Cholesky factors of the initial covariance, [R, d, d]. None takes the model's.
        """
        return ParticleFilter(self.particles).init(model, runs, draws, start, spread)

    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Advance the ensemble from t-1 to t, with equal weights.

        Args:
            model: State-space model.
            belief: Ensemble at t-1.
            record: Record of step t.
            draws: Random numbers of step t.
        """
        chart, n = model.chart, self.particles
        x, _ = deactivate_invalid_particles(
            BootstrapProposal()(model, belief, record, draws).x, belief.log_w, belief.x
        )
        mean = chart.mean(x, torch.full_like(belief.log_w, 1.0 / n)).unsqueeze(1)
        factors = (1.0, self.inflation) if self.inflates_update else (self.inflation, 1.0)
        d = factors[0] * chart.subtract(x, mean)
        x = chart.add(mean, d) if factors[0] != 1.0 else x
        forecast, log_like = _forecast(model, x, d, record)
        along = (forecast.r.unsqueeze(-2) @ forecast.vectors).squeeze(-2)
        updated = self.update(forecast, draws)
        updated = torch.lerp(updated.mean(1, keepdim=True), updated, factors[1])
        d = torch.where(record.y.isnan().all(-1, keepdim=True).unsqueeze(-1), d, updated)
        updated_x = chart.add(mean, d)
        valid_mask = torch.isfinite(log_like) & torch.isfinite(updated_x).all(-1).all(-1)
        # a lost run has evidence -inf from here on; it continues from its prediction to stay finite
        log_z = belief.log_evidence + torch.where(valid_mask, log_like, -torch.inf)
        cloud = belief._replace(
            x=torch.where(valid_mask[:, None, None], updated_x, x), log_evidence=log_z
        )
        info = summarise(model, cloud, {})
        bessel = n / (n - 1)
        return cloud, info._replace(
            variance=bessel * info.variance,
            covariance=lambda: bessel * info.covariance(),
            group_covariance=lambda groups: bessel * info.covariance_of(groups),
            nis=lambda: (
                (along.square() / (1.0 + forecast.values)).sum(-1),
                (~torch.isnan(record.y)).sum(1),
            ),
        )


def _forecast(
    model: StateSpaceModel, x: Tensor, d: Tensor, record: Record
) -> tuple[EnsembleForecast, Tensor]:
    """Build the forecast and the log density [R] of y, NaN without a noise root."""
    distribution: Any = model.observation(x, record.u)
    n = x.shape[1]
    equal_weights = d.new_full(d.shape[:2], 1.0 / n)
    check_moments(model, "observation", distribution)
    y_hat = around_first(model.residual)(distribution.mean, equal_weights)
    observed_mask = ~torch.isnan(record.y)
    r = torch.where(observed_mask, model.residual(record.y.nan_to_num(), y_hat), 0.0)
    s = torch.where(
        observed_mask.unsqueeze(1), model.residual(distribution.mean, y_hat.unsqueeze(1)), 0.0
    )
    root, ok = factor(
        mask_covariance(shared_distribution_covariance(distribution).mean(1), observed_mask)
    )
    white = torch.linalg.solve_triangular(
        root, torch.cat([s.mT / math.sqrt(n - 1), r.unsqueeze(-1)], -1), upper=False
    )
    s, r = white[..., :-1].mT, white[..., -1]
    product = torch.where(torch.isfinite(s).all(1).all(-1)[:, None, None], s.mT @ s, torch.nan)
    # eigh raises for the whole batch if one run is not finite
    values, vectors = torch.linalg.eigh(torch.nan_to_num(product, 0.0, 0.0, 0.0))
    values = values.clamp(min=0.0)
    along = (r.unsqueeze(-2) @ vectors).squeeze(-2)
    scale = log_determinant(root) + 0.5 * values.log1p().sum(-1)
    observed_count = observed_mask.sum(-1, dtype=r.dtype)
    log_like = (
        -0.5 * (along.square() / (1.0 + values)).sum(-1) - scale - 0.5 * LOG_2PI * observed_count
    )
    ok = ok & torch.isfinite(product).all(-1).all(-1)
    return EnsembleForecast(d, s, r, values, vectors), torch.where(ok, log_like, torch.nan)
