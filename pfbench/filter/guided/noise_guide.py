"""Proposal of each particle's noise by the rule of a Gaussian filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance, factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation, DifferenceSpace
from pfbench.filter.guided.guides import FACTOR_RULE, check_normal_guide
from pfbench.filter.linearisation import (
    around_first,
    mask_covariance,
    mean_noise,
    unwrap_independent,
)
from pfbench.filter.particle.proposals import (
    choose_defensive_particles,
    draw_standardised_noise,
    log_noise_density,
    log_standard_normal,
    scale_noise,
)
from pfbench.filter.particle.stages import IidPoints, PointSet, Proposal, ProposalSample
from pfbench.filter.whitening import log_determinant
from pfbench.model.base import StateSpaceModel


class NoisePosterior(NamedTuple):
    """Normal distribution of the standardised noise, xi = U (shift + scale z) with z ~ N(0, I).

    Attributes:
        lower: Transposed inverse of U, lower triangular, [R, 1 or N, W, W].
        root: U, [R, 1 or N, W, W].
        shift: [R, 1, W, N] if all particles of a run share U, else [R, N, W, 1].
        scale: Root of the covariance factor.
        log_det: log |det scale U|, [R, 1 or N].
    """

    lower: Tensor
    root: Tensor
    shift: Tensor
    scale: float
    log_det: Tensor

    def from_standard(self, z: Tensor) -> Tensor:
        """Map standard normal numbers [R, N, W] to standardised noise [R, N, W]."""
        return self._as_rows(self.root @ (self.shift + self.scale * self._as_columns(z)))

    def to_standard(self, xi: Tensor) -> Tensor:
        """Map standardised noise [R, N, W] to standard normal numbers [R, N, W]."""
        return self._as_rows((self.lower.mT @ self._as_columns(xi) - self.shift) / self.scale)

    # with a common U the particles of a run are columns of one matrix, else one matrix per particle
    def _as_columns(self, a: Tensor) -> Tensor:
        return a.mT.unsqueeze(1) if self._is_shared else a.unsqueeze(-1)

    def _as_rows(self, a: Tensor) -> Tensor:
        return a.squeeze(1).mT if self._is_shared else a.squeeze(-1)

    @property
    def _is_shared(self) -> bool:
        return self.root.shape[1] == 1


@dataclass(frozen=True)
class GuidedNoiseProposal(Proposal):
    """Draw each particle's noise from its approximate Gaussian posterior.

    y = h(f(parent, w)) + v is linearised in w by the guide's rule. The proposal is
    w ~ N(m, U U') and the ratio p(w) / q(w), which does not need a transition density. On
    linear-Gaussian models it is the optimal proposal [Doucet, Godsill, Andrieu 2000]. On others it
    may miss a part of the posterior, where p / q is unbounded. Some particles are therefore drawn
    from the model, and q is the density of the mixture [Hesterberg 1995].

    Attributes:
        guide_filter: Gaussian filter whose rule linearises. It starts from each parent and
            therefore takes no adaptations.
        shared_by_particles: Linearise once per run, about the weighted mean without noise, instead
            of once per particle. The ratio corrects any proposal, so exactness does not change.
            Linear models always share.
        covariance_factor: Factor on the proposal covariance. Values above 1 protect against an
            overconfident proposal.
        points: Source of z.
        defensive_fraction: Fraction c of the particles that are drawn from the model's noise, in
            [0, 1). A ratio is then at most 1 / c. 0 is as published, without a bound.

    Raises:
        ValueError: If the guide has adaptations, gains or iterations, the factor is not
            positive, or the fraction is outside [0, 1).
    """

    guide_filter: GaussianFilter
    shared_by_particles: bool = False
    covariance_factor: float = 1.0
    points: PointSet = field(default_factory=IidPoints)
    defensive_fraction: float = 0.1
    is_exact = True

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges(
            "proposal",
            self,
            defensive_fraction="[0, 1) Use BootstrapProposal for 1.",
            covariance_factor=FACTOR_RULE,
        )
        check_normal_guide(self.guide_filter)
        require(
            not self.guide_filter.noise_adaptations
            and not self.guide_filter.gain_adaptations
            and self.guide_filter.iterations <= 1,
            "proposal.guide_filter",
            "have a linearisation only",
            "adaptations, gains or iterations",
            "Remove adaptations, gains and iterations.",
        )

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        z = self.points(draws).normal("guide", belief.x.shape[1], model.noise_dim)
        posterior = self.fit_posterior(model, belief, record)
        xi = posterior.from_standard(z)
        selection = None
        if self.defensive_fraction > 0.0:
            active_mask = belief.log_w > -torch.inf
            selection = choose_defensive_particles(
                self.defensive_fraction, active_mask, draws, "guide.kept"
            )
            mask, prior_xi = selection.mask.unsqueeze(-1), draw_standardised_noise(model, z, draws)
            xi = torch.where(mask, prior_xi, xi)
            z = torch.where(mask, posterior.to_standard(prior_xi), z)
        w = scale_noise(model, xi)
        log_q = log_standard_normal(z) - posterior.log_det
        log_ratio = log_noise_density(model, w, xi) - log_q
        if selection is not None:
            log_ratio = selection.bound_log_ratio(log_ratio)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)

    def fit_posterior(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record
    ) -> NoisePosterior:
        """Fit a normal distribution to the posterior of the standardised noise.

        Args:
            model: State-space model.
            belief: Particles at t-1.
            record: Record of step t.

        Returns:
            The distribution, that of the model where it cannot be fitted.
        """
        shared = self.shared_by_particles or model.linear
        x = (
            model.chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
            if shared
            else belief.x
        )
        y_hat, m, omega = (
            a.unflatten(0, x.shape[:2]) for a in self._linearised(model, x, record.u)[:3]
        )
        if shared:
            y_hat = model.observation(
                model.propagate(belief.x, record.u, mean_noise(model, belief.x)), record.u
            ).mean
        observed_mask = ~torch.isnan(record.y).unsqueeze(1)  # [R, 1, k]
        r = torch.where(observed_mask, model.residual(record.y.unsqueeze(1), y_hat), 0.0)
        noise_root, ok = factor(mask_covariance(omega.to(r), observed_mask))
        white = torch.linalg.solve_triangular(
            noise_root, torch.where(observed_mask.unsqueeze(-1), m, 0.0), upper=False
        )
        r = r.mT.unsqueeze(1) if shared else r.unsqueeze(-1)
        score = white.mT @ torch.linalg.solve_triangular(noise_root, r, upper=False)
        # the information matrix is cheaper than QR, and the ratio includes its rounding errors
        eye = torch.eye(m.shape[-1], dtype=r.dtype, device=r.device)
        lower, info = torch.linalg.cholesky_ex(eye + white.mT @ white)
        ok = (ok & (info == 0) & torch.isfinite(score).all(-1).all(-1))[..., None, None]
        lower = torch.where(ok, lower, eye)  # not ok: the prior, which is also exact
        root = torch.linalg.solve_triangular(lower.mT, eye.expand_as(lower), upper=True)
        log_det = log_determinant(root) + 0.5 * len(eye) * math.log(self.covariance_factor)
        shift = root.mT @ torch.where(ok, score, 0.0)
        return NoisePosterior(lower, root, shift, math.sqrt(self.covariance_factor), log_det)

    def _linearised(self, model: StateSpaceModel, x: Tensor, u: Any) -> AffineApproximation:
        """Linearise the measurement of a child of each x [R, M, D] in its whitened noise."""
        centre, scale = model.noise.mean, model.noise.stddev

        def predict(xi: Tensor) -> tuple[Tensor, Tensor]:
            w = (centre + scale * xi).reshape(len(x), -1, xi.shape[-1])
            distribution = model.observation(
                model.propagate(x.repeat_interleave(xi.shape[1], 1), u, w), u
            )
            return distribution.mean.reshape(*xi.shape[:2], -1), _covariances(
                distribution, xi.shape
            )

        space = DifferenceSpace(model.residual, around_first(model.residual))
        return self.guide_filter.linearisation(predict, x.flatten(0, 1), model.noise_dim, space)


def _covariances(distribution: Distribution, shape: torch.Size) -> Tensor:
    """Return measurement covariances [R M, P, k, k], or [1, 1, k, k] if all are equal."""
    component = unwrap_independent(distribution)
    if (
        isinstance(component, torch.distributions.Normal)
        and component.scale.stride(0) == 0
        and component.scale.stride(1) == 0
    ):
        return torch.diag_embed(component.scale[:1, :1].square())  # expanded: all values are equal
    full = distribution_covariance(distribution)
    return full.reshape(*shape[:2], *full.shape[-2:])
