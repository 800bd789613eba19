"""A filter's step as one compiled graph.

A step is a pure function of tensors: belief, what is seen, seed, runs and number of the step. It is recorded once, as the
operations that it is made of, and torch's compiler makes one function of them; loops written by hand stay whole in it.
What the compiler made is kept on disk by torch, for later jobs that are alike.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from pfbench import fusion
from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Cloud, Gaussian, Info
from pfbench.filter.particle import ParticleFilter, Told
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

log = logging.getLogger("pfbench")

Graph = Callable[[list[Tensor]], Any]


class Counter(Protocol):
    """Counts what a step asks of the model, in its own time."""

    count: int


@dataclass(eq=False)
class Compiled:
    """A particle filter whose steps run compiled, with the same draws and, to rounding, the same results.

    The first step runs as it is, since there a proposal may begin what it carries along. The second is recorded and
    compiled. From then on a step in which a particle has become NaN is done again uncompiled.
    Where anything about this fails, the filter goes on uncompiled and says so. A stage that kept numbers of its own from step to
    step would have them frozen; stages keep none.

    Args:
        method: the filter. Moves carry a past that grows; with them it runs uncompiled.
        counter: counts the model's evaluations, which a graph does unseen.
        clock: by which it is told how long compiling took.

    Attributes:
        seconds: what compiling took.
        graphs: of each kind of step that was met: None where it runs uncompiled.
    """

    method: ParticleFilter
    counter: Counter | None = None
    clock: Callable[[], float] = time.perf_counter
    seconds: float = 0.0
    graphs: dict[Any, Any] = field(default_factory=dict)

    @property
    def exact(self) -> bool:
        return self.method.exact

    @property
    def at_work(self) -> bool:
        """Did any kind of step run compiled?"""
        return any(isinstance(kind, tuple) for kind in self.graphs.values())

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud | Gaussian:
        return self.method.init(model, runs, draws, start, spread)

    def step(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Info]:
        if not isinstance(draws, MonteCarlo) or self.method.keeper is not None:
            return self.method.step(model, belief, seen, draws)
        tensors: list[Tensor] = []
        _collect((belief.x, belief.log_w, belief.log_z, belief.memory, seen), tensors)
        key = id(model), belief.x.shape, len(tensors)
        if key not in self.graphs:
            self.graphs[key] = _Once()
            return self.method.step(model, belief, seen, draws)
        known = self.graphs[key]
        if isinstance(known, _Once):
            known = self.graphs[key] = self._recorded(model, belief, seen, draws, tensors)
        if known is None:
            return self.method.step(model, belief, seen, draws)
        run, asked = known
        out, told = run(tensors, draws)
        if not told.mean.is_cuda and not math.isfinite(float(told.mean.sum())):
            return self.method.step(model, belief, seen, draws)
        if self.counter:
            self.counter.count += asked
        return out, self.method.tell(model, out, told, seen)

    def _recorded(
        self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: MonteCarlo, tensors: list[Tensor]
    ) -> tuple[Callable[[list[Tensor], MonteCarlo], tuple[Cloud, Told]], int] | None:
        """The step of such a belief and record as a function of its tensors, and how often it evaluates the model's law.

        None where it cannot be had.
        """
        begun = self.clock()
        names: list[list[str]] = []

        def step(*flat: Tensor) -> list[Tensor]:
            *given, seed, runs, number = flat
            rest = map(_seen_as, given)
            x, log_w, log_z = (next(rest) for _ in range(3))
            memory, record = _replaced(belief.memory, rest), _replaced(seen, rest)
            with torch.no_grad(), fusion.graph():
                before = belief._replace(x=x, log_w=log_w, log_z=log_z, memory=memory)
                cloud, told = self.method.advance(model, before, record, MonteCarlo(seed, runs, draws.dtype, number))
            names[:] = [list(cloud.memory), list(told.trace)]
            found = [cloud.x, cloud.log_w, cloud.log_z, *cloud.memory.values(), *told[:3], *told.trace.values()]
            return [_stored(part) for part in found]

        def run_of(draws: MonteCarlo) -> list[Tensor]:
            return [torch.as_tensor(draws.seed), draws.runs, torch.as_tensor(draws.step)]

        counted = self.counter.count if self.counter else 0
        example = [_stored(a) for a in tensors] + run_of(draws)
        try:
            run = _compiled(step, example)
            per_step = (self.counter.count if self.counter else 0) - counted
            run(example)
        except Exception as error:  # torch raises many kinds
            why = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning("engine=compiled: this step cannot be compiled (%s); going on with compiled loops alone", why)
            return None
        finally:
            if self.counter:
                self.counter.count = counted
        memory_names, trace_names = names
        first = 3 + len(memory_names)

        def call(given: list[Tensor], draws: MonteCarlo) -> tuple[Cloud, Told]:
            found = [_seen_as(part) for part in run([_stored(a) for a in given] + run_of(draws))]
            x, log_w, log_z = found[:3]
            mean, variance, expected = found[first : first + 3]
            memory = dict(zip(memory_names, found[3:first], strict=True))
            trace = dict(zip(trace_names, found[first + 3 :], strict=True))
            return Cloud(x, log_w, log_z, memory=memory), Told(mean, variance, expected, trace)

        took = self.clock() - begun
        self.seconds += took
        log.info("engine=compiled: the step compiled in %.1f s", took)
        return call, per_step


class _Once:
    """A kind of step that was met once."""


def _compiled(step: Callable[..., list[Tensor]], tensors: list[Tensor]) -> Graph:
    """By torch's compiler, of which these are inner parts: its cache on disk wants to know the shapes from stand-ins."""
    from torch._guards import TracingContext, tracing
    from torch._inductor.compile_fx import compile_fx  # takes seconds to import
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    graph = make_fx(step)(*tensors)
    stand_ins = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    with tracing(TracingContext(stand_ins)):
        run: Any = compile_fx(graph, [stand_ins.from_tensor(a, static_shapes=True) for a in tensors])
    return lambda given: run(*given)


def _collect(tree: Any, into: list[Tensor]) -> None:
    """Tensors of nested tuples and dicts, in their order."""
    for part in tree.values() if isinstance(tree, dict) else tree:
        if isinstance(part, Tensor):
            into.append(part)
        elif isinstance(part, tuple | dict):
            _collect(part, into)


def _replaced(tree: Any, tensors: Iterator[Tensor]) -> Any:
    """The same, with other tensors in their places."""
    if isinstance(tree, Tensor):
        return next(tensors)
    if isinstance(tree, dict):
        return {name: _replaced(part, tensors) for name, part in tree.items()}
    if isinstance(tree, tuple):
        parts = [_replaced(part, tensors) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return tree


def _stored(a: Tensor) -> Tensor:
    """Contiguous in memory, particles last: [R, N, ...] -> [..., R, N]."""
    return (a.permute(*range(2, a.dim()), 0, 1) if a.dim() > 2 else a).contiguous()


def _seen_as(a: Tensor) -> Tensor:
    """What `_stored` was given."""
    return a.permute(a.dim() - 2, a.dim() - 1, *range(a.dim() - 2)) if a.dim() > 2 else a
