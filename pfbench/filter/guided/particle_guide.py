"""Proposal from one Gaussian filter per particle: the unscented particle filter."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.normal import dense_normal, independent_normal
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.guided.guide_memory import (
    COVARIANCE,
    check_covariance_factor,
    check_normal_guide,
    compute_log_ratio,
    pack_guide_belief,
    standardise_noise,
    unpack_guide_belief,
)
from pfbench.filter.linearisation import mean_noise
from pfbench.filter.particle.point_sets import IidPoints, PointSet
from pfbench.filter.particle.proposals import BootstrapProposal, Proposal, ProposalSample
from pfbench.filter.whitening import LOG_2PI, compute_half_square, log_determinant
from pfbench.model.base import ModelWrapper, StateSpaceModel, StaticModel


@dataclass(frozen=True)
class ParticleGuideProposal(Proposal):
    """Draw each particle from the posterior of its own Gaussian guide filter.

    Unscented particle filter [van der Merwe et al. 2000]. The covariance P of each particle is
    predicted and updated, x ~ N(x+, P+), and the ratio is p(x | parent) / N(x; x+, P+). P does not
    use the other particles, so the proposal is much wider than p(x | parent, y). In several
    dimensions few particles have weight. `GuidedNoiseProposal` is cheaper and better. The cost is N guide
    steps per run.

    Attributes:
        guide_filter: Gaussian filter. Its adaptations act per particle and on the proposal only.
        covariance_factor: Factor on the proposal covariance.
        points: Source of z.

    Raises:
        ValueError: If the factor is not positive. At the first step, if the transition has no
            density or the chart changes volume (quaternions).
    """

    guide_filter: GaussianFilter
    covariance_factor: float = 1.0
    points: PointSet = field(default_factory=IidPoints)
    is_exact = True

    def __post_init__(self) -> None:
        check_covariance_factor(self.covariance_factor)
        check_normal_guide(self.guide_filter)

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        runs, n, _ = belief.x.shape
        if isinstance(model, StaticModel):  # no transition in this step
            return BootstrapProposal()(model, belief, record, draws)
        covariance = (
            belief.memory[COVARIANCE]
            if COVARIANCE in belief.memory
            else self._first(model, runs, record, draws)
        )
        before = unpack_guide_belief(belief.memory, belief.x, covariance.expand(-1, n, -1, -1))
        repeated = Record(record.y.repeat_interleave(n, 0), record.u)
        new = self.guide_filter.advance(_ParticlesAsRuns(model, runs, n), before, repeated)
        xi_mean, root, _ = kalman_gain_update(new.innovation)
        z = self.points(draws).normal("guide", n, model.chart.dimension)
        step = math.sqrt(self.covariance_factor) * (root @ z.reshape(runs * n, -1, 1)).squeeze(-1)
        xi = xi_mean + step
        x = model.chart.add(new.prior, (new.prior_root @ xi.unsqueeze(-1)).squeeze(-1)).unflatten(
            0, (runs, n)
        )
        xi, scale = (
            xi.unflatten(0, (runs, n)),
            log_determinant(new.prior_root).unflatten(0, (runs, n)),
        )
        log_q = (
            -compute_log_ratio(
                xi, z, log_determinant(root).unflatten(0, (runs, n)), self.covariance_factor
            )
            - compute_half_square(xi)
            - scale
        )
        log_ratio = _log_transition(model, belief.x, x, record.u) - log_q
        valid_mask = torch.isfinite(new.log_likelihood).unflatten(0, (runs, n))
        return ProposalSample(
            x,
            torch.where(valid_mask, log_ratio, -torch.inf),
            belief.memory | pack_guide_belief(new, (runs, n)),
        )

    def _first(
        self, model: StateSpaceModel, runs: int, record: Record, draws: RandomStream
    ) -> Tensor:
        """Return the covariance of the initial distribution, one per run [R, 1, d, d]."""
        d = model.chart.dimension
        cost = f"{runs} x N updates of {d} states in every step, N times the cost of SharedGuideProposal"
        warnings.warn(f"ParticleGuideProposal: {cost}", stacklevel=2)
        return self.guide_filter.init(
            model, runs, draws, record.start, record.spread
        ).covariance.unsqueeze(1)


class _ParticlesAsRuns(ModelWrapper):
    """Model view with one run per particle: [R N, P, ...] becomes [R, N P, ...]."""

    def __init__(self, model: StateSpaceModel, runs: int, n: int) -> None:
        super().__init__(model)
        self.runs, self.n = runs, n

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        propagated, points = self.model.propagate(self._joined(x), u, self._joined(w)), x.shape[1]
        return propagated.reshape(self.runs * self.n, points, -1)

    @override
    def noise_gain(self, u: Any) -> Tensor | None:
        gain = self.model.noise_gain(u)
        return None if gain is None else gain.expand(self.runs, -1, -1).repeat_interleave(self.n, 0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        distribution = self.model.observation(self._joined(x), u)
        mean = distribution.mean.reshape(*x.shape[:2], -1)
        if isinstance(distribution, torch.distributions.MultivariateNormal):
            return dense_normal(mean, distribution.scale_tril.reshape(*mean.shape, -1))
        return independent_normal(mean, distribution.stddev.reshape(mean.shape))

    def _joined(self, a: Tensor) -> Tensor:
        return a.reshape(self.runs, -1, a.shape[-1])


def _log_transition(model: StateSpaceModel, parents: Tensor, x: Tensor, u: Any) -> Tensor:
    """Return log p(x | parent) + d / 2 log 2 pi [R, N]."""
    chart, gain = model.chart, model.noise_gain(u)
    if (
        chart.size == chart.dimension
        and gain is not None
        and gain.shape[-1] == chart.dimension
        and standardise_noise(model.noise)
    ):
        prediction = model.propagate(parents, u, mean_noise(model, parents))
        w = torch.linalg.solve_ex(gain, chart.subtract(x, prediction).mT)[0]
        return -0.5 * (w * w).sum(-2) - torch.linalg.slogdet(gain)[1].unsqueeze(-1)
    distribution = model.transition(parents, u) if chart.flat else None
    if distribution is None:
        raise ValueError(
            "proposal ParticleGuideProposal must have a model with a transition density in the chart, "
            f"got {type(model).__name__}. Choose GuidedNoiseProposal, which works on the noise, or SharedGuideProposal."
        )
    return distribution.log_prob(x) + 0.5 * x.shape[-1] * LOG_2PI
