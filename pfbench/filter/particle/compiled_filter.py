"""A particle filter whose steps run as compiled functions."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import Filter, GaussianBelief, ParticleBelief, StepInfo, StepSummary
from pfbench.filter.loop import MultiStepFilter, RecordStartedFilter
from pfbench.filter.particle import step_store
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.kernels import dispatch, step_compiler
from pfbench.kernels.step_compiler import (
    NativeEntry,
    TensorFunction,
    compile_function,
    from_storage,
    steps_to_storage,
    to_storage,
)
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")


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
        method: The filter. With moves, or a proposal that stores paths, it runs uncompiled.
        counter: Counter of likelihood evaluations, which compiled steps cannot increment.
        clock: Clock that measures the time of compilation, s.
        builds: Whether a step that is not stored is compiled.
        seconds: Time of compilation so far, s.
        graphs: Compiled step by kind of step; None if that kind runs uncompiled.
    """

    method: ParticleFilter
    counter: CallCounter | None = None
    clock: Callable[[], float] = time.perf_counter
    builds: bool = True
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
        results, _ = self._take_steps(model, belief, with_time_axis, draws, 1)
        return results[0]

    @override
    def take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        t: int,
        draws: RandomStream,
        limit: int,
    ) -> tuple[list[tuple[ParticleBelief, StepInfo]], int]:
        rest = record.select_steps(slice(t, None))
        return self._take_steps(model.at_step(t), belief, rest, draws.at_step(t + 1), limit)

    def _take_steps(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        draws: RandomStream,
        limit: int,
    ) -> tuple[list[tuple[ParticleBelief, StepInfo]], int]:
        """Take several steps of a record. `draws` belongs to the first of them."""
        graph = self._graph(model, belief, record.at_step(0), draws)
        results: list[tuple[ParticleBelief, StepInfo]] = []
        if graph is not None and isinstance(draws, PhiloxStream):
            steps = min(limit, graph.max_steps, record.y.shape[1])
            for after, summary in graph.run_steps(belief, record.select_steps(slice(steps)), draws):
                step_record = partial(record.at_step, len(results))
                results.append((after, self.method.make_info(model, after, summary, step_record)))
            if self.counter:
                self.counter.count += len(results) * graph.evaluations
            if len(results) == steps:
                return results, 2 * steps
            if results:
                belief = results[-1][0]
            draws, limit = draws.at_step(int(draws.step) + len(results)), 1
        results.append(self.method.step(model, belief, record.at_step(len(results)), draws))
        return results, limit

    def _graph(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> CompiledStep | None:
        """Return the compiled step of this kind; None if the step must run uncompiled."""
        grows = self.method.history is not None or self.method.stores_path
        if not isinstance(draws, PhiloxStream) or grows:
            return None
        belief = belief._replace(weights=None)  # a compiled step computes them
        key = id(model), belief.x.shape, len(tensors_in((belief, record)))
        if key not in self.graphs:
            if int(draws.step) == 1:
                return None
            self.graphs[key] = self._compile(model, belief, record, draws)
        return self.graphs[key]

    def _compile(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> CompiledStep | None:
        """Load or compile a step; log a warning and return None if that fails."""
        start_time = self.clock()
        try:
            graph = compile_step(
                self.method, model, belief, record, draws, self.counter, self.builds
            )
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
        if graph is not None:
            done = "was loaded" if graph.is_stored else "compiled"
            log.info("engine=compiled: the step %s in %.1f s", done, elapsed)
        return graph


# --------------------------------------------------------------------------------------------------
# A step of a particle filter as one compiled function of tensors.
#
# A step is a pure function of belief, record, seed, runs and step number. It is recorded once as the
# operations that it consists of, and torch's compiler makes one function of them.

_MAX_NUMBERS = 1 << 20  # results of steps taken together; they share the overhead of a call
_MAX_STEPS_CUDA = 64


class CallCounter(Protocol):
    """Counter of likelihood evaluations of a model."""

    count: int


@dataclass(frozen=True, eq=False)
class CompiledStep:
    """A compiled step for one kind of belief and record.

    Attributes:
        run: (belief, step number, record, seed, runs) -> next belief, mean, variance, predicted log
            weights, trace. None for a step from the store.
        entry: C++ entry of the step, or None.
        memory: Names of the tensors in the belief's memory.
        trace: Names of the step's diagnostics.
        evaluations: Likelihood evaluations of a step.
        max_steps: Steps that may be taken together.
        model: Model of the step. Its identity is the key of the step, so it must stay alive.
        is_stored: Whether the step comes from the store on disk.
    """

    run: TensorFunction | None
    entry: NativeEntry | None
    memory: list[str]
    trace: list[str]
    evaluations: int
    max_steps: int
    model: StateSpaceModel
    is_stored: bool = False

    def run_steps(
        self, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> list[tuple[ParticleBelief, StepSummary]]:
        """Take all steps of a record in one call, without a check of numbers between them.

        Returns belief and summary after each step before the first one with a NaN particle. Shapes:
        record [R, T, Dy].
        """
        first, steps, carried = int(draws.step), record.y.shape[1], 3 + len(self.memory)
        state = _belief_to_storage(belief)
        inputs = [steps_to_storage(a) for a in tensors_in((record.y, record.u))]
        inputs = [torch.arange(first, first + steps), *inputs]
        shared = [to_storage(a) for a in tensors_in((record.start, record.spread))]
        shared += [torch.as_tensor(draws.seed), draws.runs]
        results: list[list[Tensor]] = []
        if self.entry is not None:
            width = carried + 3 + len(self.trace)
            flat = step_compiler.run_steps(
                self.entry.step, self.entry.constants, state, inputs, shared
            )
            results = [flat[k : k + width] for k in range(0, len(flat), width)]
        elif self.run is not None:
            for step_inputs in zip(*(a.unbind() for a in inputs), strict=True):
                stored = self.run([*state, *step_inputs, *shared])
                results.append([from_storage(a) for a in stored])
                state = list(stored[:carried])
        valid = _count_finite([result[carried] for result in results])
        return [self._unpack(result) for result in results[:valid]]

    def _unpack(self, result: list[Tensor]) -> tuple[ParticleBelief, StepSummary]:
        """Return belief and summary from the tensors of a step."""
        carried = 3 + len(self.memory)
        x, log_w, log_z = result[:3]
        memory = dict(zip(self.memory, result[3:carried], strict=True))
        mean, variance, expected = result[carried : carried + 3]
        trace = dict(zip(self.trace, result[carried + 3 :], strict=True))
        return ParticleBelief(x, log_w, log_z, memory=memory), StepSummary(
            mean, variance, expected, trace
        )


def compile_step(
    method: ParticleFilter,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    draws: PhiloxStream,
    counter: CallCounter | None = None,
    builds: bool = True,
) -> CompiledStep | None:
    """Load a filter's step from the store, or record and compile it.

    Its numbers are compared with those of the uncompiled step.

    Returns the compiled step; None if it is not stored and `builds` is false.
    """
    names: list[list[str]] = []
    make = partial(_make_tensor_function, method, model, belief, record, draws)
    state, inputs = _belief_to_storage(belief), [to_storage(a) for a in tensors_in(record)]
    shared = [torch.as_tensor(draws.seed), draws.runs]
    example = [*state, torch.as_tensor(draws.step), *inputs, *shared]
    name = None
    if not example[0].is_cuda and (builds or step_store.has_steps()):
        arguments = belief, record, draws.dtype, draws.runs
        name = step_store.name_step((method, model), arguments, counter)
    if not builds and not (name and step_store.has_step(name)):
        return None
    with _keep_count(counter) as count:
        expected = make(names, record_step=False)(*example)
        evaluations = count()
        run, entry = None, _load_step(name, example, expected, len(state))
        is_stored = entry is not None
        if not is_stored and builds:
            run, entry = _compile_and_store(name, make([]), example, expected, len(state))
    if not is_stored and not builds:
        return None
    memory, trace = names
    carried_shapes = [a.shape for a in expected[: len(state)]]
    keeps_shapes = len(memory) + 3 == len(state) and carried_shapes == [a.shape for a in state]
    max_steps = _choose_max_steps(expected) if keeps_shapes else 1
    return CompiledStep(run, entry, memory, trace, evaluations, max_steps, model, is_stored)


@contextmanager
def _keep_count(counter: CallCounter | None) -> Iterator[Callable[[], int]]:
    """Let a counter count, and restore its count at the end. Yields a function that returns what was counted."""
    before = counter.count if counter else 0
    try:
        yield lambda: counter.count - before if counter else 0
    finally:
        if counter:
            counter.count = before


def _compile_and_store(
    name: str | None,
    step: Callable[..., list[Tensor]],
    example: list[Tensor],
    expected: Sequence[Tensor],
    carried: int,
) -> tuple[TensorFunction, NativeEntry | None]:
    """Compile a step, compare it with the uncompiled one, and store it if it has a name."""
    run, entry = compile_function(step, example)
    _check_agreement(run(example), expected, carried)
    if name and entry:
        step_store.save_step(name, entry, len(expected))
    return run, entry


def _load_step(
    name: str | None, example: list[Tensor], expected: Sequence[Tensor], carried: int
) -> NativeEntry | None:
    """Load a step from the store; remove it and return None if its numbers are not those of the uncompiled one."""
    entry = step_store.load_step(name, example) if name else None
    if entry is None:
        return None
    try:
        batched = [a.unsqueeze(0) for a in example]
        out = step_compiler.run_steps(entry.step, entry.constants, [], batched, [])
        _check_agreement([to_storage(a) for a in out], expected, carried)
    except (ArithmeticError, RuntimeError) as error:
        log.warning("engine=compiled: a stored step is removed (%s)", error)
        step_store.remove_step(Path(entry.library).parent.name)
        return None
    return entry


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
        x, log_w, log_z = (next(remaining) for _ in range(3))
        memory = replace_tensors(belief.memory, remaining)
        step_record = replace_tensors(record, remaining)
        before = belief._replace(x=x, log_w=log_w, log_evidence=log_z, memory=memory)
        stream = PhiloxStream(seed, runs, draws.dtype, number)
        with torch.no_grad(), dispatch.capture_graph(record_step):
            after, summary = method.compute_step(model, before, step_record, stream)
        names[:] = [list(after.memory), list(summary.trace)]
        carried = [after.x, after.log_w, after.log_evidence, *after.memory.values()]
        return [to_storage(a) for a in (*carried, *summary[:3], *summary.trace.values())]

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
    carried = tensors_in((belief.x, belief.log_w, belief.log_evidence, belief.memory))
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
