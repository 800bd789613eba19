"""The particle filter: resample, move, propose, weight. Each method is a choice of stages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.core.covariance import (
    distribution_covariance,
    shared_distribution_covariance,
    squared_length,
)
from pfbench.core.density import has_finite_moments
from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_initial_state
from pfbench.filter.belief import ParticleBelief, StepInfo, normalise_log_weights
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.gaussian.gaussian_filter import around_first
from pfbench.filter.linearisation import mask_covariance
from pfbench.filter.moves.metropolis import Move, combine_histories
from pfbench.filter.moves.path_history import PathHistory
from pfbench.filter.particle.auxiliary_weights import AuxiliaryWeights, PosteriorWeights
from pfbench.filter.particle.particle_count import FixedCount, ParticleCount
from pfbench.filter.particle.point_sets import IidPoints, PointSet
from pfbench.filter.particle.proposals import BootstrapProposal, Proposal
from pfbench.filter.particle.resampling import EssResampler, Resampler, Systematic
from pfbench.filter.particle.weight_update import BayesWeightUpdate, WeightUpdate
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable, is_capturing
from pfbench.model.base import StateSpaceModel, initial_law


class StepSummary(NamedTuple):
    """Moments and diagnostics computed during one filter step.

    Attributes:
        mean: Mean of the particles, [R, D].
        variance: Variance in the chart, [R, d].
        predicted_log_w: Log weights before the measurement update, [R, N], not normalised.
        trace: Numbers per run, {name: [R]}.
    """

    mean: Tensor
    variance: Tensor
    predicted_log_w: Tensor
    trace: dict[str, Tensor]


class Stage(Protocol):
    """What every stage states."""

    @property
    def is_exact(self) -> bool:
        """Whether the weighted particles converge to the posterior as N grows."""


@dataclass(frozen=True)
class ParticleFilter:
    """Particle filter composed of stages. The object holds no particles.

    A step resamples first, so the belief that it returns is weighted, and the log evidence is a sum of
    one term per step. The defaults make the SIR filter.

    Attributes:
        particles: Number of slots N.
        resampler: Draws ancestors.
        particle_count: Number of active particles.
        auxiliary_weights: Resampling probabilities.
        moves: MCMC moves after resampling.
        proposal: Draws the particles at t.
        weight_update: Weight update by the measurement.
        points: Point set of the initial particles. Stages have their own.

    Raises:
        ValueError: If there are fewer than two particles, if moves need a past that the resampler
            does not copy, or if they cannot share one.
    """

    particles: int
    resampler: Resampler = field(default_factory=lambda: EssResampler(Systematic()))
    particle_count: ParticleCount = field(default_factory=FixedCount)
    auxiliary_weights: AuxiliaryWeights = field(default_factory=PosteriorWeights)
    moves: tuple[Move, ...] = ()
    proposal: Proposal = field(default_factory=BootstrapProposal)
    weight_update: WeightUpdate = field(default_factory=BayesWeightUpdate)
    points: PointSet = field(default_factory=IidPoints)

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise ValueError(
                f"filter.particles must be at least 2, got {self.particles}. Choose more particles"
            )
        _ = self.is_exact  # warns of each stage that does not state it
        if self.history is not None and not isinstance(self.resampler, EssResampler):
            name = type(self.resampler).__name__
            raise ValueError(
                f"filter.resampler must copy particles with their past for moves, got {name}. Choose EssResampler"
            )

    @property
    def is_exact(self) -> bool:
        """Whether every stage states that the particles converge to p(x_t | y_1:t)."""
        stages = (
            "resampler",
            "particle_count",
            "auxiliary_weights",
            "proposal",
            "weight_update",
            "points",
        )
        moves = {f"moves[{i}]": move for i, move in enumerate(self.moves)}
        return is_every_part_exact(**{name: getattr(self, name) for name in stages}, **moves)

    @property
    def history(self) -> PathHistory | None:
        """History that the moves require."""
        return combine_histories(self.moves)

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        """Draw N equally weighted particles of the initial distribution."""
        law: Any = initial_law(model, runs, spread)
        x = draw_initial_state(model, law, self.points(draws), "initial", self.particles, start)
        first = self.particle_count.initial_count(self.particles)
        log_w = torch.full(x.shape[:2], -math.log(first), dtype=x.dtype, device=x.device)
        log_w[:, first:] = -torch.inf
        cloud = ParticleBelief(
            x=x, log_w=log_w, log_evidence=torch.zeros_like(log_w[:, 0], dtype=torch.float64)
        )
        if self.history is None:
            return cloud
        origin = model.origin.expand(1, -1) if start is None else start
        mean = model.chart.add(origin, law.mean)
        return self.history.start(
            model, cloud, mean.expand(runs, -1), distribution_covariance(law).expand(runs, -1, -1)
        )

    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Return the weighted particles at t from those at t-1 and the record at t."""
        cloud, told = self.compute_step(model, belief, record, draws)
        return cloud, self.make_info(model, cloud, told, lambda: record)

    def compute_step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepSummary]:
        """Do the same with tensors only, for the compiler."""
        trace: dict[str, Tensor] = {}
        log_a = self.auxiliary_weights(model, belief, record)
        cloud, trace["resampled"] = self.resampler(
            model, belief, log_a, self.particle_count(belief), draws
        )
        if cloud.ancestors is not None:
            trace["ancestors"] = count_distinct_ancestors(cloud.ancestors, cloud.log_w)
        for i, move in enumerate(self.moves):
            cloud, trace[f"accepted_{i}"] = move(
                model, cloud, trace["resampled"], relabel(draws, f"move_{i}.")
            )
        if self.moves and cloud.ancestors is not None:
            trace["unique"] = count_distinct_ancestors(cloud.ancestors, cloud.log_w)
        x, log_ratio, memory, w, told = self.proposal(model, cloud, record, draws)
        log_w = self.weight_update(model, cloud.log_w, x, log_ratio, record)
        x, log_w = deactivate_invalid_particles(x, log_w, cloud.x)
        expected = cloud.log_w + log_ratio
        # a lost run keeps an evidence of -inf and continues with equal weights
        log_w, total, normalised_w, trace["ess"] = _normalise(log_w)
        if not isinstance(self.particle_count, FixedCount):
            trace["particles"] = (cloud.log_w > -torch.inf).sum(1).to(log_w)
        parents, keeper = cloud, self.history
        cloud = cloud._replace(
            x=x,
            log_w=log_w,
            log_evidence=belief.log_evidence + total,
            memory=memory,
            ancestors=None,
        )
        if keeper is not None:
            cloud = keeper.append(model, parents, cloud, w, record)
        return cloud, StepSummary(
            *weighted_mean_variance(model, cloud, normalised_w), expected, trace | told
        )

    def make_info(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        told: StepSummary,
        seen: Callable[[], Record],
    ) -> StepInfo:
        """Return what a report needs. It rarely asks for the record."""

        def nis() -> tuple[Tensor, Tensor]:
            return compute_nis(model, belief.x, told.predicted_log_w, seen())

        return make_step_info(model, belief, told.mean, told.variance, told.trace, nis)


def _normalise(log_w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return normalised log weights (equal if none is finite), logsumexp [R], weights and ESS [R]."""
    # one exponential for each particle: they cost most of a small step besides random numbers and copies
    top = log_w.detach().amax(1, keepdim=True)
    top = torch.where(torch.isfinite(top), top, 0.0)
    part = torch.exp(log_w - top)
    whole, square = _totals(part)
    lost = ~(torch.isfinite(whole) & (whole > 0.0))
    whole, slots = torch.where(lost, 1.0, whole), log_w.shape[1]
    total = top + torch.log(whole)
    log_w, normalised_w = (
        torch.where(lost, -math.log(slots), log_w - total),
        torch.where(lost, 1.0 / slots, part * (1.0 / whole)),
    )
    ess = torch.where(lost, slots, whole * whole / square).squeeze(1)
    return log_w, torch.where(lost, -torch.inf, total).squeeze(1), normalised_w, ess


def _separate_totals(part: Tensor) -> tuple[Tensor, Tensor]:
    """Return sums of rows [R, N] and of their squares, [R, 1] each."""
    return part.sum(1, keepdim=True), part.square().sum(1, keepdim=True)


def _long(a: Tensor, *_: Tensor) -> bool:
    """Return whether rows [R, N, ...] are too long for the compiler to sum in registers."""
    return a.shape[1] > 4096


_totals = compilable(_separate_totals, operator=cpp.sum_and_squares, keep_in_graph=_long)


def compute_nis(
    model: StateSpaceModel, x: Tensor, log_w: Tensor, record: Record
) -> tuple[Tensor, Tensor]:
    """Compute the normalised innovation squared (NIS) of predicted particles.

    Args:
        model: State-space model.
        x: Predicted particles, [R, N, D].
        log_w: Log weights before the measurement update, [R, N].
        seen: Record of the step; NaN marks a missing component.

    Returns:
        NIS [R], NaN where the observation distribution has no finite mean and variance, and the
        number of observed components [R], which is its expectation.
    """
    law: Any = model.observation(x, record.u)
    w, observed_mask = normalise_log_weights(log_w).unsqueeze(-1), ~torch.isnan(record.y)
    if not has_finite_moments(law):
        return torch.full_like(log_w[:, 0], torch.nan), observed_mask.sum(1)
    y_hat = around_first(model.residual)(law.mean, w.squeeze(-1))
    deviations = torch.where(w > 0.0, model.residual(law.mean, y_hat.unsqueeze(1)), 0.0)
    covariance = shared_distribution_covariance(law)
    noise = (w.unsqueeze(-1) * covariance).sum(1) if covariance.shape[1] > 1 else covariance[:, 0]
    r = torch.where(observed_mask, model.residual(record.y.nan_to_num(), y_hat), 0.0)
    every = torch.arange(deviations.shape[-1], device=deviations.device).unsqueeze(0)
    spread = _spread(deviations, torch.zeros_like(y_hat), w.squeeze(-1), every).squeeze(1)
    return squared_length(r, mask_covariance(spread + noise, observed_mask)), observed_mask.sum(1)


def _marked(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """Return the number of distinct values below 2 N in copy_of [R, N] at active slots, [R]."""
    marks = torch.zeros(len(copy_of), 2 * copy_of.shape[1], dtype=log_w.dtype, device=log_w.device)
    return (marks.scatter_add_(1, copy_of, (log_w > -torch.inf).to(log_w.dtype)) > 0.0).sum(1)


count_distinct_ancestors = compilable(_marked, operator=cpp.count_unique)


def deactivate_invalid_particles(
    x: Tensor, log_w: Tensor, parents: Tensor
) -> tuple[Tensor, Tensor]:
    """Set the log weight of non-finite particles to -inf and restore the parent state.

    Otherwise one NaN would spread to the estimate of its run, because 0 * NaN is NaN.

    Args:
        x: Particles, [R, N, D].
        log_w: Log weights, [R, N].
        parents: Particles before the step, [R, N, D].

    Returns:
        Particles and log weights.
    """
    if is_capturing():  # the caller of the graph checks, and repeats the step
        return x, log_w
    if not x.is_cuda and bool(torch.isfinite(x.sum())):  # this check is cheap on the CPU
        return x, log_w
    healthy = torch.isfinite(x.sum(-1))
    log_w = torch.where(healthy, log_w, -torch.inf)
    return torch.where(healthy, x.permute(2, 0, 1), parents.permute(2, 0, 1)).permute(
        1, 2, 0
    ), log_w


def summarise(model: StateSpaceModel, belief: ParticleBelief, trace: dict[str, Tensor]) -> StepInfo:
    """Return mean and variance of particles for the report, without a copy of them.

    Args:
        model: State-space model.
        cloud: Weighted particles.
        trace: Numbers per run, {name: [R]}.

    Returns:
        Information of the step.
    """
    return make_step_info(
        model,
        belief,
        *weighted_mean_variance(model, belief, normalise_log_weights(belief.log_w)),
        trace,
    )


def weighted_mean_variance(
    model: StateSpaceModel, belief: ParticleBelief, w: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean [R, D] and, in the chart about it, the variance [R, d].

    Args:
        model: State-space model.
        cloud: Particles.
        w: Normalised weights, [R, N].

    Returns:
        Mean and variance.
    """
    if model.chart.flat:
        mean, variance = _flat_moments(belief.x, w)
        return mean, variance
    mean = model.chart.mean(belief.x, w)
    return mean, (
        w.unsqueeze(-2) @ model.chart.subtract(belief.x, mean.unsqueeze(1)).square()
    ).squeeze(-2)


def make_step_info(
    model: StateSpaceModel,
    belief: ParticleBelief,
    mean: Tensor,
    variance: Tensor,
    trace: dict[str, Tensor],
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> StepInfo:
    """Return what a report needs of particles whose mean and variance are computed.

    Args:
        model: State-space model.
        cloud: Weighted particles.
        mean: Their mean, [R, D].
        variance: Their variance in the chart, [R, d].
        trace: Numbers per run, {name: [R]}.
        nis: Computes the NIS and the observed components, [R] each.

    Returns:
        Information of the step; covariances are computed on request.
    """

    def deviations() -> tuple[Tensor, Tensor]:
        return model.chart.subtract(belief.x, mean.unsqueeze(1)), belief.log_w

    def covariance() -> Tensor:
        d, log_w = deviations()
        return (normalise_log_weights(log_w).unsqueeze(-1) * d).mT @ d

    @cache
    def w() -> Tensor:  # once for all groups; the weights are normalised already
        return torch.exp(belief.log_w)

    def some(groups: Tensor) -> Tensor:
        if model.chart.flat:
            return _spread(belief.x, mean, w(), groups)
        return _spread(deviations()[0], torch.zeros_like(variance), w(), groups)

    return StepInfo(mean, variance, covariance, trace, deviations, nis, some)


def _separate_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D], by matrix products."""
    mean = w.unsqueeze(-2) @ x
    d = x - mean
    return mean.squeeze(-2), (w.unsqueeze(-2) @ (d * d)).squeeze(-2)


def _fused_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D] of numbers [R, N, D] by weights [R, N]."""
    parts = x.permute(2, 0, 1)
    mean = (w * parts).sum(-1)
    d = parts - mean.unsqueeze(-1)
    return mean.T, (w * d * d).sum(-1).T


def _separate_spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Return covariances [R, G, s, s] of groups of components [G, s] of numbers [R, N, k]."""
    deviations = x.permute(0, 2, 1)[:, groups] - mean[:, groups].unsqueeze(-1)  # [R, G, s, N]
    return (w[:, None, None] * deviations) @ deviations.mT


_spread = compilable(_separate_spread, operator=cpp.group_covariance, keep_in_graph=False)
_flat_moments = compilable(
    _fused_moments, eager=_separate_moments, operator=cpp.weighted_moments, keep_in_graph=_long
)
