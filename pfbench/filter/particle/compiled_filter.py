"""A particle filter whose steps run as compiled functions."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import (
    ComputedWeights,
    Filter,
    GaussianBelief,
    KeptSteps,
    ParticleBelief,
    StepBlock,
    StepInfo,
    StepSummary,
    compute_once,
    exponentiate,
)
from pfbench.filter.linearisation import compute_nis
from pfbench.filter.loop import MultiStepFilter, RecordStartedFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.kernels import dispatch, step_compiler
from pfbench.kernels.step_compiler import (
    NativeEntry,
    TensorFunction,
    compile_function,
    from_storage,
    steps_from_storage,
    steps_to_storage,
    to_storage,
)
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")


# batches of runs in other threads share model and filter, which may remember what they computed
_ONE_AT_A_TIME = threading.RLock()


@dataclass(eq=False)
class CompiledParticleFilter(Filter, MultiStepFilter, RecordStartedFilter):
    """Particle filter with compiled steps.

    Random numbers are the same, and results agree to rounding. The first step runs uncompiled,
    because a proposal may start its memory there. The second is recorded and compiled, and small
    steps are taken several at a time. A step with a NaN particle is repeated uncompiled. After it,
    steps are taken one, two, four and so on at a time. If a step cannot be compiled, the filter
    logs a warning and runs uncompiled. Stages must be pure functions, because a compiled step would
    not change a number that a stage stores between steps.

    Attributes:
        method: The filter. It runs uncompiled if it states an obstacle.
        counter: Counter of likelihood evaluations, which compiled steps cannot increment.
        clock: Clock that measures the time of compilation, s.
        seconds: Time of compilation so far, s.
        graphs: Compiled step by kind of step; None if that kind runs uncompiled.
    """

    method: ParticleFilter
    counter: CallCounter | None = None
    clock: Callable[[], float] = time.perf_counter
    seconds: float = 0.0
    graphs: dict[Any, CompiledStep | None] = field(default_factory=dict)

    @property
    @override
    def is_exact(self) -> bool:
        return self.method.is_exact

    @property
    def has_bounded_weights(self) -> bool:
        """True if the filter states it."""
        return self.method.has_bounded_weights

    @property
    def is_active(self) -> bool:
        """True if a kind of step runs compiled."""
        return any(graph is not None for graph in self.graphs.values())

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
        u = map_inputs(lambda a: a.unsqueeze(1), record.u)
        with_time_axis = record._replace(y=record.y.unsqueeze(1), u=u)
        block, belief, _ = self._take_steps(
            model, belief, with_time_axis, 0, draws, 1, KeptSteps(frozenset())
        )
        return belief, block.infos[0]

    @override
    def take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
        selection: KeptSteps,
    ) -> tuple[StepBlock, ParticleBelief, int]:
        stream = draws.at_step(t + 1)
        with _ONE_AT_A_TIME:
            model = model.at_step(t)
        return self._take_steps(model, belief, record, t, stream, limit, selection)

    def _take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
        selection: KeptSteps,
    ) -> tuple[StepBlock, ParticleBelief, int]:
        """Take steps of a record from `t` on. `model` and `draws` belong to the first of them."""
        step_record = record.at_step(t)
        with _ONE_AT_A_TIME:
            graph = self._graph(model, belief, step_record, draws)
        if graph is not None and isinstance(draws, PhiloxStream) and limit:
            steps = min(limit, graph.choose_steps(selection), record.y.shape[1] - t)
            rows = selection.select_rows(t, steps)
            block_record = record.select_steps(slice(t, t + steps))
            outcome = graph.run_steps(belief, block_record, draws, rows)
            count = outcome.mean.shape[1]
            if self.counter:
                with _ONE_AT_A_TIME:
                    self.counter.count += count * graph.evaluations
            if count:
                block = self._make_block(model, block_record, t, outcome, selection)
                return block, outcome.last, 2 * steps if count == steps else 0
        with _ONE_AT_A_TIME:
            belief, info = self.method.step(model, belief, step_record, draws)
        return StepBlock.of_step(t, belief, info), belief, 1 if graph is not None else limit

    def _make_block(
        self,
        model: StateSpaceModel,
        record: Record,
        first: int,
        outcome: TakenSteps,
        selection: KeptSteps,
    ) -> StepBlock:
        """Return the block of steps that were taken together, from number `first` on."""
        infos = {
            first + k: self.method.make_info(
                model, belief, outcome.summarise(k), partial(record.at_step, k)
            )
            for k, (belief, _) in outcome.selection.items()
        }
        checked = [k for k in outcome.selection if first + k in selection.checked]
        x = outcome.last.x
        if len(x) == 1 and len(checked) * x.numel() <= _MAX_NUMBERS:  # as `may_join_steps`
            pairs = _compute_nis_together(model, record, {k: outcome.selection[k] for k in checked})
            for k, nis in zip(checked, pairs, strict=True):
                infos[first + k] = infos[first + k]._replace(nis=nis)
        beliefs = {first + k: (belief,) for k, (belief, _) in outcome.selection.items()}
        moments = outcome.mean, outcome.variance, outcome.log_evidence
        return StepBlock(first, *moments, outcome.trace, beliefs, infos)

    def _graph(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> CompiledStep | None:
        """Return the compiled step of this kind; None if the step must run uncompiled."""
        if not isinstance(draws, PhiloxStream) or self.method.obstacle:
            return None
        belief = belief._replace(weights=None)  # a compiled step carries them as a tensor
        key = id(model), belief.x.shape, len(tensors_in((belief, record)))
        if key not in self.graphs:
            if int(draws.step) == 1:
                return None
            self.graphs[key] = self._compile(model, belief, record, draws)
        return self.graphs[key]

    def _compile(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> CompiledStep | None:
        """Compile a step; log a warning and return None if that fails."""
        start_time = self.clock()
        try:
            parts = StepParts(self.method, model, belief, record, draws, self.counter)
            graph = compile_step(parts)
        except Exception as error:  # torch raises many kinds
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning(
                "engine=compiled: this step cannot be compiled (%s). Using compiled kernels only",
                reason,
            )
            log.debug("compilation failed", exc_info=True)
            return None
        elapsed = self.clock() - start_time
        self.seconds += elapsed
        log.info("engine=compiled: the step compiled in %.1f s", elapsed)
        return graph


# --------------------------------------------------------------------------------------------------
# A step of a particle filter as one compiled function of tensors.
#
# A step is a pure function of belief, record, seed, runs and step number. It is recorded once as the
# operations that it consists of, and torch's compiler makes one function of them.

_MAX_NUMBERS = 1 << 20  # results of steps taken together; they share the overhead of a call
# tensors without memory that a step carries: particles, log weights, log evidence, weights
_CARRIED = 4
_UNKEPT = (
    8  # times as many steps where particles of few steps are kept: about 0.1 s without a signal
)
_MAX_STEPS_CUDA = 64


class CallCounter(Protocol):
    """Counter of likelihood evaluations of a model."""

    count: int


@dataclass(frozen=True, eq=False)
class CompiledStep:
    """A compiled step for one kind of belief and record.

    Attributes:
        run: (belief, step number, record, seed, runs) -> next belief with its weights, mean, variance, predicted log
            weights, trace.
        entry: C++ entry of the step, or None.
        memory: Names of the tensors in the belief's memory.
        trace: Names of the step's diagnostics.
        evaluations: Likelihood evaluations of a step.
        max_steps: Steps that may be taken together.
        model: Model of the step. Its identity is the key of the step, so it must stay alive.
    """

    run: TensorFunction
    entry: NativeEntry | None
    memory: list[str]
    trace: list[str]
    evaluations: int
    max_steps: int
    model: StateSpaceModel

    def choose_steps(self, selection: KeptSteps) -> int:
        """Return how many steps may be taken together: fewer where all of them are kept, and where the device is a GPU."""
        grows = selection.all_steps or self.entry is None
        return self.max_steps if grows or self.max_steps == 1 else _UNKEPT * self.max_steps

    def run_steps(
        self, belief: ParticleBelief, record: Record, draws: PhiloxStream, selection: Sequence[int]
    ) -> TakenSteps:
        """Take all steps of a record in one call, as far as the first one with a NaN particle.

        Shapes: record [R, T, Dy]. `selection` has the indices of the steps whose particles are returned.
        """
        first, steps = int(draws.step), record.y.shape[1]
        state = _belief_to_storage(belief)
        inputs = [steps_to_storage(a) for a in tensors_in((record.y, record.u))]
        inputs = [torch.arange(first, first + steps), *inputs]
        shared = [to_storage(a) for a in tensors_in((record.start, record.spread))]
        shared += [torch.as_tensor(draws.seed), draws.runs]
        if self.entry is not None:
            kept_steps = torch.tensor(selection, dtype=torch.int64)
            flat = step_compiler.run_steps(
                self.entry.step,
                self.entry.constants,
                state,
                inputs,
                shared,
                self._joined,
                kept_steps,
            )
            count = len(self._joined)
            return self._unpack(flat[:count], flat[count:], selection)
        return self._run_from_python(state, inputs, shared, selection)

    @cached_property
    def _joined(self) -> Tensor:
        """Numbers of the results without an axis of particles: mean (the first that is checked), variance, evidence and trace."""
        carried = _CARRIED + len(self.memory)
        trace = range(carried + 3, carried + 3 + len(self.trace))
        return torch.tensor([carried, carried + 1, 2, *trace])

    def _run_from_python(
        self,
        state: list[Tensor],
        inputs: list[Tensor],
        shared: list[Tensor],
        selection: Sequence[int],
    ) -> TakenSteps:
        """Take steps by the function of torch's compiler, called from Python."""
        carried, joined = _CARRIED + len(self.memory), self._joined.tolist()
        results: list[Sequence[Tensor]] = []
        for step_inputs in zip(*(a.unbind() for a in inputs), strict=True):
            results.append(self.run([*state, *step_inputs, *shared]))
            state = list(results[-1][:carried])
        valid = _count_finite([result[carried] for result in results])
        blocks = [
            torch.stack([result[k] for result in results[:valid]])
            if valid
            else results[0][k].unsqueeze(0)[:0]
            for k in joined
        ]
        returned = sorted({k for k in selection if k < valid} | ({valid - 1} if valid else set()))
        others = [
            from_storage(a) for t in returned for k, a in enumerate(results[t]) if k not in joined
        ]
        return self._unpack(blocks, others, selection)

    def _unpack(
        self, joined: Sequence[Tensor], others: Sequence[Tensor], selection: Sequence[int]
    ) -> TakenSteps:
        """Return the results of steps from their tensors: joined ones [S, ...], others of the kept steps and of the last one."""
        mean, variance, log_evidence, *trace = map(steps_from_storage, joined)
        steps = mean.shape[1]
        rows = [k for k in selection if k < steps]
        rows += [steps - 1] if steps and steps - 1 not in rows else []
        width = _CARRIED + len(
            self.memory
        )  # all that is carried less the evidence, and predicted log weights
        results: dict[int, tuple[ParticleBelief, Tensor]] = {}
        for index, k in enumerate(rows):
            x, log_w, w, *memory, expected = others[index * width : (index + 1) * width]
            named_memory, weights = (
                dict(zip(self.memory, memory, strict=True)),
                ComputedWeights(log_w, w),
            )
            belief = ParticleBelief(
                x, log_w, log_evidence[:, k], memory=named_memory, weights=weights
            )
            results[k] = belief, expected
        last = results[rows[-1]][0] if rows else None
        kept_results = {k: value for k, value in results.items() if k in selection}
        named_trace = dict(zip(self.trace, trace, strict=True))
        return TakenSteps(mean, variance, log_evidence, named_trace, kept_results, last)


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


class StepParts(NamedTuple):
    """All that a step consists of: filter, model, what it takes, and the counter of the model's evaluations."""

    method: ParticleFilter
    model: StateSpaceModel
    belief: ParticleBelief
    record: Record
    draws: PhiloxStream
    counter: CallCounter | None = None


def compile_step(parts: StepParts) -> CompiledStep:
    """Record and compile a filter's step. Its numbers are compared with those of the uncompiled step."""
    method, model, belief, record, draws, counter = parts
    names: list[list[str]] = []
    make = partial(_make_tensor_function, method, model, belief, record, draws)
    state, inputs = _belief_to_storage(belief), [to_storage(a) for a in tensors_in(record)]
    shared = [torch.as_tensor(draws.seed), draws.runs]
    example = [*state, torch.as_tensor(draws.step), *inputs, *shared]
    with _keep_count(counter) as count:
        expected = make(names, record_step=False)(*example)
        evaluations = count()
        run, entry = compile_function(make([]), example)
        _check_agreement(run(example), expected, len(state))
    memory, trace = names
    carried_shapes = [a.shape for a in expected[: len(state)]]
    keeps_shapes = len(memory) + _CARRIED == len(state) and carried_shapes == [
        a.shape for a in state
    ]
    max_steps = _choose_max_steps(expected) if keeps_shapes else 1
    return CompiledStep(run, entry, memory, trace, evaluations, max_steps, model)


@contextmanager
def _keep_count(counter: CallCounter | None) -> Iterator[Callable[[], int]]:
    """Let a counter count, and restore its count at the end. Yields a function that returns what was counted."""
    before = counter.count if counter else 0
    try:
        yield lambda: counter.count - before if counter else 0
    finally:
        if counter:
            counter.count = before


def _make_tensor_function(
    method: ParticleFilter,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    draws: PhiloxStream,
    names: list[list[str]],
    record_step: bool = True,
) -> Callable[..., list[Tensor]]:
    """Return a step as a function of tensors, to be recorded or uncompiled. It writes its memory and trace names."""
    carried_count = len(_belief_to_storage(belief))

    def step(*flat: Tensor) -> list[Tensor]:
        number, *inputs, seed, runs = flat[carried_count:]
        remaining = map(from_storage, [*flat[:carried_count], *inputs])
        x, log_w, log_z, w = (next(remaining) for _ in range(_CARRIED))
        memory = replace_tensors(belief.memory, remaining)
        step_record = replace_tensors(record, remaining)
        weights = ComputedWeights(log_w, w)
        before = belief._replace(
            x=x, log_w=log_w, log_evidence=log_z, memory=memory, weights=weights
        )
        stream = PhiloxStream(seed, runs, draws.dtype, number)
        with torch.no_grad(), dispatch.capture_graph(record_step):
            after, summary = method.compute_step(model, before, step_record, stream)
        names[:] = [list(after.memory), list(summary.trace)]
        carried = _belief_to_storage(after)
        return [*carried, *map(to_storage, (*summary[:3], *summary.trace.values()))]

    return step


def _check_agreement(out: Sequence[Tensor], expected: Sequence[Tensor], carried: int) -> None:
    """Raise ArithmeticError unless a compiled step gives the numbers of the uncompiled step.

    The tensors that the step carries are compared, component by component over all particles, with
    their spread as the scale. Sums that are rounded in another order may choose other ancestors, so a
    few particles may differ: almost none in double precision.

    Shapes: out [..., R, N].
    """
    for k, (a, b) in enumerate(zip(out[:carried], expected[:carried], strict=True)):
        if a.shape != b.shape:
            raise ArithmeticError(
                f"its tensor {k} must have the shape {list(b.shape)}, got {list(a.shape)}. Use engine=kernels."
            )
        is_double = b.dtype == torch.float64
        a, b, axes = a.double(), b.double(), tuple(range(max(b.dim() - 2, 0), b.dim()))
        finite = torch.where(torch.isfinite(b), b, torch.zeros_like(b))
        spread = finite.amax(axes, keepdim=True) - finite.amin(axes, keepdim=True)
        limit = (1e-5 * spread + 1e-8 * b.abs()) if is_double else (1e-2 * spread + 1e-4 * b.abs())
        agrees = ((a - b).abs() <= limit + 1e-12) | (a == b) | (torch.isnan(a) & torch.isnan(b))
        share = float(agrees.double().mean())
        if share < (0.999 if is_double else 0.8):
            raise ArithmeticError(
                f"its numbers must be those of the uncompiled step, got others in {1 - share:.1%} of tensor {k}. Use engine=kernels."
            )


def tensors_in(tree: Any) -> list[Tensor]:
    """Return the tensors of nested tuples and dicts, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    subtrees = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, tuple) else ()
    return [a for subtree in subtrees for a in tensors_in(subtree)]


def replace_tensors(tree: Any, tensors: Iterator[Tensor]) -> Any:
    """Replace the tensors of nested tuples and dicts.

    Returns the same structure with the new tensors.
    """
    if isinstance(tree, Tensor):
        return next(tensors)
    if isinstance(tree, dict):
        return {name: replace_tensors(subtree, tensors) for name, subtree in tree.items()}
    if isinstance(tree, tuple):
        subtrees = [replace_tensors(subtree, tensors) for subtree in tree]
        return type(tree)(*subtrees) if hasattr(tree, "_fields") else tuple(subtrees)
    return tree


def _belief_to_storage(belief: ParticleBelief) -> list[Tensor]:
    """Return the tensors that a step carries, in storage layout."""
    w = exponentiate(belief.log_w, belief.weights)
    carried = tensors_in((belief.x, belief.log_w, belief.log_evidence, w, belief.memory))
    return [to_storage(a) for a in carried]


def _choose_max_steps(out: Sequence[Tensor]) -> int:
    """Return how many steps of this size may be taken together, by memory."""
    if not out[0].is_cuda:
        return max(1, _MAX_NUMBERS // sum(a.numel() for a in out))
    free = torch.cuda.mem_get_info(out[0].device)[0]
    return max(1, min(_MAX_STEPS_CUDA, free // 8 // sum(a.nbytes for a in out)))


def _count_finite(means: list[Tensor]) -> int:
    """Return how many means [R, D] precede the first one that is not finite."""
    if math.isfinite(float(torch.stack(means).sum())):
        return len(means)
    sums = [float(mean.sum()) for mean in means]
    return next((t for t, total in enumerate(sums) if not math.isfinite(total)), len(means))
