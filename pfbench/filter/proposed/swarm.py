"""Particle swarm proposal: move particles towards the measurement, then weight.

A swarm stores the best position of each particle and of all, and a velocity. Gaussian
attraction [Krohling 2004] gives the swarm-optimised particle filter (PSO-PF). Inertia, chaotic
perturbation and escape from the worst positions are those of [Tian et al., "Improved adaptive
particle filter for integrated navigation system"].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chi_square import chi_square_limit
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.exactness import has_bounded_weights, is_every_part_exact
from pfbench.filter.moves.path_kernels import propagate_path
from pfbench.filter.particle.stages import (
    Proposal,
    ProposalSample,
    deactivate_invalid_particles,
    draw_noise,
    is_measured,
)
from pfbench.filter.proposed.swarm_coordinates import (
    Fitness,
    ObservedComponents,
    PosteriorFitness,
    SwarmCoordinates,
    SwarmFrame,
)
from pfbench.filter.proposed.swarm_motion import (
    ChaoticPerturbation,
    InertiaVelocity,
    PriorStart,
    SwarmStart,
    SwarmState,
    VelocityUpdate,
    follow_logistic,
    iterate_logistic,
    logistic_map,
    safe_seeds,
    select_particle,
)
from pfbench.filter.proposed.swarm_weighting import MixtureWeighting, SwarmWeighting
from pfbench.filter.whitening import compute_half_square
from pfbench.kernels.dispatch import is_capturing
from pfbench.model.base import ModelWrapper, StateSpaceModel


@dataclass(frozen=True)
class SwarmLimits:
    """Limits of velocity and position, in scales of each coordinate [ours].

    The paper only names v_max. The scales do not come from the moving swarm, since its contraction
    and expansion would feed back.

    Attributes:
        scale_by_prior: The scale is the standard deviation of the initial particles, the paper's
            recorded interval. False takes the predicted particles.
        max_velocity_sd: v_max over six scales.
        max_distance_sd: Largest distance from the predicted mean in standard deviations of the
            predicted particles. None sets no limit.

    Raises:
        ValueError: If a limit is not positive.
    """

    scale_by_prior: bool = False
    max_velocity_sd: float = 0.5
    max_distance_sd: float | None = 3.0

    def __post_init__(self) -> None:
        require_ranges(
            "proposal.limits",
            self,
            max_velocity_sd="(0, inf]",
            max_distance_sd="null or (0, inf] Use null for no limit of position.",
        )

    def clamp_velocity(self, v: Tensor, scale: Tensor) -> Tensor:
        """Clamp velocities to their limits.

        Args:
            v: Velocities, [R, N, k].
            scale: Scale of each coordinate, [R, 1, k].

        Returns:
            Velocities, [R, N, k].
        """
        limit = 6.0 * self.max_velocity_sd * scale
        return torch.clamp(v, -limit, limit)

    def clamp_position(self, q: Tensor, sd: Tensor) -> Tensor:
        """Clamp positions to their limits.

        Args:
            q: Positions, [R, N, k].
            sd: Standard deviations of the predicted particles, [R, 1, k].

        Returns:
            Positions, [R, N, k].
        """
        if self.max_distance_sd is None:
            return q
        limit = self.max_distance_sd * sd
        return torch.clamp(q, -limit, limit)


@dataclass(frozen=True)
class ChiSquareStopping:
    """Stop a run when its best particle fits the measurement well enough [ours].

    The distance -2 ln p(y | x) + 2 ln p(y_hat | x) must be at most this chi-square quantile. The
    degrees of freedom are the observed components: 5.35 for six and the median. The paper does not
    specify its epsilon.

    Attributes:
        quantile: Probability in (0, 1).

    Raises:
        ValueError: If the quantile is outside (0, 1).
    """

    quantile: float = 0.5

    def __post_init__(self) -> None:
        require_ranges("proposal.stopping", self, quantile="(0, 1) Use 0.5 for the median.")

    def __call__(self, model: StateSpaceModel, best: Tensor, record: Record) -> Tensor:
        """Compute the mask of the runs that stop.

        Args:
            model: State-space model of the step.
            best: Best state of each run, [R, 1, D].
            record: Record of the step.

        Returns:
            Mask, [R].
        """
        y_hat: Tensor = model.observation(best, record.u).mean[:, 0]
        observed_mask = ~torch.isnan(record.y)
        nearest = model.log_likelihood(torch.where(observed_mask, y_hat, torch.nan), best, record.u)
        distance = 2.0 * (nearest - model.log_likelihood(record.y, best, record.u))[:, 0]
        limits = distance.new_tensor(
            [
                0.0,
                *(
                    chi_square_limit(k + 1, 1.0 - self.quantile)
                    for k in range(observed_mask.shape[-1])
                ),
            ]
        )
        return distance <= limits[observed_mask.sum(-1)]


class MoveInputs(NamedTuple):
    """Inputs of an iteration, common to the particles of a run.

    Attributes:
        u: Inputs of the model.
        y: Measurements, [R, Dy].
        penalty: W of the fitness, [R, k, k].
        origin: As in `SwarmFrame`.
        direction: As in `SwarmFrame`.
        scale: Scale of the velocity, [R, 1, k].
        spread: Standard deviation of the predicted particles, [R, 1, k].
    """

    u: Any
    y: Tensor
    penalty: Tensor
    origin: Tensor
    direction: Tensor
    scale: Tensor
    spread: Tensor


class SwarmMove(ModelWrapper):
    """Move of a swarm by given velocities, as a model: its states are the particles of the swarm.

    So a tape can take it. The states are those of `SwarmState`. The noise is what stays in a step and the velocity:
    predicted positions and their deviations, 1 for active slots, seeds of chaotic sequences that restart.
    """

    def __init__(self, proposal: SwarmProposal, model: StateSpaceModel, frame: SwarmFrame) -> None:
        super().__init__(model)
        self.proposal, self.frame, (k, d) = proposal, frame, frame.direction.shape[1:]
        chaos = k * (proposal.perturbation is not None)
        self.widths = (k, k, 1, k, 1, k, 1, chaos), (k, d, 1, chaos, k)
        self.tape_key = id(proposal), getattr(model, "tape_key", id(model)), k
        self.likelihood_counter = getattr(model, "likelihood_counter", None)

    def split_swarm(self, x: Tensor) -> SwarmState:
        """Return the swarm of joined columns, [R, N, S]."""
        *columns, chaos = x.split(self.widths[0], -1)
        columns = [a.to(self.frame.q) for a in columns]
        columns[2::2] = [a.squeeze(-1) for a in columns[2::2]]
        return SwarmState._make([*columns, chaos])

    def fit(self, frame: SwarmFrame, q: Tensor, active: Tensor, u: MoveInputs) -> Tensor:
        """Return the fitness of positions, -inf at inactive slots and where it is not defined, [R, N]."""
        x, record = frame.to_states(q), Record(u.y, u.u)
        value = self.proposal.fitness.fit_measurement(self.model, x, record)
        value = value - compute_half_square(q @ u.penalty.mT)
        return torch.where((active.squeeze(-1) > 0.0) & ~torch.isnan(value), value, -torch.inf)

    @override
    def propagate(self, x: Tensor, u: MoveInputs, w: Tensor) -> Tensor:
        """Move to x + v or, if its fitness is higher, x + v + Dx, and update the records."""
        swarm, limits, perturbation = (
            self.split_swarm(x),
            self.proposal.limits,
            self.proposal.perturbation,
        )
        start, deviation, active, spare, v = w.split(self.widths[1], -1)
        start, deviation, v = (a.to(swarm.q) for a in (start, deviation, v))
        frame = self.frame._replace(
            q=start, deviation=deviation, origin=u.origin, direction=u.direction
        )
        v = limits.clamp_velocity(v, u.scale)
        move = swarm.v if self.proposal.lags_velocity else v
        q, chaos = limits.clamp_position(swarm.q + move, u.spread), swarm.chaos
        value = self.fit(frame, q, active, u)
        if perturbation:
            chaos = logistic_map(chaos, spare)
            step = perturbation(chaos, u.scale)
            perturbed = limits.clamp_position(swarm.q + move + step, u.spread)
            perturbed_value = self.fit(frame, perturbed, active, u)
            q = torch.where((perturbed_value > value).unsqueeze(-1), perturbed, q)
            value = torch.maximum(perturbed_value, value)
        better, worse = value > swarm.best_fitness, value < swarm.worst_fitness
        best = torch.where(better.unsqueeze(-1), q, swarm.best)
        worst = torch.where(worse.unsqueeze(-1), q, swarm.worst)
        best_fitness = torch.maximum(value, swarm.best_fitness)
        worst_fitness = torch.minimum(value, swarm.worst_fitness)
        return join_columns((q, v, value, best, best_fitness, worst, worst_fitness, chaos))

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        return x.new_zeros(x.shape[:2])


def join_columns(columns: Sequence[Tensor]) -> Tensor:
    """Join numbers [R, N] and [R, N, k] to [R, N, S], fastest component-major in memory."""
    return torch.cat(
        [(a if a.dim() == 3 else a.unsqueeze(-1)).permute(2, 0, 1) for a in columns]
    ).permute(1, 2, 0)


@dataclass(frozen=True)
class SwarmProposal(Proposal):
    """Bootstrap prediction followed by particle swarm optimisation [Tian et al.].

    Steps a to f of the paper. A run without measurement follows the transition. A run that satisfies
    `stopping` moves no further. Chaotic sequences belong to slots, because resampled copies would
    otherwise share a sequence [ours].

    Attributes:
        velocity: Velocity update.
        perturbation: Chaotic perturbation, or None.
        fitness: Objective of the swarm.
        coordinates: Coordinates of the swarm.
        limits: Limits of velocity and position.
        stopping: Stopping rule before the last iteration, or None.
        iterations: Maximum number of iterations.
        swarm_start: Particles of the first step.
        weighting: Weights of the final swarm.
        lags_velocity: Move by the velocity of the iteration before, as eqs. 30 and 41 print.
        single_sequence: One chaotic sequence per run, whose k-th value belongs to all coordinates of
            particle k, as eqs. 31 and 39 print. The start is then a line through the box.

    Raises:
        ValueError: If iterations is below 1, or limits by the initial particles are combined with
            whitened coordinates.
    """

    velocity: VelocityUpdate = field(
        default_factory=lambda: InertiaVelocity(escape_coefficient=0.12)
    )
    perturbation: ChaoticPerturbation | None = field(default_factory=ChaoticPerturbation)
    fitness: Fitness = field(default_factory=PosteriorFitness)
    coordinates: SwarmCoordinates = field(default_factory=lambda: ObservedComponents(whiten=True))
    limits: SwarmLimits = field(default_factory=SwarmLimits)
    stopping: ChiSquareStopping | None = None
    iterations: int = 5
    swarm_start: SwarmStart = field(default_factory=PriorStart)
    weighting: SwarmWeighting = field(default_factory=MixtureWeighting)
    lags_velocity: bool = False
    single_sequence: bool = False

    def __post_init__(self) -> None:
        require_ranges("proposal", self, iterations="[1, inf]")
        require(
            not self.limits.scale_by_prior or not self.coordinates.whiten,
            "proposal.limits.scale_by_prior",
            "be false in whitened coordinates",
            "true",
            "Set limits.scale_by_prior or coordinates.whiten to false.",
        )

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{"proposal.start": self.swarm_start, "proposal.weights": self.weighting}
        )

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return bool(has_bounded_weights(self.weighting))

    @property
    def ends_early(self) -> bool:
        """True if a rule may end the iterations, so that the work of a step depends on its numbers."""
        return self.stopping is not None

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        parents, memory = self._start_step(model, belief, draws)
        w = draw_noise(model, parents.shape[1], draws)
        x, log_w = deactivate_invalid_particles(
            model.propagate(parents, record.u, w), belief.log_w, parents
        )
        frame = self.coordinates(model, x, normalise_log_weights(log_w), record.u)
        swarm, iterations = self.optimise(
            model, frame, torch.isfinite(log_w), memory, record, draws
        )
        q, log_ratio = self.weighting(frame, swarm.q, log_w, draws)
        measured = is_measured(record).unsqueeze(1)
        if self.perturbation:
            chaos = memory["swarm.chaos"].index_copy(-1, frame.components, swarm.chaos.unsqueeze(1))
            memory = memory | {"swarm.chaos": chaos}
        log_ratio = torch.where(
            torch.isfinite(log_w), torch.where(measured, log_ratio, 0.0), -torch.inf
        )
        x = frame.to_states(torch.where(measured.unsqueeze(2), q, frame.q))
        return ProposalSample(x, log_ratio, memory, trace={"iterations": iterations})

    def optimise(
        self,
        model: StateSpaceModel,
        frame: SwarmFrame,
        active_mask: Tensor,
        memory: dict[str, Tensor],
        record: Record,
        draws: RandomStream,
    ) -> tuple[SwarmState, Tensor]:
        """Run the swarm optimisation.

        Args:
            model: State-space model.
            frame: Coordinates of the predicted particles.
            active_mask: Mask of active slots, [R, N].
            memory: Initial scale [R, 1, d] and chaotic values [R, 1, N, d], as required.
            record: Record of the step.
            draws: Random numbers.

        Returns:
            Final swarm, and the number of iterations of each run [R].
        """
        q, spare, chaos = frame.q, frame.q[..., :0], frame.q[..., :0]
        if self.perturbation:
            spare = safe_seeds(draws.uniform("swarm.spare", *q.shape[1:]))
            chaos = memory["swarm.chaos"][:, 0, :, frame.components]
        shared = self._collect_inputs(frame, memory, record)
        move, step = SwarmMove(self, model, frame), Record(record.y, shared)
        constant = q, frame.deviation, active_mask.to(q), spare
        fitness = move.fit(frame, q, constant[2].unsqueeze(-1), shared)
        initial = join_columns((q, torch.zeros_like(q), fitness, q, fitness, q, fitness, chaos))
        active = observed_runs = is_measured(record)
        x, iterations = initial, torch.zeros_like(active, dtype=torch.long)
        for i in range(1, self.iterations + 1):
            if not (active.is_cuda or is_capturing()) and not bool(active.any()):
                break
            swarm = move.split_swarm(x)
            v = self.velocity(swarm, active_mask, i / self.iterations, draws, f"swarm.velocity.{i}")
            iterations = iterations + active
            w = join_columns((*constant, v)).unsqueeze(2)
            after = propagate_path(move, x, w, (step, step))[0][:, :, 1]
            x = torch.where(active[:, None, None], after, x) if self.stopping else after
            if self.stopping:
                swarm = move.split_swarm(x)
                best = select_particle(frame.to_states(swarm.best), swarm.best_fitness.argmax(1))
                active = active & ~self.stopping(model, best, record)
        return move.split_swarm(torch.where(observed_runs[:, None, None], x, initial)), iterations

    def _collect_inputs(
        self, frame: SwarmFrame, memory: dict[str, Tensor], record: Record
    ) -> MoveInputs:
        """Return what the particles of a run share in all iterations of a step."""
        spread = frame.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt().unsqueeze(1)
        scale = (
            memory["swarm.scale"][..., frame.components] if self.limits.scale_by_prior else spread
        )
        return MoveInputs(
            record.u, record.y, self.fitness(frame), frame.origin, frame.direction, scale, spread
        )

    def _start_step(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return parents [R, N, D] and memory, which the first step initialises."""
        if "swarm.scale" in belief.memory:
            return belief.x, belief.memory
        chart, slots = model.chart, belief.x.shape[1]
        if self.single_sequence:
            z = follow_logistic(draws.uniform("swarm.chaos", 1, 1), slots, chart.dimension)
        else:
            z = iterate_logistic(draws.uniform("swarm.chaos", slots, chart.dimension))
        w = normalise_log_weights(belief.log_w)
        c = chart.subtract(belief.x, chart.mean(belief.x, w).unsqueeze(1))
        memory = belief.memory | {
            "swarm.scale": (w.unsqueeze(-1) * c * c).sum(1, keepdim=True).sqrt()
        }
        if self.perturbation:
            memory = memory | {"swarm.chaos": z.unsqueeze(1)}
        return self.swarm_start(model, belief, z), memory
