"""The particle filter: resample, move, propose, weight.

Each method is a choice of stages. The file is long, since it checks how stages fit to each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream, relabel
from pfbench.core.record import Record
from pfbench.core.simulate import draw_initial_state
from pfbench.filter.belief import (
    ComputedWeights,
    Filter,
    ParticleBelief,
    StepInfo,
    StepSummary,
    count_distinct_ancestors,
    is_equal_for_all,
    make_step_info,
    normalise_updated_weights,
    weighted_mean_variance,
)
from pfbench.filter.exactness import has_bounded_weights, is_every_part_exact
from pfbench.filter.linearisation import compute_nis
from pfbench.filter.particle.stages import (
    AuxiliaryWeights,
    BayesWeightUpdate,
    BootstrapProposal,
    EssResampler,
    FixedCount,
    IidPoints,
    InitialProposal,
    MemoryWeightUpdate,
    ParticleCount,
    PointSet,
    PosteriorWeights,
    Proposal,
    Resampler,
    Systematic,
    WeightUpdate,
    compute_updated_weights,
    count_particles,
    deactivate_invalid_particles,
)
from pfbench.filter.particle.weights import PowerLikelihoodUpdate
from pfbench.kernels import dispatch
from pfbench.model.base import StateSpaceModel, initial_law

if TYPE_CHECKING:
    from pfbench.filter.moves.metropolis import Move, PathHistory

_HELD_STEPS = "held_steps"  # in the memory of particles: steps left without resampling, [R, 1]


@dataclass(frozen=True)
class ParticleFilter(Filter):
    """Particle filter composed of stages. The object holds no particles.

    A step resamples first, so the belief that it returns is weighted, and the log evidence is a sum
    of one term per step. The defaults make the SIR filter.

    Attributes:
        particles: Number of slots N.
        resampler: Draws ancestors.
        particle_count: Number of active particles.
        auxiliary_weights: Resampling probabilities.
        moves: MCMC moves after resampling.
        proposal: Draws the particles at t.
        weight_update: Weight update by the measurement.
        points: Point set of the initial particles. Stages have their own.
        initial_proposal: Draws the initial particles. None for the initial distribution.

    Raises:
        ValueError: If there are fewer than two particles. If moves need a past that the resampler
            does not copy or cannot share one, or if they would not leave the weights invariant.
    """

    particles: int
    resampler: Resampler = field(default_factory=lambda: EssResampler(Systematic()))
    particle_count: ParticleCount = field(default_factory=FixedCount)
    auxiliary_weights: AuxiliaryWeights = field(default_factory=PosteriorWeights)
    moves: tuple[Move, ...] = ()
    proposal: Proposal = field(default_factory=BootstrapProposal)
    weight_update: WeightUpdate | MemoryWeightUpdate = field(default_factory=BayesWeightUpdate)
    points: PointSet = field(default_factory=IidPoints)
    initial_proposal: InitialProposal | None = None

    def __post_init__(self) -> None:
        rule = "whole [2, inf) Use 2 or more, without a point or exponent."
        require_ranges("filter", self, particles=rule)
        _ = self.is_exact  # warns of each stage that does not state it
        if self.initial_proposal is not None:
            count = self.particle_count
            require(
                not self.moves and isinstance(count, FixedCount),
                "filter.initial_proposal",
                "be used without moves and with a fixed number of particles",
                f"{len(self.moves)} moves and {type(count).__name__}",
                "Remove one of them.",
            )
        require(
            not self.moves or not isinstance(self.weight_update, MemoryWeightUpdate),
            "filter.moves",
            "be empty with a weight update that replaces the model's likelihood",
            f"{len(self.moves)} with {type(self.weight_update).__name__}",
            "Remove the moves: they use the likelihood of the model.",
        )
        require(
            not self.moves or not self.stores_path,
            "filter.moves",
            "be empty with a proposal that stores the path of particles",
            f"{len(self.moves)} with {type(self.proposal).__name__}",
            "Remove the moves.",
        )
        require(
            not (self.history or self.stores_path) or isinstance(self.resampler, EssResampler),
            "filter.resampler",
            "copy particles with their past for moves or an interval",
            type(self.resampler).__name__,
            "Choose EssResampler.",
        )

    @property
    @override
    def is_exact(self) -> bool:
        """True if every stage states that the particles converge to p(x_t | y_1:t)."""
        stages = (
            "resampler",
            "particle_count",
            "auxiliary_weights",
            "proposal",
            "weight_update",
            "points",
            *(() if self.initial_proposal is None else ("initial_proposal",)),
        )
        moves = {f"moves[{i}]": move for i, move in enumerate(self.moves)}
        return is_every_part_exact(self, **{name: getattr(self, name) for name in stages}, **moves)

    @property
    def has_bounded_weights(self) -> bool:
        """True if every stage that weighs by a ratio states that the ratio has a bound."""
        initial = () if self.initial_proposal is None else (self.initial_proposal,)
        return all(map(has_bounded_weights, (self.auxiliary_weights, self.proposal, *initial)))

    @property
    def history(self) -> PathHistory | None:
        """History that the moves require."""
        if not self.moves:
            return None
        from pfbench.filter.moves.metropolis import combine_histories

        return combine_histories([move.required_history for move in self.moves])

    @property
    def stores_path(self) -> bool:
        """True if the proposal stores noise and states of past steps, so that its memory grows."""
        return bool(getattr(self.proposal, "stores_path", False))

    @property
    def obstacle(self) -> str:
        """Reason why a step cannot be compiled as a whole; empty if it can."""
        if self.history is not None:
            return "its moves use past states"
        if self.stores_path:
            return "its proposal stores the paths of particles"
        if getattr(self.proposal, "ends_early", False):
            return "a rule ends the iterations of its proposal"
        return ""

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        """Draw N equally weighted particles of the initial distribution."""
        if self.initial_proposal is not None:
            raise ValueError(
                "filter.initial_proposal needs the record, got a start without it. Use the filter "
                "alone, by run_filter, not inside another filter, or remove the proposal."
            )
        initial: Any = initial_law(model, runs, spread)
        x = draw_initial_state(model, initial, self.points(draws), "initial", self.particles, start)
        first = self.particle_count.initial_count(self.particles)
        log_w = torch.full(x.shape[:2], -math.log(first), dtype=x.dtype, device=x.device)
        log_w[:, first:] = -torch.inf
        belief = ParticleBelief(
            x=x, log_w=log_w, log_evidence=torch.zeros_like(log_w[:, 0], dtype=torch.float64)
        )
        if self.history is None:
            return belief
        origin = model.origin.expand(1, -1) if start is None else start
        mean = model.chart.add(origin, initial.mean).expand(runs, -1)
        covariance = distribution_covariance(initial).expand(runs, -1, -1)
        return self.history.start(model, belief, mean, covariance)

    def init_from_record(
        self, model: StateSpaceModel, record: Record, draws: RandomStream
    ) -> ParticleBelief:
        """Draw the initial particles, by the initial proposal if there is one.

        Args:
            model: State-space model.
            record: All steps of the record, prepared by the model.
            draws: Random stream of step 0.

        Returns:
            Weighted particles. Their log evidence is that of the proposal's ratio.
        """
        if self.initial_proposal is None:
            return self.init(model, len(record.y), draws, record.start, record.spread)
        stream = self.points(draws)
        x, log_ratio = self.initial_proposal(model, record, self.particles, stream)
        log_w, total, *_ = normalise_updated_weights(log_ratio - math.log(self.particles))
        memory = {_HELD_STEPS: torch.full_like(log_w[:, :1], self.initial_proposal.steps)}
        return ParticleBelief(x=x, log_w=log_w, log_evidence=total.double(), memory=memory)

    @override
    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Return the weighted particles at t from those at t-1 and the record at t."""
        belief, summary = self.compute_step(model, belief, record, draws)
        return belief, self.make_info(model, belief, summary, lambda: record)

    def compute_step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepSummary]:
        """Take a step with tensors only, as the compiler requires.

        Args:
            model: State-space model of the step.
            belief: Weighted particles at t-1.
            record: Record at t.
            draws: Random stream of the step.

        Returns:
            Weighted particles at t, and a summary of the step.
        """
        update = self.weight_update
        target = update.temper(model) if isinstance(update, PowerLikelihoodUpdate) else model
        parents, trace = self._resample_and_move(model, target, belief, record, draws)
        x, log_ratio, memory, w, proposal_trace = self.proposal(model, parents, record, draws)
        log_w, carried, counts = compute_updated_weights(
            update, model, parents.log_w, x, log_ratio, record, parents.memory
        )
        require(
            log_w.shape == x.shape[:2],
            type(update).__name__,
            f"return log weights [R, N] = {[*x.shape[:2]]}",
            [*log_w.shape],
            "Return one number for each particle of each run.",
        )
        fused = model.chart.flat and dispatch.runs_operators(x, log_w)
        if fused:
            *weights, mean, variance = dispatch.weigh_particles(x, log_w)
            fused = math.isfinite(float(mean.sum()))  # NaN of a particle is NaN of the mean
        if not fused:
            x, log_w = deactivate_invalid_particles(x, log_w, parents.x)
            weights = normalise_updated_weights(log_w)
        # not normalised: a ratio that is equal for all particles changes nothing
        predicted_log_w = (
            parents.log_w if is_equal_for_all(log_ratio) else parents.log_w + log_ratio
        )
        # a lost run keeps an evidence of -inf and continues with equal weights
        log_w, total, normalised_w, trace["ess"] = weights
        if not isinstance(self.particle_count, FixedCount):
            trace["particles"] = (parents.log_w > -torch.inf).sum(1).to(log_w)
        children = parents._replace(
            x=x,
            log_w=log_w,
            weights=ComputedWeights(log_w, normalised_w),
            log_evidence=belief.log_evidence + total,
            memory=memory | carried,
            ancestors=None,
        )
        if (history := self.history) is not None:
            children = history.append(target, parents, children, w, record)
        if not fused:
            mean, variance = weighted_mean_variance(model, children, normalised_w)
        return children, StepSummary(
            mean, variance, predicted_log_w, trace | proposal_trace | counts
        )

    def _resample_and_move(
        self,
        model: StateSpaceModel,
        target: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, dict[str, Tensor]]:
        """Return the parents of the particles at t, and diagnostics."""
        trace: dict[str, Tensor] = {}
        log_a = self.auxiliary_weights(model, belief, record)
        if self.initial_proposal is not None:
            log_a, belief = _hold_resampling(log_a, belief)
        belief, trace["resampled"] = self.resampler(
            model, belief, log_a, count_particles(self.particle_count, belief), draws
        )
        if belief.ancestors is not None:
            trace["ancestors"] = count_distinct_ancestors(belief.ancestors, belief.log_w)
        for i, move in enumerate(self.moves):
            belief, trace[f"accepted_{i}"] = move(
                target, belief, trace["resampled"], relabel(draws, f"move_{i}.")
            )
        if self.moves and belief.ancestors is not None:
            trace["unique"] = count_distinct_ancestors(belief.ancestors, belief.log_w)
        return belief, trace

    def make_info(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        summary: StepSummary,
        get_record: Callable[[], Record],
    ) -> StepInfo:
        """Make the information of a step for a report.

        Args:
            model: State-space model of the step.
            belief: Weighted particles after the step.
            summary: Summary of the step.
            get_record: Returns the record of the step. A report rarely needs it.

        Returns:
            Information of the step; covariances and NIS are computed on request.
        """

        def nis() -> tuple[Tensor, Tensor]:
            return compute_nis(model, belief.x, summary.predicted_log_w, get_record())

        return make_step_info(model, belief, summary.mean, summary.variance, summary.trace, nis)


def _hold_resampling(log_a: Tensor, belief: ParticleBelief) -> tuple[Tensor, ParticleBelief]:
    """Make resampling probabilities equal while measurements that placed the particles remain.

    A particle that fits later measurements has a small weight until these are processed. Resampling
    by the weights would remove it.

    Shapes: log_a [R, N].
    """
    remaining = belief.memory[_HELD_STEPS]
    equal = torch.full_like(log_a, -math.log(log_a.shape[1]))
    memory = belief.memory | {_HELD_STEPS: (remaining - 1.0).clamp(min=0.0)}
    return torch.where(remaining > 0.0, equal, log_a), belief._replace(memory=memory)
