"""Stages of a particle filter, and the plain one of each: together they make the SIR filter."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.density import StandardNormal
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_values
from pfbench.filter.belief import (
    ParticleBelief,
    add_log_weights,
    exponentiate,
    gather_ancestors,
)
from pfbench.filter.exactness import is_every_part_exact
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable, is_capturing
from pfbench.model.base import StateSpaceModel


class AuxiliaryWeights(Protocol):
    """Resampling probabilities of the particles at t-1, given the record at t."""

    @property
    def is_exact(self) -> bool:
        """True if every particle of positive weight has a positive probability."""

    @property
    def has_bounded_weights(self) -> bool:
        """True if weights divided by probabilities have a bound. Silence counts as False."""
        return False

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        """Compute log resampling probabilities.

        Args:
            model: State-space model of the step.
            belief: Weighted particles at t-1.
            record: Record at t.

        Returns:
            Log probabilities [R, N], logsumexp 0.
        """


@dataclass(frozen=True)
class PosteriorWeights(AuxiliaryWeights):
    """The weights themselves, as in the plain particle filter."""

    is_exact = True
    has_bounded_weights = True

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        return belief.log_w


# --------------------------------------------------------------------------------------------------
# Number of particles: all slots by default.


class ParticleCount(Protocol):
    """Number of active particles of each run, at most the number of slots."""

    @property
    def is_exact(self) -> bool:
        """True if the number depends on the belief before resampling alone."""

    def initial_count(self, slots: int) -> int:
        """Return the initial number."""

    def __call__(self, belief: ParticleBelief) -> Tensor:
        """Compute the number for the next step, float [R, 1], from the belief before it."""


def count_particles(stage: ParticleCount, belief: ParticleBelief) -> Tensor:
    """Compute the number of active particles by a stage, and check it if the stage is a user's own.

    Returns numbers, [R or 1, 1].
    """
    n, (runs, slots) = stage(belief), belief.log_w.shape
    if type(stage).__module__.startswith("pfbench.") or is_capturing():
        return n  # within its limits; a check would make the device wait
    require(
        n.shape in ((runs, 1), (1, 1)) and ((n >= 1) & (n <= slots)).all(),
        f"particle_count {type(stage).__name__}",
        f"return [{runs} or 1, 1] numbers from 1 to {slots} slots",
        f"{list(n.shape)} with values from {float(n.min()):g} to {float(n.max()):g}",
        "Start with more particles, or clamp the number.",
    )
    return n


@dataclass(frozen=True)
class FixedCount(ParticleCount):
    """All slots at every step."""

    is_exact = True

    @override
    def initial_count(self, slots: int) -> int:
        return slots

    @override
    def __call__(self, belief: ParticleBelief) -> Tensor:
        runs, slots = belief.log_w.shape
        count = torch.full((runs, 1), slots, dtype=torch.float64, device=belief.log_w.device)
        return count.to(belief.log_w.dtype)


# --------------------------------------------------------------------------------------------------
# Resampling by copies: systematic where the effective sample size is small by default.
#
# A resampler returns particles, not indices, because some (regularised, aggregating) do not copy.


class ResamplingScheme(Protocol):
    """Resampling scheme: the distribution of the ancestors, given their probabilities."""

    @property
    def is_exact(self) -> bool:
        """True if every particle gets n a copies on average."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        """Draw ancestors.

        Args:
            a: Probabilities, [R, N].
            n: Number of particles to draw, [R, 1]. Later slots are ignored.
            draws: Random stream of the step.

        Returns:
            Slot that each new particle copies, [R, N].
        """


class Resampler(Protocol):
    """Stage that replaces particles by others of the same target."""

    @property
    def is_exact(self) -> bool:
        """True if resampling does not change the target of the particles as N grows."""

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        """Resample particles.

        Args:
            model: State-space model of the step.
            belief: Weighted particles.
            log_a: Log resampling probabilities, [R, N]. The same object as the log weights of the
                belief if the probabilities are the weights.
            n: Number of new particles, [R, 1].
            draws: Random stream of the step.

        Returns:
            New particles and a mask of the resampled runs, [R].
        """


@cache
def _as_tensor(threshold: float) -> Tensor:
    """Return a threshold as an operator takes it, once for all steps."""
    return torch.tensor([[threshold]], dtype=torch.float64)


@dataclass(frozen=True)
class EssResampler(Resampler):
    """Resample the runs with a small effective sample size.

    Attributes:
        scheme: Resampling scheme.
        ess_threshold: Resample if ESS < threshold n, with the weights of the step before. 1 resamples at every step, 0 never.

    Raises:
        ValueError: If the threshold is outside [0, 1].
    """

    scheme: ResamplingScheme
    ess_threshold: float = 0.5

    def __post_init__(self) -> None:
        rule = "[0, 1] Use 0 to resample never, 1 at every step."
        require_ranges("resampler", self, ess_threshold=rule)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.scheme": self.scheme})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        a = exponentiate(log_a, belief.weights)
        is_plain = type(self.scheme) is Systematic and log_a is belief.log_w
        if is_plain and dispatch.runs_operators(belief.x, a):
            x, u = belief.x.permute(2, 0, 1), _draw_offset(draws)
            limit = _as_tensor(self.ess_threshold)
            x, log_w, ancestors, resampled_mask = dispatch.resample_particles(
                x, log_a, a, n, u, limit
            )
            return gather_ancestors(belief, ancestors, log_w, x.permute(1, 2, 0)), resampled_mask
        resampled_mask = torch.ones_like(belief.log_evidence, dtype=torch.bool)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.ess_threshold < 1.0:
            resampled_mask = 1.0 / a.square().sum(-1) < self.ess_threshold * n.squeeze(1)
            ancestors = torch.where(resampled_mask.unsqueeze(1), ancestors, slots)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not belief.log_w:  # other probabilities than the weights: correct for them
            log_w = log_w + (belief.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        if self.ess_threshold < 1.0:
            log_w = torch.where(resampled_mask.unsqueeze(1), log_w, belief.log_w)
        return gather_ancestors(belief, ancestors, log_w), resampled_mask


# --------------------------------------------------------------------------------------------------
# Systematic resampling, and what all resampling schemes share.
#
# Every scheme gives a particle n a copies on average for probabilities a. All are batched and use
# counting or sorted search. Probabilities are cut to multiples of 2^-52, whose sums are exact in double
# precision. Cumulative sums are therefore the same in any order of summation, so that all engines and
# devices choose the same ancestors by the same probabilities.

_GRID = 2.0**52  # multiples of its inverse are summed without rounding, up to a sum of 2


@dataclass(frozen=True)
class Systematic(ResamplingScheme):
    """One uniform u for all slots, at positions (j + u) / n.

    Counts differ from n a by less than 1.
    """

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return _systematic(a, n, _draw_offset(draws))


def _draw_offset(draws: RandomStream) -> Tensor:
    """Draw the uniform number u of each run, [R, 1]."""
    return draws.uniform("resample", 1, 1).squeeze(1)


def _eager_systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Return ancestors [R, N] by the positions (j + u) / n of slots j, u [R, 1]."""
    sums, count = sum_exactly(a), n.double()
    total = sums[:, -1:]
    ends = torch.minimum(torch.ceil(sums * (count / total) - u.double()), count)
    # where, since the last sum may round below n, which gives the last slot to a weight of 0
    return slots_below(torch.where(sums < total, ends, count).long(), n)


_systematic = compilable(_eager_systematic, operator=dispatch.resample_systematic)


def sum_exactly(a: Tensor) -> Tensor:
    """Return cumulative sums [R, N] in units of 2^-52, float64. They do not depend on their order."""
    return torch.trunc(a.double() * _GRID).cumsum(1)


def slots_below(below: Tensor, n: Tensor) -> Tensor:
    """Return ancestors [R, N], non-decreasing, from cumulative counts, int64 [R, N]."""
    # slot j belongs to the first particle that ends after it: count particles by their end, and sum
    (runs, slots), total = below.shape, n.long()
    # in float32 the largest uniform is 1 and ends a weight of 0 at -1
    ends = torch.minimum(below, total).clamp(min=0)
    last = torch.arange(slots, device=below.device) == slots - 1
    ends = torch.where(last, total, ends)  # exact in spite of rounding
    counts = torch.zeros(runs, slots + 1, dtype=torch.long, device=ends.device).scatter_add(
        1, ends, torch.ones_like(ends)
    )
    return counts.cumsum(1)[:, :slots].clamp(max=slots - 1)


# --------------------------------------------------------------------------------------------------
# Proposals: new particles and their density ratio, by the noise of the model by default.


class ProposalSample(NamedTuple):
    """Sample of a proposal.

    Attributes:
        x: Particles, [R, N, D].
        log_ratio: log p(w) - log q(w) of their noise, [R, N].
        memory: As in `ParticleBelief`.
        w: The noise, [R, N, W], for moves. None if the proposal does not draw noise.
        trace: Numbers per run for the report, {name: [R]}.
    """

    x: Tensor
    log_ratio: Tensor
    memory: dict[str, Tensor]
    w: Tensor | None = None
    trace: dict[str, Tensor] = {}  # noqa: RUF012


class Proposal(Protocol):
    """Proposal distribution of the particles at t."""

    @property
    def is_exact(self) -> bool:
        """True if the ratio is that of the densities."""

    @property
    def has_bounded_weights(self) -> bool:
        """True if the ratio has a bound for any model. Silence counts as False."""
        return False

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        """Draw particles.

        Args:
            model: State-space model of the step.
            belief: Parents of the particles, at t-1.
            record: Record at t.
            draws: Random stream of the step.

        Returns:
            Particles at t and their density ratio.
        """


class InitialProposal(Protocol):
    """Proposal distribution of the particles at step 0."""

    @property
    def is_exact(self) -> bool:
        """True if the ratio is that of the densities."""

    @property
    def has_bounded_weights(self) -> bool:
        """True if the ratio has a bound for any model. Silence counts as False."""
        return False

    @property
    def steps(self) -> int:
        """Number of the first measurements that the particles depend on."""

    def __call__(
        self, model: StateSpaceModel, record: Record, n: int, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        """Draw initial particles.

        Args:
            model: State-space model.
            record: All steps of the record, prepared by the model, with initial states and factors.
            n: Number of particles.
            draws: Random stream of step 0.

        Returns:
            Particles [R, n, D] and log p(x_0) - log q(x_0), [R, n].
        """


@dataclass(frozen=True)
class BootstrapProposal(Proposal):
    """Noise of the model, x = propagate(x, u, w), with ratio 0.

    References:
        Gordon, Salmond and Smith 1993.
    """

    is_exact = True
    has_bounded_weights = True

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        w = draw_noise(model, belief.x.shape[1], draws)
        log_ratio = torch.zeros_like(belief.log_w[:, :1]).expand_as(belief.log_w)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)


def is_measured(record: Record) -> Tensor:
    """Return which runs have a measurement in a step, [R]."""
    return ~torch.isnan(record.y).all(-1)


def draw_noise(model: StateSpaceModel, n: int, draws: RandomStream) -> Tensor:
    """Draw noise from the model's noise distribution.

    Returns noise w, [R, n, W].
    """
    if has_standard_noise(model):
        return draws.normal("noise", n, model.noise_dim)
    return draw_values(model.noise, draws, "noise", n).to(model.anchor.dtype)


def has_standard_noise(model: StateSpaceModel) -> bool:
    """Return whether the noise of a model is standard normal."""
    if type(model).noise is StateSpaceModel.noise:  # not built at each step
        return True
    distribution = model.noise
    return isinstance(getattr(distribution, "base_dist", distribution), StandardNormal)


# --------------------------------------------------------------------------------------------------
# Weight updates by the measurement: Bayes' rule by default.


WEIGHT_UPDATE_MEMORY = "weight_update."  # start of the names of its values in the particles' memory


class WeightUpdate(Protocol):
    """Weight update by the measurement."""

    @property
    def is_exact(self) -> bool:
        """True if the weights are those of the posterior."""

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        """Compute the weights after the measurement.

        Args:
            model: State-space model of the step.
            log_w: Log weights before the measurement, [R, N].
            x: Particles, [R, N, D].
            log_ratio: Density ratio of the proposal, log p(w) - log q(w), [R, N].
            record: Record of the step.

        Returns:
            Log weights, [R, N], not normalised.
        """


class UpdatedWeights(NamedTuple):
    """Result of a weight update with memory.

    Attributes:
        log_w: Log weights, [R, N], not normalised.
        memory: Values for the next step by name, [R, 1, ...], equal for all particles of a run.
        trace: Numbers per run for the report, {name: [R]}.
    """

    log_w: Tensor
    memory: dict[str, Tensor]
    trace: dict[str, Tensor]


class MemoryWeightUpdate(ABC):
    """Weight update that judges a measurement by the predicted particles, with a memory."""

    @abstractmethod
    def update_weights(
        self,
        model: StateSpaceModel,
        log_w: Tensor,
        x: Tensor,
        log_ratio: Tensor,
        record: Record,
        memory: dict[str, Tensor],
    ) -> UpdatedWeights:
        """Compute the weights after the measurement.

        Shapes: log_w [R, N], x [R, N, D], log_ratio [R, N].
        """


def compute_updated_weights(
    weight_update: WeightUpdate | MemoryWeightUpdate,
    model: StateSpaceModel,
    log_w: Tensor,
    x: Tensor,
    log_ratio: Tensor,
    record: Record,
    memory: dict[str, Tensor],
) -> UpdatedWeights:
    """Apply a weight update with or without memory.

    Returns weights, values for the next step and numbers for the report. Shapes: log_w [R, N], x
    [R, N, D], log_ratio [R, N].
    """
    if isinstance(weight_update, MemoryWeightUpdate):
        return weight_update.update_weights(model, log_w, x, log_ratio, record, memory)
    return UpdatedWeights(weight_update(model, log_w, x, log_ratio, record), {}, {})


@dataclass(frozen=True)
class BayesWeightUpdate(WeightUpdate):
    """Bayes' rule: log w + log p(y | x) + log p(w) - log q(w). A NaN becomes weight 0."""

    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        log_likelihood = model.log_likelihood(record.y, x, record.u).expand_as(log_w).to(log_w)
        return add_log_weights(log_likelihood, log_w, log_ratio)


def deactivate_invalid_particles(
    x: Tensor, log_w: Tensor, parents: Tensor
) -> tuple[Tensor, Tensor]:
    """Set the log weight of non-finite particles to -inf and restore the parent state.

    Otherwise one NaN would spread to the estimate of its run, because 0 * NaN is NaN.

    Returns particles and log weights. Shapes: x [R, N, D], log_w [R, N], parents [R, N, D].
    """
    if is_capturing():  # the caller of the graph checks, and repeats the step
        return x, log_w
    if not x.is_cuda and math.isfinite(float(x.detach().sum())):  # this check is cheap on the CPU
        return x, log_w
    healthy = torch.isfinite(x.sum(-1))
    log_w = torch.where(healthy, log_w, -torch.inf)
    x = torch.where(healthy, x.permute(2, 0, 1), parents.permute(2, 0, 1)).permute(1, 2, 0)
    return x, log_w


# --------------------------------------------------------------------------------------------------
# Point sets, as random streams: plain Monte Carlo by default.


class PointSet(Protocol):
    """Point set: n points in w dimensions at a time, as a random stream."""

    @property
    def is_exact(self) -> bool:
        """True if each point has the stream's distribution."""

    def __call__(self, draws: RandomStream, first: int = 0) -> RandomStream:
        """Return the stream of points.

        Args:
            draws: Random stream of the shifts.
            first: First axis of the set to use. Two stages with separate axes draw the points of
                one joint set. With common axes their draws would be dependent.

        Returns:
            Random stream.
        """


@dataclass(frozen=True)
class IidPoints(PointSet):
    """Plain Monte Carlo."""

    is_exact = True

    @override
    def __call__(self, draws: RandomStream, first: int = 0) -> RandomStream:
        return draws
