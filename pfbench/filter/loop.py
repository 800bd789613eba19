"""The time loop of every filter: batches of runs, steps of a belief through a record, feedback."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import BatchRandomStream, RandomStream
from pfbench.core.record import FeedbackRun, Record, iterate_steps, take_groups
from pfbench.filter.belief import (
    Filter,
    GaussianBelief,
    KeptSteps,
    ParticleBelief,
    StepBlock,
    StepInfo,
    join_runs,
)
from pfbench.filter.exactness import has_bounded_weights
from pfbench.filter.health import HealthMonitor, with_cached_nis
from pfbench.filter.input_check import check_is_filter, check_model_once, check_record
from pfbench.filter.particle.stages import WEIGHT_UPDATE_MEMORY
from pfbench.model.base import StateSpaceModel, named_inputs

# `run_filter`, training, online inference and filters that take several steps together all use `FilterPass`.

Watch = Callable[[int, StepInfo], dict[str, Tensor]]


class FilterResult(NamedTuple):
    """Result of a filter on a record.

    Attributes:
        mean: State estimate, [R, T, D]. NaN from the step at which a run is lost. With feedback,
            the estimate as it would read without any correction.
        variance: Diagonal of the covariance in the chart, [R, T, d]. NaN as in `mean`, and for a
            filter without covariance.
        log_evidence: log p(y_1:T), [R]. -inf where the run is lost. Not a density if the filter
            states so, see `has_evidence`.
        trace: Diagnostics per run and step, {name: [R, T]}: `ess`, `resampled` and the results of
            `watch`.
        health: Health of each run as an index in `pfbench.filter.health.HEALTH`, int8 [R]: ok, lost,
            collapsed, diverged, overconfident, heavy-tailed, implausible or undefined. It is
            computed without the truth.
        pareto_k: Pareto k-hat of the weights, [R], the second largest of ten checked steps. NaN if
            the filter states that its weights are bounded, or weighs no particles.
    """

    mean: Tensor
    variance: Tensor
    log_evidence: Tensor
    trace: dict[str, Tensor]
    health: Tensor
    pareto_k: Tensor

    @property
    def lost(self) -> Tensor:
        """Mask of lost runs, [R]."""
        return ~torch.isfinite(self.log_evidence)


@runtime_checkable
class MultiStepFilter(Protocol):
    """A filter that can take several steps of a record in one call."""

    def take_steps(
        self,
        model: StateSpaceModel,
        belief: Any,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
        selection: KeptSteps,
    ) -> tuple[StepBlock, Any, int]:
        """Take at least one and at most `limit` steps from step `t` on.

        Args:
            model: State-space model. Its `at_step` gives the model of each step.
            belief: Belief before step `t`.
            record: All steps of the record, prepared by the model.
            t: First step, from 0. Step t uses `draws.at_step(t + 1)`.
            draws: Random stream of the record.
            limit: Maximum number of steps, as the call before it returned it. 0 for one step that
                cannot be taken together with others.
            selection: Steps whose belief and information are read.

        Returns:
            The steps, the belief after them, and the limit of the next call.
        """


@runtime_checkable
class RecordStartedFilter(Protocol):
    """A filter whose initial belief may use the record."""

    def init_from_record(self, model: StateSpaceModel, record: Record, draws: RandomStream) -> Any:
        """Return the initial belief."""


class PassStep(NamedTuple):
    """One step of a `FilterPass`.

    Attributes:
        t: Step number from 0.
        model: Model of this step.
        record: Measurements and inputs of this step.
        info: Estimate and diagnostics of this step.
        draws: Random stream of this step.
    """

    t: int
    model: StateSpaceModel
    record: Record
    info: StepInfo
    draws: RandomStream


_JOINED = 32  # steps; more save nothing, and a batch of runs waits in the cache for as long


class FilterPass:
    """One pass of a filter over a record, step by step.

    Iterating takes the steps. Between two steps the caller may replace `belief`, and `model` by one
    with other parameters.

    Shapes: record [R, T, Dy].

    Attributes:
        belief: Belief after the latest step.
        model: State-space model. `at_step` gives the model of a step.
    """

    def __init__(
        self,
        method: Filter,
        model: StateSpaceModel,
        record: Record,
        draws: RandomStream,
        feedback: FeedbackRun | None = None,
    ) -> None:
        self.method, self.model, self.record, self.draws = method, model, record, draws
        self.feedback = feedback
        self.belief: Any = _start(method, model, record, draws.at_step(0))

    def at_step(self, t: int) -> StateSpaceModel:
        """Return the present model of step t."""
        return self.model.at_step(t)

    def __iter__(self) -> Iterator[PassStep]:
        for t, model, record in iterate_steps(self, self.record):
            draws = self.draws.at_step(t + 1)
            if self.feedback is not None:
                record = prepare_record(self.model, self.feedback.at_step(t)).at_step(0)
                belief, info = self.method.step(model, self.belief, record, draws)
                self.belief, info = apply_feedback(self.model, self.feedback, belief, info)
            else:
                self.belief, info = self.method.step(model, self.belief, record, draws)
            yield PassStep(t, model, record, info, draws)

    def iterate_blocks(self, selection: KeptSteps) -> Iterator[StepBlock]:
        """Take the steps, several in one call where the filter can do so.

        The caller must not change belief or model.
        """
        if self.feedback is not None or not isinstance(self.method, MultiStepFilter):
            yield from self._join_steps(selection)
            return
        t, steps = 0, self.record.y.shape[1]
        limit = steps
        while t < steps:
            block, self.belief, limit = self.method.take_steps(
                self.model, self.belief, self.record, t, self.draws, limit, selection
            )
            t += block.mean.shape[1]
            yield block

    def _join_steps(self, selection: KeptSteps) -> Iterator[StepBlock]:
        """Take the steps one by one, and join some of them, whose beliefs are not held unless they are read."""
        last, numbers, clouds = self.record.y.shape[1] - 1, [], {}
        for t, _, _, info, _ in self:
            numbers.append((info.mean, info.variance, self.belief.log_evidence, info.trace))
            if selection.all_steps or t in selection.checked:
                clouds[t] = self.belief, info
            # the reader of a block holds its cloud, which the next step needs anyway, and later ones do not
            if clouds or t - 1 in selection.checked or t == last or len(numbers) == _JOINED:
                yield StepBlock.of_steps(t + 1 - len(numbers), numbers, clouds)
                numbers, clouds = [], {}


def _start(method: Filter, model: StateSpaceModel, record: Record, draws: RandomStream) -> Any:
    """Return the initial belief."""
    check_is_filter(method)
    if isinstance(method, RecordStartedFilter):
        return method.init_from_record(model, record, draws)
    return method.init(model, len(record.y), draws, record.start, record.spread)


def prepare_record(model: StateSpaceModel, record: Record) -> Record:
    """Compute a record's inputs for a model, on its device and in its precision.

    Shapes: record [R, T, Dy].
    """
    start, spread = (
        None if a is None else a.to(model.anchor) for a in (record.start, record.spread)
    )
    with named_inputs(model):
        prepared = model.prepare(record)
    return prepared.to(model.anchor)._replace(start=start, spread=spread)


# what a filter may remember of a model during a pass over a record: between two passes its constants may change
MEMORY_OF_PASS: ContextVar[dict[Any, Any] | None] = ContextVar("memory of a pass", default=None)


@contextmanager
def _remember() -> Iterator[None]:
    token = MEMORY_OF_PASS.set({})
    try:
        yield
    finally:
        MEMORY_OF_PASS.reset(token)


@_remember()
def run_filter(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: BatchRandomStream,
    watch: Watch | None = None,
    on_step: Callable[[], object] | None = None,
    run_batch: int | None = None,
    threads: int = 1,
) -> FilterResult:
    """Run a filter over a record, all runs as one batch.

    Args:
        method: The filter.
        model: State-space model of the filter.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream. Step 0 is the initial distribution, step t the t-th measurement.
            Particles have the wider type of model and stream: a float32 model with a float64 stream
            computes in float64. Give both the same type.
        watch: (t, info) -> {name: [R] or [R, ...]}, for results other than mean and variance. It
            cannot influence the filter.
        on_step: Function called after each step, such as a progress bar.
        run_batch: Runs that a step takes together, one batch after the other. None takes all. The
            result agrees to rounding (`choose_run_batch`). With feedback all runs form one batch.
        threads: Batches of runs that are stepped at the same time, if the filter is a `MultiStepFilter`. Others step
            one batch after the other. The result does not depend on it.

    Returns:
        Means, variances, evidence and diagnostics.

    Raises:
        ValueError: If `method` is not a filter, if record, model and random stream do not fit, or
            if model or filter do not support the record's feedback.
    """
    check_record(model, record, draws)
    feedback = (
        None
        if record.feedback is None
        else record.feedback.begin(record, correctable_groups(model))
    )
    prepared = prepare_record(model, record)
    check_model_once(model, record, prepared)
    batches = _split_runs(prepared, draws, None if feedback is not None else run_batch)
    monitor = HealthMonitor(prepared, fits_tails=has_bounded_weights(method) is False)
    passes = [FilterPass(method, model, *batch, feedback) for batch in batches]
    selection = KeptSteps(monitor.visited, all_steps=watch is not None)
    iterators = [run.iterate_blocks(selection) for run in passes]
    several = min(threads, len(passes)) if isinstance(method, MultiStepFilter) else 1

    def take_blocks() -> Iterator[StepBlock]:
        with _advance_in_threads(several) as advance:
            for block in _join_passes(iterators, monitor.steps, advance):
                yield _watch_block(block, watch, on_step)
                if not monitor.visited.isdisjoint(block.infos):
                    monitor.check(model, prepared, block.beliefs, block.infos)

    parts = [_join_blocks(blocks, 1) for blocks in take_groups(take_blocks())]
    _, mean, variance, log_evidence, trace, *_ = _join_blocks(parts, 1)
    valid = monitor.check_evidence(log_evidence).unsqueeze(-1)
    mean, variance = (torch.where(valid, a, torch.nan) for a in (mean, variance))
    monitor.check_moments(model, prepared, mean, variance, trace.get("ess"))
    last = log_evidence[:, -1]
    health = monitor.classify(~torch.isfinite(last))
    return FilterResult(mean, variance, last, trace, health, monitor.pareto_k)


def _watch_block(
    block: StepBlock, watch: Watch | None, on_step: Callable[[], object] | None
) -> StepBlock:
    """Call the observers after each step of a block.

    Returns the block with the results of `watch` in place of its beliefs and infos.
    """
    rows = []
    for t in block.steps:
        if watch:
            rows.append(watch(t, block.infos[t]))
        if on_step:
            on_step()
    watched = (
        {name: torch.stack([row[name] for row in rows], 1) for name in rows[0]} if rows else {}
    )
    return block._replace(trace=block.trace | watched, beliefs={}, infos={})


# --------------------------------------------------------------------------------------------------
# Feedback: the estimate of a step corrects the process that the filter estimates.

LEARNED_GAIN_MEMORY = "learned_gain_"  # start of the names in the memory of a learned gain


def apply_feedback(
    model: StateSpaceModel,
    feedback: FeedbackRun,
    belief: ParticleBelief | GaussianBelief,
    info: StepInfo,
) -> tuple[ParticleBelief | GaussianBelief, StepInfo]:
    """Correct the process by the estimate of valid runs, and the belief accordingly.

    The correction applies to particles or to the mean of a Gaussian belief. Its derivative
    transforms the covariance, because a correction of the attitude rotates the axes [ours].

    Returns belief about the correct_increment process, and the info with the uncorrected estimate.
    """
    valid = torch.isfinite(belief.log_evidence).unsqueeze(-1)
    uncorrected, correct = feedback.correct(torch.where(valid, info.mean, 0.0))
    info = info._replace(mean=torch.where(valid, uncorrected.to(info.mean), info.mean))
    if isinstance(belief, ParticleBelief):
        # the memory of a weight update counts measurements of a run; it holds no states
        past = [name for name in belief.memory if not name.startswith(WEIGHT_UPDATE_MEMORY)]
        require(
            not belief.window and (not past),
            "filter",
            "not store a particle's past in a scenario with feedback",
            "one with moves, a guided start or a proposal's memory",
            "Choose another filter, or set scenario.closed_loop=false.",
        )
        return belief._replace(x=correct(belief.x)), info
    if any(name.startswith("branch_") for name in belief.memory):
        raise ValueError(
            "filter must not have several hypotheses in a scenario with feedback, which corrects one "
            "estimate. Choose another filter, or set scenario.closed_loop=false."
        )
    require(
        not any(name.startswith(LEARNED_GAIN_MEMORY) for name in belief.memory),
        "filter",
        "not have a learned gain in a scenario with feedback",
        "one: its memory refers to the uncorrected process",
        "Choose another filter, or set scenario.closed_loop=false.",
    )
    from pfbench.filter.gaussian.linearisation_rules import DifferenceSpace, TaylorLinearisation

    chart, centre = model.chart, belief.mean.unsqueeze(1)

    def correct_increment(xi: Tensor) -> tuple[Tensor, Tensor]:
        return correct(chart.add(centre, xi)), xi.new_zeros(1, 1, 1, 1)

    space = DifferenceSpace(chart.subtract, chart.mean)
    mean, slope, *_ = TaylorLinearisation()(correct_increment, belief.mean, chart.dimension, space)
    return belief._replace(mean=mean, covariance=slope @ belief.covariance @ slope.mT), info


def correctable_groups(model: StateSpaceModel) -> dict[str, tuple[int, ...]]:
    """Return the component groups of a model, none if its states are not differences."""
    return model.groups if model.chart.size == len(model.names) else {}


# --------------------------------------------------------------------------------------------------
# Batches of runs, which a filter takes together.

_BATCH_NUMBERS = 600_000  # numbers (runs x particles x components) of a batch of runs


def choose_run_batch(runs: int, particles: int, dimension: int, threads: int = 1) -> int:
    """Choose how many runs a step takes together on the CPU.

    Batches have about equal sizes of some 600 000 numbers, so memory depends on the size of a batch
    and not on the number of runs. Smaller batches stay in the cache of a core, but below some 100 000
    numbers the overhead of single operations dominates. [Measured with other processes on the shared
    cache. Growth model, 10 000 particles, 100 runs, float64: batches of 100, 50, 20, 10 runs took
    4.1, 3.1, 3.0, 3.2 s, in float32 2.2, 2.3, 2.3, 2.5 s. 15-state INS, 500 particles, float64: 100 and
    50 runs took 2.0 and 2.4 s.]

    With several threads the number of batches is a multiple of theirs, so that all have work.

    Returns runs per batch.
    """
    batches = max(1, round(runs * particles * dimension / _BATCH_NUMBERS))
    return -(-runs // (-(-batches // threads) * threads))


def _split_runs(
    record: Record, draws: BatchRandomStream, run_batch: int | None
) -> list[tuple[Record, RandomStream]]:
    """Split a record and its random stream into batches of runs.

    Returns Record and random stream of each batch.
    """
    runs = len(record.y)
    if run_batch is None or run_batch >= runs:
        return [(record, draws)]
    batches = [slice(first, first + run_batch) for first in range(0, runs, run_batch)]
    return [(record.select_runs(batch), draws.select_runs(batch)) for batch in batches]


_Advance = Callable[[Sequence[Iterator[StepBlock]]], "list[StepBlock | None]"]


@contextmanager
def _advance_in_threads(threads: int) -> Iterator[_Advance]:
    """Yield a function that returns the next block of each pass, None at its end, by several threads at a time."""
    if threads == 1:
        yield lambda passes: [next(run, None) for run in passes]
        return
    has_gradients = torch.is_grad_enabled()

    def advance_one(run: Iterator[StepBlock]) -> StepBlock | None:
        with torch.set_grad_enabled(has_gradients):  # of a thread, as context variables are
            return next(run, None)

    def advance(passes: Sequence[Iterator[StepBlock]]) -> list[StepBlock | None]:
        jobs = [pool.submit(copy_context().run, advance_one, run) for run in passes]
        return [job.result() for job in jobs]

    with ThreadPoolExecutor(threads) as pool:
        yield advance


def _join_passes(
    passes: Sequence[Iterator[StepBlock]], checked: frozenset[int], advance: _Advance
) -> Iterator[StepBlock]:
    """Join the blocks of several batches of runs, cut where one of them ends.

    The NIS of the checked steps is computed once, for the health and for scores.
    """
    for blocks in _align_blocks(passes, advance):
        block = blocks[0] if len(blocks) == 1 else _join_blocks(blocks)
        infos = {
            t: with_cached_nis(info) if t in checked else info for t, info in block.infos.items()
        }
        yield block._replace(infos=infos)


def _align_blocks(
    passes: Sequence[Iterator[StepBlock]], advance: _Advance
) -> Iterator[list[StepBlock]]:
    """Iterate over blocks of the same steps of each pass."""
    blocks = advance(passes)
    while not any(block is None for block in blocks):
        present = [block for block in blocks if block is not None]
        sizes = [block.mean.shape[1] for block in present]
        size = min(sizes)
        yield [
            block if n == size else block.select(slice(size))
            for block, n in zip(present, sizes, strict=True)
        ]
        ended = iter(advance([run for run, n in zip(passes, sizes, strict=True) if n == size]))
        blocks = [
            next(ended) if n == size else block.select(slice(size, None))
            for block, n in zip(present, sizes, strict=True)
        ]


def _join_blocks(blocks: Sequence[StepBlock], axis: int = 0) -> StepBlock:
    """Join the same steps of several batches of runs, or later steps along axis 1. Kept are the steps that each block has."""
    mean, variance, log_evidence = (
        torch.cat(parts, axis) for parts in zip(*(block[1:4] for block in blocks), strict=True)
    )
    trace = {
        name: torch.cat([block.trace[name] for block in blocks], axis) for name in blocks[0].trace
    }
    steps = [t for t in blocks[0].infos if all(t in block.infos for block in blocks)]
    beliefs = {t: tuple(belief for block in blocks for belief in block.beliefs[t]) for t in steps}
    infos = {t: _join_infos([block.infos[t] for block in blocks]) for t in steps}
    return StepBlock(blocks[0].first, mean, variance, log_evidence, trace, beliefs, infos)


def _join_infos(infos: Sequence[StepInfo]) -> StepInfo:
    """Join the infos of several batches of runs."""
    mean, variance = (
        join_runs([getattr(info, name) for info in infos]) for name in ("mean", "variance")
    )
    trace = {name: join_runs([info.trace[name] for info in infos]) for name in infos[0].trace}

    def join_pairs(name: str) -> Callable[[], tuple[Tensor, Tensor]] | None:
        functions = [getattr(info, name) for info in infos if getattr(info, name) is not None]

        def evaluate() -> tuple[Tensor, Tensor]:
            first, second = zip(*(function() for function in functions), strict=True)
            return torch.cat(first), torch.cat(second)

        return evaluate if functions else None

    def covariance() -> Tensor:
        return torch.cat([info.covariance() for info in infos])

    def group_covariance(groups: Tensor) -> Tensor:
        return torch.cat([info.covariance_of(groups) for info in infos])

    return StepInfo(
        mean, variance, covariance, trace, join_pairs("cloud"), join_pairs("nis"), group_covariance,
        infos[0].has_covariance, join_pairs("conditional"),
    )  # fmt: skip
