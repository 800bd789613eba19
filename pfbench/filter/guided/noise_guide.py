"""Proposal of each particle's noise by the rule of a Gaussian filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.covariance import distribution_covariance, factor
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    DifferenceSpace,
    around_first,
)
from pfbench.filter.guided.guide_memory import (
    check_covariance_factor,
    check_normal_guide,
    compute_log_ratio,
    standardise_noise,
)
from pfbench.filter.linearisation import mask_covariance, mean_noise, unwrap_independent
from pfbench.filter.particle.point_sets import IidPoints, PointSet
from pfbench.filter.particle.proposals import Proposal, ProposalSample
from pfbench.filter.whitening import LOG_2PI, compute_half_square, log_determinant
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class GuidedNoiseProposal(Proposal):
    """Draw each particle's noise from its approximate Gaussian posterior.

    y = h(f(parent, w)) + v is linearised in w by the guide's rule. The proposal is
    w ~ N(m, U U') and the ratio p(w) / q(w), which does not need a transition density. On
    linear-Gaussian models it is the optimal proposal [Doucet, Godsill, Andrieu 2000].

    Attributes:
        guide_filter: Gaussian filter whose rule linearises. It starts from each parent and
            therefore takes no adaptations.
        shared_by_particles: Linearise once per run, about the weighted mean without noise, instead
            of once per particle. The ratio corrects any proposal, so exactness does not change.
            Linear models always share.
        covariance_factor: Factor on the proposal covariance. Values above 1 protect against an
            overconfident proposal.
        points: Source of z.

    Raises:
        ValueError: If the guide has adaptations, gains or iterations, or the factor is not
            positive.
    """

    guide_filter: GaussianFilter
    shared_by_particles: bool = False
    covariance_factor: float = 1.0
    points: PointSet = field(default_factory=IidPoints)
    is_exact = True

    def __post_init__(self) -> None:
        check_covariance_factor(self.covariance_factor)
        check_normal_guide(self.guide_filter)
        if (
            self.guide_filter.noise_adaptations
            or self.guide_filter.gain_adaptations
            or self.guide_filter.iterations > 1
        ):
            raise ValueError(
                "proposal.guide_filter must have a linearisation only, got adaptations, gains or "
                "iterations. Remove adaptations, gains and iterations."
            )

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        noise = model.noise
        z = self.points(draws).normal("guide", belief.x.shape[1], model.noise_dim)
        xi, log_det = self.map_to_posterior(model, belief, record, z)
        w, log_ratio = xi, compute_log_ratio(xi, z, log_det, self.covariance_factor)
        if not standardise_noise(noise):
            w = noise.mean + noise.stddev * xi
            log_ratio = (
                log_ratio
                + noise.log_prob(w)
                + compute_half_square(xi)
                + (noise.stddev.log() + 0.5 * LOG_2PI).sum()
            )
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)

    def map_to_posterior(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, z: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Map standard normal numbers to the posterior of the whitened noise.

        Args:
            model: State-space model.
            belief: Particles at t-1.
            record: Record of step t.
            z: Standard normal numbers, [R, N, W].

        Returns:
            xi = m + sqrt(covariance_factor) U z, [R, N, W], and log |det U|, [R, N or 1].
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
        # shared: the particles of a run are columns of one matrix, else one matrix per particle
        r, z = (a.mT.unsqueeze(1) if shared else a.unsqueeze(-1) for a in (r, z))
        score = white.mT @ torch.linalg.solve_triangular(noise_root, r, upper=False)
        # the information matrix is cheaper than QR, and the ratio includes its rounding errors
        eye = torch.eye(m.shape[-1], dtype=r.dtype, device=r.device)
        lower, info = torch.linalg.cholesky_ex(eye + white.mT @ white)
        ok = (ok & (info == 0) & torch.isfinite(score).all(-1).all(-1))[..., None, None]
        root = torch.linalg.solve_triangular(
            torch.where(ok, lower, eye).mT, eye.expand_as(lower), upper=True
        )
        # not ok: the prior, which is also exact
        xi = root @ (root.mT @ torch.where(ok, score, 0.0) + math.sqrt(self.covariance_factor) * z)
        return xi.squeeze(1).mT if shared else xi.squeeze(-1), log_determinant(root)

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
