"""A step of a particle filter as one compiled function of tensors.

A step is a pure function of belief, record, seed, runs and step number. It is recorded once as the
operations that it consists of, and torch's compiler makes one function of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.particle_moments import StepSummary
from pfbench.kernels import compilation, step_table
from pfbench.kernels.step_compiler import (
    NativeEntry,
    TensorFunction,
    compile_function,
    from_storage,
    steps_to_storage,
    to_storage,
)
from pfbench.model.base import StateSpaceModel

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
            weights, trace.
        entry: C++ entry of `run`, or None.
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

    def run_steps(
        self, belief: ParticleBelief, record: Record, draws: PhiloxStream
    ) -> list[tuple[ParticleBelief, StepSummary]]:
        """Take all steps of a record in one call, without a check of numbers between them.

        Args:
            belief: Belief before the first step.
            record: Measurements [R, T, Dy] and inputs of these steps.
            draws: Random stream at the first step.

        Returns:
            Belief and summary after each step before the first one with a NaN particle.
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
            flat = step_table.run_steps(
                self.entry.step, self.entry.constants, state, inputs, shared
            )
            results = [flat[k : k + width] for k in range(0, len(flat), width)]
        else:
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
) -> CompiledStep:
    """Record and compile a filter's step.

    Args:
        method: Filter without moves.
        model: Model of the step.
        belief: Belief of the shapes to be compiled.
        record: Record of one step.
        draws: Random stream of the step.
        counter: Counter of likelihood evaluations. Its value is restored.

    Returns:
        The compiled step.

    Raises:
        Exception: If the step cannot be recorded or compiled, or if its numbers are not those of
            the uncompiled step. torch raises many kinds.
    """
    names: list[list[str]] = []
    step = _make_tensor_function(method, model, belief, record, draws, names)
    plain_step = _make_tensor_function(method, model, belief, record, draws, [], record_step=False)
    state, inputs = _belief_to_storage(belief), [to_storage(a) for a in tensors_in(record)]
    shared = [torch.as_tensor(draws.seed), draws.runs]
    example = [*state, torch.as_tensor(draws.step), *inputs, *shared]
    count = counter.count if counter else 0
    try:
        run, entry = compile_function(step, example)
        evaluations = counter.count - count if counter else 0
        out = run(example)
        expected = plain_step(*example)
    finally:
        if counter:
            counter.count = count
    memory, trace = names
    _check_agreement(out, expected, len(state))
    carried_shapes = [a.shape for a in out[: len(state)]]
    keeps_shapes = len(memory) + 3 == len(state) and carried_shapes == [a.shape for a in state]
    max_steps = _choose_max_steps(out) if keeps_shapes else 1
    return CompiledStep(run, entry, memory, trace, evaluations, max_steps, model)


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
        with torch.no_grad(), compilation.capture_graph(record_step):
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

    Args:
        out: Results of the compiled step, in storage layout [..., R, N].
        expected: Those of the uncompiled step.
        carried: Number of tensors that the step carries.
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

    Args:
        tree: Nested tuples and dicts.
        tensors: The new tensors, in the order of `tensors_in`.

    Returns:
        The same structure with the new tensors.
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
