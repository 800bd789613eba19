"""A particle filter whose steps run as compiled functions."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import (
    ComputedWeights,
    KeptSteps,
    ParticleBelief,
    StepBlock,
    exponentiate,
)
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.taken_steps import (
    MAX_NUMBERS,
    ONE_AT_A_TIME,
    CallCounter,
    TakenSteps,
    WholeStepFilter,
    keep_count,
    tensors_in,
)
from pfbench.kernels import dispatch
from pfbench.kernels.step_compiler import (
    TensorFunction,
    compile_function,
    from_storage,
    steps_to_storage,
    to_storage,
)
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")


@dataclass(eq=False)
class CompiledParticleFilter(WholeStepFilter):
    """Particle filter with compiled steps.

    Random numbers are the same, and results agree to rounding. The first step runs uncompiled,
    because a proposal may start its memory there. The second is recorded and compiled, and small
    steps are taken several at a time. A step with a NaN particle is repeated uncompiled. After it,
    steps are taken one, two, four and so on at a time. If a step cannot be compiled, the filter
    logs a warning and runs uncompiled. Stages must be pure functions, because a compiled step would
    not change a number that a stage stores between steps.

    Attributes:
        method: The filter. It runs uncompiled if it states an obstacle.
        clock: Clock that measures the time of compilation, s.
        seconds: Time of compilation so far, s.
        graphs: Compiled step by kind of step; None if that kind runs uncompiled.
    """

    is_exact = WholeStepFilter.is_exact  # a class that changes steps states them itself
    has_bounded_weights = WholeStepFilter.has_bounded_weights
    clock: Callable[[], float] = time.perf_counter
    seconds: float = 0.0
    graphs: dict[Any, CompiledStep | None] = field(default_factory=dict)

    @property
    def is_active(self) -> bool:
        """True if a kind of step runs compiled."""
        return any(graph is not None for graph in self.graphs.values())

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
        draws = draws.at_step(t + 1)
        step_record = record.at_step(t)
        with ONE_AT_A_TIME:
            model = model.at_step(t)
            graph = self._graph(model, belief, step_record, draws)
        if graph is not None and isinstance(draws, PhiloxStream) and limit:
            steps = min(limit, graph.max_steps, record.y.shape[1] - t)
            rows = selection.select_rows(t, steps)
            block_record = record.select_steps(slice(t, t + steps))
            outcome = graph.run_steps(belief, block_record, draws, rows)
            count = outcome.mean.shape[1] if outcome else 0
            self.count(count * graph.evaluations)
            if outcome:
                block = outcome.make_block(self.method, model, block_record, t, selection)
                return block, outcome.last, 2 * steps if count == steps else 0
        with ONE_AT_A_TIME:
            belief, info = self.method.step(model, belief, step_record, draws)
        return StepBlock.of_step(t, belief, info), belief, 1 if graph is not None else limit

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
            graph = compile_step(self.method, model, belief, record, draws, self.counter)
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


# A step is a pure function of belief, record, seed, runs and step number. It is recorded once as the
# operations that it consists of, and torch's compiler makes one function of them.

# tensors without memory that a step carries: particles, log weights, log evidence, weights
_CARRIED = 4
_MAX_STEPS_CUDA = 64


@dataclass(frozen=True, eq=False)
class CompiledStep:
    """A compiled step for one kind of belief and record.

    Attributes:
        run: (belief, step number, record, seed, runs) -> next belief with its weights, mean, variance, predicted log
            weights, trace.
        memory: Names of the tensors in the belief's memory.
        trace: Names of the step's diagnostics.
        evaluations: Likelihood evaluations of a step.
        max_steps: Steps that may be taken together.
        model: Model of the step. Its identity is the key of the step, so it must stay alive.
    """

    run: TensorFunction
    memory: list[str]
    trace: list[str]
    evaluations: int
    max_steps: int
    model: StateSpaceModel

    def run_steps(
        self, belief: ParticleBelief, record: Record, draws: PhiloxStream, selection: Sequence[int]
    ) -> TakenSteps | None:
        """Take all steps of a record, as far as the first one with a NaN particle; None if that is the first.

        Shapes: record [R, T, Dy]. `selection` has the indices of the steps whose particles are returned.
        """
        first, steps = int(draws.step), record.y.shape[1]
        state, carried = _belief_to_storage(belief), _CARRIED + len(self.memory)
        inputs = [steps_to_storage(a) for a in tensors_in((record.y, record.u))]
        inputs = [torch.arange(first, first + steps), *inputs]
        shared = [to_storage(a) for a in tensors_in((record.start, record.spread))]
        shared += [torch.as_tensor(draws.seed), draws.runs]
        results: list[Sequence[Tensor]] = []
        for step_inputs in zip(*(a.unbind() for a in inputs), strict=True):
            results.append(self.run([*state, *step_inputs, *shared]))
            state = list(results[-1][:carried])
        results = results[: _count_finite([result[carried] for result in results])]
        if not results:
            return None
        numbers = [carried, carried + 1, 2, *range(carried + 3, len(results[0]))]
        joined = [torch.stack([result[k] for result in results], 1) for k in numbers]
        mean, variance, log_evidence, *trace = joined
        clouds = {k: self._read(result) for k, result in enumerate(results)}
        return TakenSteps(
            mean,
            variance,
            log_evidence,
            dict(zip(self.trace, trace, strict=True)),
            {k: clouds[k] for k in selection if k in clouds},
            clouds[len(results) - 1][0],
        )

    def _read(self, result: Sequence[Tensor]) -> tuple[ParticleBelief, Tensor]:
        """Return belief and predicted log weights of a step."""
        carried = _CARRIED + len(self.memory)
        x, log_w, log_evidence, w, *memory = map(from_storage, result[:carried])
        memories = dict(zip(self.memory, memory, strict=True))
        weights = ComputedWeights(log_w, w)
        belief = ParticleBelief(x, log_w, log_evidence, memory=memories, weights=weights)
        return belief, result[carried + 2]


def compile_step(
    method: ParticleFilter,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    draws: PhiloxStream,
    counter: CallCounter | None,
) -> CompiledStep:
    """Record and compile a filter's step. Its numbers are compared with those of the uncompiled step."""
    names: list[list[str]] = []
    make = partial(_make_tensor_function, method, model, belief, record, draws)
    state, inputs = _belief_to_storage(belief), [to_storage(a) for a in tensors_in(record)]
    shared = [torch.as_tensor(draws.seed), draws.runs]
    example = [*state, torch.as_tensor(draws.step), *inputs, *shared]
    with keep_count(counter) as count:
        expected = make(names, record_step=False)(*example)
        evaluations = count()
        run = compile_function(make([]), example)
        _check_agreement(run(example), expected, len(state))
    memory, trace = names
    carried_shapes = [a.shape for a in expected[: len(state)]]
    keeps_shapes = len(memory) + _CARRIED == len(state) and carried_shapes == [
        a.shape for a in state
    ]
    max_steps = _choose_max_steps(expected) if keeps_shapes else 1
    return CompiledStep(run, memory, trace, evaluations, max_steps, model)


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
        return max(1, MAX_NUMBERS // sum(a.numel() for a in out))
    free = torch.cuda.mem_get_info(out[0].device)[0]
    return max(1, min(_MAX_STEPS_CUDA, free // 8 // sum(a.nbytes for a in out)))


def _count_finite(means: list[Tensor]) -> int:
    """Return how many means [R, D] precede the first one that is not finite."""
    if math.isfinite(float(torch.stack(means).sum())):
        return len(means)
    sums = [float(mean.sum()) for mean in means]
    return next((t for t, total in enumerate(sums) if not math.isfinite(total)), len(means))
