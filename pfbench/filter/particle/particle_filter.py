"""The particle filter: resample, move, propose, weight. Each method is a choice of stages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from pfbench.core.covariance import distribution_covariance
from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_initial_state
from pfbench.filter.belief import ParticleBelief, StepInfo
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.moves.metropolis import Move, combine_histories
from pfbench.filter.moves.path_history import PathHistory
from pfbench.filter.particle.auxiliary_weights import AuxiliaryWeights, PosteriorWeights
from pfbench.filter.particle.particle_count import FixedCount, ParticleCount
from pfbench.filter.particle.particle_moments import (
    StepSummary,
    compute_nis,
    count_distinct_ancestors,
    make_step_info,
    weighted_mean_variance,
)
from pfbench.filter.particle.point_sets import IidPoints, PointSet
from pfbench.filter.particle.proposals import BootstrapProposal, Proposal
from pfbench.filter.particle.resampling import EssResampler, Resampler
from pfbench.filter.particle.resampling_schemes import Systematic
from pfbench.filter.particle.weight_update import (
    BayesWeightUpdate,
    WeightUpdate,
    deactivate_invalid_particles,
    normalise_updated_weights,
)
from pfbench.model.base import StateSpaceModel, initial_law


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
        log_w, total, normalised_w, trace["ess"] = normalise_updated_weights(log_w)
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
