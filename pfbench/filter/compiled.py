"""A filter's step as one compiled graph.

A step is a pure function of tensors: belief, what is seen, seed, runs and number of the step. It is recorded once, as the
operations that it is made of, and torch's compiler makes one function of them; loops written by hand stay whole in it.
What the compiler made is kept on disk by torch, for later jobs that are alike.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from pfbench import fusion
from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Cloud, Gaussian, Info
from pfbench.filter.loop import stage
from pfbench.filter.particle import ParticleFilter, Told
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record, map_inputs

log = logging.getLogger("pfbench")

_AHEAD = 1 << 18  # numbers that steps taken together may keep: they then share what steps cost beside them, and stay in a cache


class Counter(Protocol):
    """Counts what a step asks of the model, in its own time."""

    count: int


Step = Callable[[list[Tensor]], Sequence[Tensor]]


@dataclass(frozen=True, eq=False)
class Graph:
    """A step of one kind of belief and record.

    Attributes:
        run: belief, number of the step, what is seen, seed and runs -> the next belief, mean, variance, weights expected, trace.
        asked: how often it evaluates the model's law.
        memory, trace: names of what the belief carries, and of what the step traces.
        most: steps that may be taken together.
        model: of which it is; held, since graphs are known by its identity.
    """

    run: Step
    asked: int
    memory: list[str]
    trace: list[str]
    most: int
    model: StateSpaceModel

    def follow(self, belief: Cloud, record: Record, draws: MonteCarlo) -> list[tuple[Cloud, Told]]:
        """The beliefs after each step of a record, up to the first one in which a particle has become NaN.

        Nobody looks at the numbers of one step before the next one begins. `draws` are at the first step.
        """
        first, many, carried = int(draws.step), record.y.shape[1], 3 + len(self.memory)
        state = [_stored(a) for a in _tensors((belief.x, belief.log_w, belief.log_z, belief.memory))]
        seen = [torch.arange(first, first + many), *map(_by_step, _tensors((record.y, record.u)))]
        shared = [*map(_stored, _tensors((record.start, record.spread))), torch.as_tensor(draws.seed), draws.runs]
        found: list[Sequence[Tensor]] = []
        for parts in zip(*(a.unbind() for a in seen), strict=True):
            found.append(self.run([*state, *parts, *shared]))
            state = list(found[-1][:carried])
        return [self._named(out) for out in found[: _healthy([out[carried] for out in found])]]

    def _named(self, out: Sequence[Tensor]) -> tuple[Cloud, Told]:
        x, log_w, log_z, *rest = [_seen_as(a) if a.dim() > 2 else a for a in out]
        carried = len(self.memory)
        memory = dict(zip(self.memory, rest[:carried], strict=True))
        mean, variance, expected, *trace = rest[carried:]
        told = Told(mean, variance, expected, dict(zip(self.trace, trace, strict=True)))
        return Cloud(x, log_w, log_z, memory=memory), told


@dataclass(eq=False)
class Compiled:
    """A particle filter whose steps run compiled, with the same draws and, to rounding, the same results.

    The very first step runs as it is, since there a proposal may begin what it carries along. The second is recorded and
    compiled. From then on small steps are taken several together; one in which a particle has become NaN is done again
    uncompiled, and so are, compiled, those that were taken after it.
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
    graphs: dict[Any, Graph | None] = field(default_factory=dict)

    @property
    def exact(self) -> bool:
        return self.method.exact

    @property
    def at_work(self) -> bool:
        """Did any kind of step run compiled?"""
        return any(graph is not None for graph in self.graphs.values())

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud | Gaussian:
        return self.method.init(model, runs, draws, start, spread)

    def step(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Info]:
        """A step alone, where nobody knows yet what comes after it."""
        if not isinstance(draws, MonteCarlo):
            return self.method.step(model, belief, seen, draws)
        alone = seen._replace(y=seen.y.unsqueeze(1), u=map_inputs(lambda a: a.unsqueeze(1), seen.u))
        (found,) = self.walk(model, belief, alone, draws, int(draws.step) - 1)
        return found

    def walk(
        self, model: StateSpaceModel, belief: Cloud, record: Record, draws: Draws, before: int = 0
    ) -> Iterator[tuple[Cloud, Info]]:
        """The belief after each step of a record, and what the step tells; `before` it there were other steps."""
        t, many, length = 0, 1, record.y.shape[1]
        while t < length:
            own = draws.at(before + t + 1)
            graph = self._graph(stage(model, before + t), belief, record.at(t), own, first=before + t == 0)
            if graph is not None and isinstance(own, MonteCarlo):
                many = min(many, graph.most, length - t)
                followed = graph.follow(belief, _during(record, slice(t, t + many)), own)
                for belief, told in followed:
                    yield belief, self.method.tell(model, belief, told, record.at(t))
                    t += 1
                if self.counter:
                    self.counter.count += len(followed) * graph.asked
                if len(followed) == many:
                    many *= 2
                    continue
                many = 1
            belief, info = self.method.step(stage(model, before + t), belief, record.at(t), draws.at(before + t + 1))
            yield belief, info
            t += 1

    def _graph(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws, first: bool) -> Graph | None:
        """The step of such a belief and record; None where it cannot be had, and for a first step of no kind known before."""
        if not isinstance(draws, MonteCarlo) or self.method.keeper is not None:
            return None
        key = id(model), belief.x.shape, len(_tensors((belief, seen)))
        if key not in self.graphs:
            if first:
                return None
            self.graphs[key] = self._recorded(model, belief, seen, draws)
        return self.graphs[key]

    def _recorded(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: MonteCarlo) -> Graph | None:
        begun = self.clock()
        names: list[list[str]] = []
        state = _tensors((belief.x, belief.log_w, belief.log_z, belief.memory))

        def step(*flat: Tensor) -> list[Tensor]:
            number, *given, seed, runs = flat[len(state) :]
            rest = map(_seen_as, [*flat[: len(state)], *given])
            x, log_w, log_z = (next(rest) for _ in range(3))
            memory, record = _replaced(belief.memory, rest), _replaced(seen, rest)
            with torch.no_grad(), fusion.graph():
                before = belief._replace(x=x, log_w=log_w, log_z=log_z, memory=memory)
                cloud, told = self.method.advance(model, before, record, MonteCarlo(seed, runs, draws.dtype, number))
            names[:] = [list(cloud.memory), list(told.trace)]
            found = [cloud.x, cloud.log_w, cloud.log_z, *cloud.memory.values(), *told[:3], *told.trace.values()]
            return [_stored(part) for part in found]

        counted = self.counter.count if self.counter else 0
        shared = [torch.as_tensor(draws.seed), draws.runs]
        example = [*map(_stored, state), torch.as_tensor(draws.step), *map(_stored, _tensors(seen)), *shared]
        try:
            run = _compiled(step, example)
            asked = (self.counter.count if self.counter else 0) - counted
            out = run(example)
        except Exception as error:  # torch raises many kinds
            why = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning("engine=compiled: this step cannot be compiled (%s); going on with compiled loops alone", why)
            return None
        finally:
            if self.counter:
                self.counter.count = counted
        took = self.clock() - begun
        self.seconds += took
        log.info("engine=compiled: the step compiled in %.1f s", took)
        memory, trace = names
        stays = [a.shape for a in out[: 3 + len(memory)]] == [a.shape for a in example[: len(state)]]
        most = max(1, _AHEAD // sum(a.numel() for a in out)) if stays else 1
        return Graph(run, asked, memory, trace, most, model)


def _compiled(step: Callable[..., list[Tensor]], tensors: list[Tensor]) -> Step:
    """By torch's compiler, of which these are inner parts: its cache on disk wants to know the shapes from stand-ins."""
    from torch._guards import TracingContext, tracing
    from torch._inductor.compile_fx import compile_fx  # takes seconds to import
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    graph = make_fx(step)(*tensors)
    # on the CPU what calls the kernels is compiled with them, in the same time: from Python it takes half as long again
    options = {"cpp_wrapper": not any(a.is_cuda for a in tensors)}
    stand_ins = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    with tracing(TracingContext(stand_ins)):
        examples = [stand_ins.from_tensor(a, static_shapes=True) for a in tensors]
        run: Any = compile_fx(graph, examples, config_patches=options)
    return lambda given: run(*given)


def _tensors(tree: Any) -> list[Tensor]:
    """Those of nested tuples and dicts, in their order."""
    if isinstance(tree, Tensor):
        return [tree]
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, tuple) else ()
    return [a for part in parts for a in _tensors(part)]


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


def _by_step(a: Tensor) -> Tensor:
    """Inputs [R, T, ...] as [T, ...], each step's as `_stored` would have them."""
    return a.permute(1, *range(3, a.dim()), 0, *range(2, min(a.dim(), 3))).contiguous()


def _during(record: Record, steps: slice) -> Record:
    return record._replace(y=record.y[:, steps], u=map_inputs(lambda a: a[:, steps], record.u))


def _healthy(means: list[Tensor]) -> int:
    """How many of the first steps' means [R, D] are finite. On a GPU nobody looks: there the graph itself sees to it."""
    if means[0].is_cuda or math.isfinite(float(torch.stack(means).sum())):
        return len(means)
    return next((t for t, mean in enumerate(means) if not math.isfinite(float(mean.sum()))), len(means))
