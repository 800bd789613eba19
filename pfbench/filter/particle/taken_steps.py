"""Steps of a particle filter that are taken together by another engine: their moments, and the particles of those that are read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import (
    Filter,
    GaussianBelief,
    KeptSteps,
    ParticleBelief,
    StepBlock,
    StepInfo,
    StepSummary,
    compute_once,
)
from pfbench.filter.linearisation import compute_nis
from pfbench.filter.loop import MultiStepFilter, RecordStartedFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.base import StateSpaceModel

MAX_NUMBERS = 1 << 20  # results of steps taken together; they share the overhead of a call

# batches of runs in other threads share model and filter, which may remember what they computed
ONE_AT_A_TIME = threading.RLock()


class CallCounter(Protocol):
    """Counter of likelihood evaluations of a model."""

    count: int


@contextmanager
def keep_count(counter: CallCounter | None) -> Iterator[Callable[[], int]]:
    """Let a counter count, and restore its count at the end. Yields a function that returns what was counted."""
    before = counter.count if counter else 0
    try:
        yield lambda: counter.count - before if counter else 0
    finally:
        if counter:
            counter.count = before


def tensors_in(tree: Any) -> list[Tensor]:
    """Return the tensors of nested tuples, lists and dicts, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    branches = tree.values() if isinstance(tree, dict) else tree
    return [a for branch in branches for a in tensors_in(branch)] if isinstance(tree, tuple | list | dict) else []  # fmt: skip


@dataclass(eq=False)
class WholeStepFilter(Filter, MultiStepFilter, RecordStartedFilter):
    """Particle filter some of whose steps another engine takes together.

    Attributes:
        method: The filter.
        counter: Counter of likelihood evaluations, which the other engine cannot increment.
    """

    method: ParticleFilter
    counter: CallCounter | None = None

    @property
    @override
    def is_exact(self) -> bool:
        return self.method.is_exact

    @property
    def has_bounded_weights(self) -> bool:
        """True if the filter states it."""
        return self.method.has_bounded_weights

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief | GaussianBelief:
        return self.method.init(model, runs, draws, start, spread)

    @override
    def init_from_record(
        self, model: StateSpaceModel, record: Record, draws: RandomStream
    ) -> ParticleBelief:
        return self.method.init_from_record(model, record, draws)

    @override
    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Take a step by the filter itself, as where an estimate corrects the process."""
        return self.method.step(model, belief, record, draws)

    def count(self, evaluations: int) -> None:
        """Count evaluations of the model."""
        with ONE_AT_A_TIME:
            if self.counter:
                self.counter.count += evaluations


class TakenSteps(NamedTuple):
    """Results of steps that were taken together.

    Attributes:
        mean: [R, S, D].
        variance: [R, S, d].
        log_evidence: [R, S].
        trace: {name: [R, S]}.
        selection: Belief and predicted log weights [R, N] after the kept steps, by index.
        last: Belief after the last step; None if there is none.
    """

    mean: Tensor
    variance: Tensor
    log_evidence: Tensor
    trace: dict[str, Tensor]
    selection: dict[int, tuple[ParticleBelief, Tensor]]
    last: Any

    def summarise(self, k: int) -> StepSummary:
        """Return the summary of a kept step."""
        trace = {name: a[:, k] for name, a in self.trace.items()}
        return StepSummary(self.mean[:, k], self.variance[:, k], self.selection[k][1], trace)

    def make_block(
        self,
        method: ParticleFilter,
        model: StateSpaceModel,
        record: Record,
        first: int,
        selection: KeptSteps,
    ) -> StepBlock:
        """Return the block of these steps, from number `first` on, of their record."""
        infos = {
            first + k: method.make_info(
                model, belief, self.summarise(k), partial(record.at_step, k)
            )
            for k, (belief, _) in self.selection.items()
        }
        checked = [k for k in self.selection if first + k in selection.checked]
        x = self.last.x
        if len(x) == 1 and len(checked) * x.numel() <= MAX_NUMBERS:
            pairs = _compute_nis_together(model, record, {k: self.selection[k] for k in checked})
            for k, nis in zip(checked, pairs, strict=True):
                infos[first + k] = infos[first + k]._replace(nis=nis)
        beliefs = {first + k: (belief,) for k, (belief, _) in self.selection.items()}
        moments = self.mean, self.variance, self.log_evidence
        return StepBlock(first, *moments, self.trace, beliefs, infos)


def _compute_nis_together(
    model: StateSpaceModel, record: Record, steps: dict[int, tuple[ParticleBelief, Tensor]]
) -> list[Callable[[], tuple[Tensor, Tensor]]]:
    """Return functions of the NIS of some steps of a single run, which compute it for all of them at once."""

    @compute_once
    def compute() -> tuple[Tensor, Tensor]:
        x = torch.cat([belief.x.permute(2, 0, 1) for belief, _ in steps.values()], 1)
        log_w = torch.cat([expected for _, expected in steps.values()])
        return compute_nis(model, x.permute(1, 2, 0), log_w, record.steps_as_runs(list(steps)))

    def select(index: int) -> tuple[Tensor, Tensor]:
        nis, observed = compute()
        return nis[index : index + 1], observed[index : index + 1]

    return [partial(select, index) for index in range(len(steps))]
