"""Gaussian filter: prediction and update of Kalman, extended, unscented and cubature filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.core.covariance import (
    distribution_covariance,
    factor,
    shared_distribution_covariance,
    squared_length,
)
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    DifferenceSpace,
    LinearisationRule,
)
from pfbench.filter.linearisation import check_moments, compute_additive_gain
from pfbench.filter.whitening import LOG_2PI
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable
from pfbench.model.base import StateSpaceModel, initial_law


class Innovation(NamedTuple):
    """Innovation r = M xi + e with unknown xi ~ N(0, I), Cov e = Omega.

    Attributes:
        r: y - y_hat, [R, k]; 0 for missing components.
        observed_mask: Observed components, bool [R, k].
        m: M, [R, k, d].
        omega: Omega, [R, k, k]: measurement noise in use and linearisation error.
        noise: Measurement noise in use, [R, k, k]; 1 for missing components.
        nominal: Measurement noise of the model, all components, [R, k, k].
        root: Root of the predicted covariance, by which xi is whitened, [R, d, d].
    """

    r: Tensor
    observed_mask: Tensor
    m: Tensor
    omega: Tensor
    noise: Tensor = torch.zeros(())
    nominal: Tensor = torch.zeros(())
    root: Tensor = torch.zeros(())

    @property
    def predicted_covariance(self) -> Tensor:
        """Covariance of y_hat due to the predicted state, [R, k, k]."""
        return self.m @ self.m.mT + (self.omega - self.noise)

    def nis(self) -> tuple[Tensor, Tensor]:
        """Compute the normalised innovation squared and the number of observed components, [R]."""
        return squared_length(self.r, self.m @ self.m.mT + self.omega), self.observed_mask.sum(1)

    def with_noise(self, noise: Tensor) -> Innovation:
        """Replace the measurement noise [R, k, k]; missing components keep 1."""
        noise = torch.where(
            self.observed_mask.unsqueeze(-1) & self.observed_mask.unsqueeze(-2), noise, self.noise
        )
        return self._replace(omega=self.omega + (noise - self.noise), noise=noise)

    def inflate(self, factor: Tensor) -> Innovation:
        """Multiply the predicted covariance by `factor` [R]."""
        f = factor[:, None, None]
        omega = self.omega + (f - 1.0) * (self.omega - self.noise)
        return self._replace(m=self.m * f.sqrt(), omega=omega, root=self.root * f.sqrt())


class NoiseAdaptation(Protocol):
    """A change of the filter's noise covariances; both hooks may be the identity.

    predict_scale: scales the linearised prediction. Its Omega contains the process noise `noise`.
        If the noise passed through the rule, the columns of M beyond the state's contain it.
    noise_adapt: returns the innovation with another noise covariance, and values for the next step
        by name, [R, ...].
    """

    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation: ...

    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]: ...


class GainAdaptation(Protocol):
    """A change of the gain: it maps the factor on the predicted covariance [R] to a new one."""

    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor: ...


class GaussianStep(NamedTuple):
    """All results of one step, for stages that use a Gaussian filter.

    Attributes:
        prior: Predicted mean, [R, D].
        prior_root: Square root of the predicted covariance after adaptation, [R, d, d].
        mean: Updated mean, [R, D].
        root: Square root of the updated covariance, [R, d, d], not triangular.
        innovation: Innovation after adaptation; `noise` is the measurement noise in use.
        log_likelihood: Log evidence of the step, [R]; -inf if a covariance has no root.
        memory: Values that adaptations use in the next step.
        trace: Diagnostics by name, [R].
    """

    prior: Tensor
    prior_root: Tensor
    mean: Tensor
    root: Tensor
    innovation: Innovation
    log_likelihood: Tensor
    memory: dict[str, Tensor]
    trace: dict[str, Tensor]


@dataclass(frozen=True)
class GaussianFilter:
    """Kalman filter by statistical linearisation.

    The update is P+ = L (I + M' Omega^-1 M)^-1 L'. The eigenvalues of the middle factor are at
    least 1, so P+ is positive for any prior, however ill-conditioned. A covariance without a square
    root marks the run as lost.

    Initial, noise and observation distributions need finite means and variances. A model without
    `noise_gain` is probed for additive noise, see `additive_gain`.

    Attributes:
        linearisation: TaylorLinearisation (EKF), or SigmaPointLinearisation (unscented and cubature filters).
        noise_adaptations: Noise adaptations in order: fading, constrained noise.
        gain_adaptations: Gain adaptations in order, applied last: adaptive factor, ratio bound.
        iterations: Number of updates, fixed for all runs [ours]. Each linearises the measurement
            about the updated distribution. With the Jacobian this is the iterated EKF,
            Gauss-Newton [Bell and Cathey 1993]. With points it is iterated posterior linearisation
            [Garcia-Fernandez et al. 2015].
        repair_covariance: Whether to remove negative eigenvalues from the linearisation error [ours]. A rule
            with negative weights can cause them. The trace counts `repairs`. Otherwise the run is
            lost.

    Raises:
        ValueError: if iterations is below 1, or above 1 with adaptations or gains, which evaluate
            the first innovation; on use, if a distribution has no finite mean and variance.
    """

    linearisation: LinearisationRule
    noise_adaptations: Sequence[NoiseAdaptation] = ()
    gain_adaptations: Sequence[GainAdaptation] = ()
    iterations: int = 1
    repair_covariance: bool = False
    is_exact = False  # it is exact on linear-Gaussian models only

    @property
    def plain(self) -> bool:
        """Whether the filter has no adaptations and gains: Kalman filter on linear models."""
        return not self.noise_adaptations and not self.gain_adaptations

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(
                f"filter.iterations must be at least 1, got {self.iterations}. Use 1 for a single "
                "update."
            )
        if self.iterations > 1 and (self.noise_adaptations or self.gain_adaptations):
            raise ValueError(
                "filter.iterations must be 1 with noise_adaptations or gain_adaptations, got "
                f"{self.iterations}. Set filter.iterations=1."
            )

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        """Compute the belief at step 0, the moments of the initial distribution.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream, not used.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            The belief.

        Raises:
            ValueError: if the initial or the noise distribution has no finite mean and variance.
        """
        law: Any = initial_law(model, runs, spread)
        for name, distribution in (("initial", law), ("noise", model.noise)):
            check_moments(model, name, distribution)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean = model.chart.add(origin, law.mean)
        log_z = torch.zeros(runs, dtype=torch.float64, device=mean.device)
        return GaussianBelief(mean, distribution_covariance(law), log_z)

    def step(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record, draws: RandomStream
    ) -> tuple[GaussianBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            seen: Measurement and inputs of step t.
            draws: Random stream, not used.

        Returns:
            Belief at t and diagnostics.
        """
        new = self.advance(model, belief, record)
        covariance = new.root @ new.root.mT
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        info = StepInfo(new.mean, variance, lambda: covariance, new.trace, nis=new.innovation.nis)
        log_z = belief.log_evidence + new.log_likelihood
        return GaussianBelief(new.mean, covariance, log_z, new.memory), info

    def advance(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record
    ) -> GaussianStep:
        """Compute a step with all intermediate results.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            seen: Measurement and inputs of step t.

        Returns:
            The results.
        """
        memory: dict[str, Tensor] = {}
        predicted, rooted = self.predict(model, belief, record.u)
        for adaptation in self.noise_adaptations:
            predicted = adaptation.predict_scale(predicted, belief)
        covariance = predicted.m @ predicted.m.mT
        omega, repaired = self._repaired(predicted.omega, predicted.noise, covariance)
        root, positive = factor(covariance + omega)

        def place(xi: Tensor) -> Tensor:
            return model.chart.add(predicted.y.unsqueeze(1), xi @ root.mT)

        innovation = self._innovate(model, place, predicted.y, record)._replace(root=root)
        for adaptation in self.noise_adaptations:
            innovation, carried = adaptation.noise_adapt(innovation, belief)
            memory |= carried
        trace = {
            name: value if value.dim() == 1 else value.amax(1)
            for name, value in memory.items()
            if value.dim() <= 2
        }
        if self.gain_adaptations:
            widening = torch.ones_like(belief.mean[:, 0])
            for gain in self.gain_adaptations:
                widening = gain(innovation, widening)
            innovation, trace["widening"] = innovation.inflate(widening), widening
        prior = predicted.y
        shift, updated, log_like, repaired_update, innovation = self._update(
            model, prior, innovation, record
        )
        if self.repair_covariance:
            trace["repairs"] = repaired.to(root) + repaired_update.to(root)
        mean = model.chart.add(prior, (innovation.root @ shift.unsqueeze(-1)).squeeze(-1))
        log_like = torch.where(rooted & positive & torch.isfinite(log_like), log_like, -torch.inf)
        root = innovation.root
        return GaussianStep(prior, root, mean, root @ updated, innovation, log_like, memory, trace)

    def predict(
        self, model: StateSpaceModel, belief: GaussianBelief, u: Any
    ) -> tuple[AffineApproximation, Tensor]:
        """Linearise the propagation in coordinates whitened by the belief's root.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            u: Inputs of the step.

        Returns:
            Linearised prediction, and whether the covariance has a root, bool [R].
        """
        chart, d = model.chart, model.chart.dimension
        root, ok = factor(belief.covariance)
        law = model.noise
        gain = compute_additive_gain(model, belief.mean, root, u)
        inner = 0 if gain is not None else model.noise_dim

        def propagate_points(xi: Tensor) -> tuple[Tensor, Tensor]:
            x = chart.add(belief.mean.unsqueeze(1), xi[..., :d] @ root.mT)
            if gain is None:
                w = law.mean + law.stddev * xi[..., d:]
                return model.propagate(x, u, w), xi.new_zeros(1, 1, d, d)
            sized = gain * law.stddev
            x = model.propagate(x, u, law.mean.expand(*x.shape[:2], -1))
            return x, (sized @ sized.mT).unsqueeze(1)

        space = DifferenceSpace(chart.subtract, chart.mean)
        return self.linearisation(propagate_points, belief.mean, d + inner, space), ok

    def _innovate(
        self,
        model: StateSpaceModel,
        place: Callable[[Tensor], Tensor],
        template: Tensor,
        record: Record,
    ) -> Innovation:
        """Compute the innovation for states place(xi), xi [R, P, d]."""

        def observe_points(xi: Tensor) -> tuple[Tensor, Tensor]:
            law: Any = model.observation(place(xi), record.u)
            check_moments(model, "observation", law)
            return law.mean, shared_distribution_covariance(law)

        space = DifferenceSpace(model.residual, around_first(model.residual))
        y_hat, m, omega, noise = self.linearisation(
            observe_points, template, model.chart.dimension, space
        )
        observed_mask = ~torch.isnan(record.y)
        r = torch.where(observed_mask, model.residual(record.y, y_hat), 0.0)
        pair_mask = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
        eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
        m = torch.where(observed_mask.unsqueeze(-1), m, 0.0)
        omega, noise_in_use = (torch.where(pair_mask, a, eye) for a in (omega, noise))
        return Innovation(r, observed_mask, m, omega, noise_in_use, noise)

    def _update(
        self, model: StateSpaceModel, mean: Tensor, innovation: Innovation, record: Record
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Innovation]:
        """Compute `update`, which runs were repaired [R], and the last innovation."""
        innovation, repaired = self._positive(innovation)
        shift, updated, log_like = kalman_gain_update(innovation)
        for _ in range(self.iterations - 1):
            again = self._innovate_posterior(model, mean, innovation.root, shift, updated, record)
            innovation, repaired_again = self._positive(again)
            shift, updated, log_like = kalman_gain_update(innovation)
            repaired = repaired | repaired_again
        return shift, updated, log_like, repaired, innovation

    def _innovate_posterior(
        self,
        model: StateSpaceModel,
        mean: Tensor,
        root: Tensor,
        shift: Tensor,
        updated: Tensor,
        record: Record,
    ) -> Innovation:
        """Linearise about the updated N(shift, updated updated') of xi, in the same coordinates."""

        def place(xi: Tensor) -> Tensor:
            whitened = shift.unsqueeze(1) + xi @ updated.mT
            return model.chart.add(mean.unsqueeze(1), whitened @ root.mT)

        again = self._innovate(model, place, mean, record)
        m = torch.linalg.solve_triangular(updated, again.m, upper=True, left=False)
        return again._replace(m=m, r=again.r + (m @ shift.unsqueeze(-1)).squeeze(-1), root=root)

    def _positive(self, innovation: Innovation) -> tuple[Innovation, Tensor]:
        # Omega alone must be positive: the update takes its root, not that of M M' + Omega
        zero = torch.zeros_like(innovation.omega)
        omega, repaired = self._repaired(innovation.omega, innovation.noise, zero)
        return innovation._replace(omega=omega), repaired

    def _repaired(self, omega: Tensor, noise: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Return Omega such that Omega + rest has a root, and which runs were changed [R]."""
        if not self.repair_covariance:
            return omega, omega.new_zeros(len(omega), dtype=torch.bool)
        bad = ~factor(rest + omega)[1]
        if not bad.is_cuda and not bool(bad.any()):  # the check costs next to nothing on the CPU
            return omega, bad
        variance = omega.diagonal(dim1=-2, dim2=-1).abs() + rest.diagonal(dim1=-2, dim2=-1)
        size = torch.sqrt(variance.clamp(min=1e-300))
        scale = size.unsqueeze(-1) * size.unsqueeze(-2)
        excess = (omega - noise) / scale
        # eigh raises for all runs if the numbers of one run are not finite
        finite_mask = torch.isfinite(excess).all(-1).all(-1)[:, None, None]
        values, vectors = torch.linalg.eigh(torch.where(finite_mask, excess, 0.0))
        excess = (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT
        return torch.where(bad[:, None, None] & finite_mask, noise + excess * scale, omega), bad


def kalman_gain_update(innovation: Innovation) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the whitened posterior.

    Args:
        innovation: Innovation of the step.

    Returns:
        Mean [R, d], square root [R, d, d] and log evidence of the step [R], NaN without a root.
    """
    r, seen, m, omega, *_ = innovation
    shift, root, distance, scales, ok = _updated(m, r, omega)
    count = seen.sum(-1, dtype=r.dtype)  # int64 times a float would be float32
    log_like = -0.5 * distance - scales.abs().log().sum(-1) - 0.5 * LOG_2PI * count
    return shift, root, torch.where(ok, log_like, torch.nan)


def _separate_update(
    m: Tensor, r: Tensor, omega: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Compute what native.updated computes, by separate operations."""
    root, ok = factor(omega)
    columns = torch.cat([m, r.unsqueeze(-1)], -1)
    white = torch.linalg.solve_triangular(root, columns, upper=False)  # Omega^-1/2 [M r]
    d = m.shape[-1]
    eye = torch.eye(d, dtype=m.dtype, device=m.device).expand(m.shape[0], -1, -1)
    information, score, distance = _least_squares(white, eye)
    back = torch.linalg.solve_triangular(information, torch.cat([score, eye], -1), upper=True)
    scales = torch.cat([part.diagonal(dim1=-2, dim2=-1) for part in (root, information)], -1)
    return back[..., 0], back[..., 1:], distance, scales, ok


_updated = compilable(_separate_update, operator=cpp.kalman_update, use_torch_compiler=False)


def _least_squares(white: Tensor, eye: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Minimise |A x - b|^2 + |x|^2, [A b] = `white`: R of I + A' A, R'^-1 A' b, the minimum [R].

    By QR: I + A' A would lose the 1 if the prior is 1e8 times as wide as the measurement noise.
    """
    d = eye.shape[-1]
    if not (white.requires_grad and torch.is_grad_enabled()):
        upper, least = _triangle(white)
        return upper[..., :d], upper[..., d:], least
    # a gradient needs Q, and a triangle without zeros on its diagonal, where y may equal y_hat
    a, b = white[..., :d], white[..., d:]
    q, information = torch.linalg.qr(torch.cat([a, eye], -2))
    score = q[:, : a.shape[-2]].mT @ b
    diagonal = information.diagonal(dim1=-2, dim2=-1)
    sign = torch.where(diagonal < 0, -1, 1).to(information).unsqueeze(-1)
    information, score = sign * information, sign * score
    x = torch.linalg.solve_triangular(information, score, upper=True)
    return information, score, (a @ x - b).square().sum((1, 2)) + x.square().sum((1, 2))


def _triangle(white: Tensor) -> tuple[Tensor, Tensor]:
    """Reduce [A b] [R, K, D + 1] over [I 0] to a triangle [R, D, D + 1], and the rest of b^2."""
    d = white.shape[-1] - 1
    eye = torch.eye(d, d + 1, dtype=white.dtype, device=white.device)
    rows = torch.cat([white, eye.expand(white.shape[0], -1, -1)], -2)
    triangle = torch.linalg.qr(rows, mode="r")[1]
    # QR leaves row signs to rounding: draws by such a root would depend on the batch
    diagonal = triangle.diagonal(dim1=-2, dim2=-1)[:, :d]
    sign = torch.where(diagonal < 0, -1, 1).to(triangle).unsqueeze(-1)
    return sign * triangle[:, :d], triangle[:, d, d].square()


def around_first(
    residual: Callable[[Tensor, Tensor], Tensor],
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a weighted mean of values that may wrap: the mean of residuals to the first value."""

    def mean(y: Tensor, w: Tensor) -> Tensor:
        return y[:, 0] + (w.unsqueeze(-1) * residual(y, y[:, :1])).sum(1)

    return mean
