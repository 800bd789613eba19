"""The time loop of every filter: `TimedFilterPass` steps a belief through a record.

`run_filter`, training, online inference and filters that take several steps together all use it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from pfbench.core.random_stream import BatchRandomStream, RandomStream
from pfbench.core.record import FeedbackRun, Record, iterate_steps
from pfbench.filter.belief import Filter, GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.gaussian.linearisation_rules import DifferenceSpace, TaylorLinearisation
from pfbench.model.base import StateSpaceModel

_BATCH_NUMBERS = 1_000_000  # numbers (runs x particles x components) of a batch of runs

Watch = Callable[[int, StepInfo], dict[str, Tensor]]


class FilterResult(NamedTuple):
    """Result of a filter on a record.

    Attributes:
        mean: State estimate, [R, T, D]. NaN from the step at which a run is lost. With feedback,
            the estimate as it would read without any correction.
        variance: Diagonal of the covariance in the chart, [R, T, d]. NaN as in `mean`.
        log_evidence: log p(y_1:T), [R]. -inf where the run is lost.
        trace: Diagnostics per run and step, {name: [R, T]}: `ess`, `resampled` and the results of
            `watch`.
    """

    mean: Tensor
    variance: Tensor
    log_evidence: Tensor
    trace: dict[str, Tensor]

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
    ) -> tuple[list[tuple[Any, StepInfo]], int]:
        """Take at least one and at most `limit` steps from step `t` on.

        Args:
            model: State-space model. It is asked for the model of each step.
            belief: Belief before step `t`.
            record: Whole record, prepared by the model.
            t: First step, from 0. Step t uses `draws.at_step(t + 1)`.
            draws: Random stream of the whole record.
            limit: Maximum number of steps.

        Returns:
            Belief and info after each step, and the limit of the next call.
        """


class PassStep(NamedTuple):
    """One step of a `TimedFilterPass`.

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


class FilterPass:
    """One pass of a filter over a record, step by step.

    Iterating takes the steps. Between two steps the caller may replace `belief`, and `model` by one
    with other parameters.

    Args:
        method: The filter.
        model: State-space model.
        record: Measurements [R, T, Dy] and inputs, prepared by the model (`prepare_record`).
        draws: Random stream. Step 0 is the initial distribution, step t + 1 the record's step t.
        feedback: Process that the estimates correct, or None.
        lookahead: Allow several steps in one call, where the filter can do so. The caller must then
            leave belief and model alone. Not used with feedback.

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
        lookahead: bool = False,
    ) -> None:
        self.method, self.model, self.record, self.draws = method, model, record, draws
        self.feedback, self.lookahead = feedback, lookahead and feedback is None
        self.belief: Any = method.init(
            model, len(record.y), draws.at_step(0), record.start, record.spread
        )

    def at_step(self, t: int) -> StateSpaceModel:
        """Return the present model of step t."""
        return self.model.at_step(t)

    def __iter__(self) -> Iterator[PassStep]:
        pending: deque[tuple[Any, StepInfo]] = deque()
        limit = self.record.y.shape[1]
        several = (
            self.method if self.lookahead and isinstance(self.method, MultiStepFilter) else None
        )
        for t, model, record in iterate_steps(self, self.record):
            draws = self.draws.at_step(t + 1)
            if several is not None:
                if not pending:
                    results, limit = several.take_steps(
                        self.model, self.belief, self.record, t, self.draws, limit
                    )
                    pending.extend(results)
                self.belief, info = pending.popleft()
            elif self.feedback is not None:
                record = prepare_record(self.model, self.feedback.at_step(t)).at_step(0)
                belief, info = self.method.step(model, self.belief, record, draws)
                self.belief, info = apply_feedback(self.model, self.feedback, belief, info)
            else:
                self.belief, info = self.method.step(model, self.belief, record, draws)
            yield PassStep(t, model, record, info, draws)


def prepare_record(model: StateSpaceModel, record: Record) -> Record:
    """Compute a record's inputs for a model, on its device and in its precision.

    Args:
        model: State-space model.
        record: Measurements [R, T, Dy] and inputs.

    Returns:
        The prepared record. Initial states and factors are those of `record`.
    """
    start, spread = (
        None if a is None else a.to(model.anchor) for a in (record.start, record.spread)
    )
    return model.prepare(record).to(model.anchor)._replace(start=start, spread=spread)


def run_filter(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: BatchRandomStream,
    watch: Watch | None = None,
    on_step: Callable[[], object] | None = None,
    run_batch: int | None = None,
) -> FilterResult:
    """Run a filter over a record, all runs as one batch.

    Args:
        method: The filter.
        model: State-space model of the filter.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream. Step 0 is the initial distribution, step t the t-th measurement.
        watch: (t, info) -> {name: [R] or [R, ...]}, for results other than mean and variance. It
            cannot influence the filter.
        tick: Called after each step (progress bar).
        at_once: Runs that a step takes together, one batch after the other. None takes all. The
            result agrees to rounding (`runs_at_once`). With feedback all runs go together.

    Returns:
        Means, variances, evidence and diagnostics.

    Raises:
        ValueError: If the record is empty or has infinite values, or if model or filter do not
            support the record's feedback.
    """
    if record.y.shape[1] == 0:
        raise ValueError("record.y must have at least one time step, got 0. Add measurements.")
    if bool(torch.isinf(record.y).any()):
        raise ValueError("record.y must be finite, got infinity. Mark a missing component as NaN.")
    feedback = None
    if record.feedback is not None:
        feedback = record.feedback.begin(record, _correctable_groups(model))
    record = prepare_record(model, record)
    runs = record.y.shape[0]
    size = runs if run_batch is None or feedback is not None else run_batch
    parts: list[tuple[Record, RandomStream]] = [(record, draws)]
    if size < runs:
        batches = [slice(first, first + size) for first in range(0, runs, size)]
        parts = [(record.select_runs(batch), draws.select_runs(batch)) for batch in batches]
    passes = [FilterPass(method, model, *part, feedback, lookahead=True) for part in parts]
    means, variances, evidences, traces = [], [], [], []
    for t, steps in enumerate(zip(*passes, strict=True)):
        info = _join_infos([step.info for step in steps])
        means.append(info.mean)
        variances.append(info.variance)
        evidences.append(_join([part.belief.log_evidence for part in passes]))
        traces.append(info.trace | (watch(t, info) if watch else {}))
        if on_step:
            on_step()
    trace = {name: torch.stack([row[name] for row in traces], 1) for name in traces[0]}
    valid = torch.isfinite(torch.stack(evidences, 1)).unsqueeze(-1)
    mean, variance = (
        torch.where(valid, torch.stack(rows, 1), torch.nan) for rows in (means, variances)
    )
    return FilterResult(mean, variance, evidences[-1], trace)


def choose_run_batch(runs: int, particles: int, dimension: int) -> int:
    """Choose how many runs a step takes together on the CPU.

    Batches have about equal size and a million numbers each, so memory depends on the size of a
    batch and not on the number of runs. Smaller batches would stay in the cache of a core, but below
    some 100 000 numbers the overhead of single operations dominates. [Measured on a 15-state INS
    with 500 particles: 100 runs together were 10 % faster than 50 on an idle machine, and 33 %
    slower while other processes used the shared cache.]

    Args:
        runs: Number of runs.
        particles: Number of particles of a run.
        dimension: Number of components of a particle.

    Returns:
        Runs per batch.
    """
    return -(-runs // max(1, round(runs * particles * dimension / _BATCH_NUMBERS)))


def _join(parts: list[Tensor]) -> Tensor:
    """Concatenate the parts of a batch of runs; return a single part unchanged."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _join_infos(infos: list[StepInfo]) -> StepInfo:
    """Join the infos of batches of runs."""
    if len(infos) == 1:
        return infos[0]
    mean, variance = (
        _join([getattr(info, name) for info in infos]) for name in ("mean", "variance")
    )
    trace = {name: _join([info.trace[name] for info in infos]) for name in infos[0].trace}

    def pairs(name: str) -> Callable[[], tuple[Tensor, Tensor]] | None:
        functions = [getattr(info, name) for info in infos if getattr(info, name) is not None]

        def joined() -> tuple[Tensor, Tensor]:
            first, second = zip(*(function() for function in functions), strict=True)
            return torch.cat(first), torch.cat(second)

        return joined if functions else None

    def covariance() -> Tensor:
        return torch.cat([info.covariance() for info in infos])

    def covariance_of_groups(groups: Tensor) -> Tensor:
        return torch.cat([info.covariance_of(groups) for info in infos])

    return StepInfo(
        mean, variance, covariance, trace, pairs("cloud"), pairs("nis"), covariance_of_groups
    )


def apply_feedback(
    model: StateSpaceModel,
    feedback: FeedbackRun,
    belief: ParticleBelief | GaussianBelief,
    info: StepInfo,
) -> tuple[ParticleBelief | GaussianBelief, StepInfo]:
    """Correct the process by the estimate of valid runs, and the belief accordingly.

    The mean of a Gaussian belief is moved. Its covariance is transformed by the derivative of that
    move, since a rotation of the axes turns it [ours].

    Args:
        model: State-space model.
        feedback: Process that the estimate corrects.
        belief: Belief after the step.
        info: Estimate of the step.

    Returns:
        Belief about the corrected process, and the info with the uncorrected estimate.

    Raises:
        ValueError: If particles carry their past, which refers to the uncorrected process.
    """
    valid = torch.isfinite(belief.log_evidence).unsqueeze(-1)
    uncorrected, correct = feedback.correct(torch.where(valid, info.mean, 0.0))
    info = info._replace(mean=torch.where(valid, uncorrected.to(info.mean), info.mean))
    if isinstance(belief, ParticleBelief):
        if belief.window or belief.memory:
            raise ValueError(
                "filter must not store a particle's past in a scenario with feedback, got one with "
                "moves or a proposal's memory. Choose another filter, or set scenario.closed_loop=false."
            )
        return belief._replace(x=correct(belief.x)), info
    chart, centre = model.chart, belief.mean.unsqueeze(1)

    def corrected(xi: Tensor) -> tuple[Tensor, Tensor]:
        return correct(chart.add(centre, xi)), xi.new_zeros(1, 1, 1, 1)

    space = DifferenceSpace(chart.subtract, chart.mean)
    mean, slope, *_ = TaylorLinearisation()(corrected, belief.mean, chart.dimension, space)
    return belief._replace(mean=mean, covariance=slope @ belief.covariance @ slope.mT), info


def _correctable_groups(model: StateSpaceModel) -> dict[str, tuple[int, ...]]:
    """Return the component groups of a model whose states are differences, else none."""
    return model.groups if model.chart.size == len(model.names) else {}
