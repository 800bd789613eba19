"""A filter's step as one compiled graph.

A step is a pure function of tensors: belief, what is seen, seed, runs and number of the step. It is recorded once, as the
operations that it is made of, and torch's compiler makes one function of them; loops written by hand stay whole in it.
What the compiler made is kept on disk by torch, for later jobs that are alike.
"""

from __future__ import annotations

import inspect
import logging
import math
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.fx import Graph as Operations
from torch.fx import Node

from pfbench import fusion, native
from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Cloud, Gaussian, Info
from pfbench.filter.loop import stage
from pfbench.filter.particle import ParticleFilter, Told
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record, map_inputs

log = logging.getLogger("pfbench")

_AHEAD = 1 << 20  # numbers that steps taken together may keep: they then share what steps cost beside them
_AHEAD_CUDA = 64  # steps


class Counter(Protocol):
    """Counts what a step asks of the model, in its own time."""

    count: int


Step = Callable[[list[Tensor]], Sequence[Tensor]]
_ENTRY = "_Z19inductor_entry_implPP16AtenTensorOpaqueS1_"  # the function that torch's compiler makes of a step, as C++ names it


@dataclass(frozen=True, eq=False)
class Graph:
    """A step of one kind of belief and record.

    Attributes:
        run: belief, number of the step, what is seen, seed and runs -> the next belief, mean, variance, weights expected, trace.
        direct: where it can be called without Python, and what it is given first; None where it cannot.
        asked: how often it evaluates the model's law.
        memory, trace: names of what the belief carries, and of what the step traces.
        most: steps that may be taken together.
        model: of which it is; held, since graphs are known by its identity.
    """

    run: Step
    direct: tuple[int, list[Tensor]] | None
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
        found: list[list[Tensor]] = []
        if self.direct is not None:
            step, constants = self.direct
            outputs = carried + 3 + len(self.trace)
            flat = native.follow(step, outputs, constants, state, seen, shared)
            found = [flat[k : k + outputs] for k in range(0, len(flat), outputs)]
        else:
            for parts in zip(*(a.unbind() for a in seen), strict=True):
                left = self.run([*state, *parts, *shared])
                found.append([_seen_as(a) for a in left])
                state = list(left[:carried])
        return [self._named(out) for out in found[: _healthy([out[carried] for out in found])]]

    def _named(self, out: list[Tensor]) -> tuple[Cloud, Told]:
        """What a step leaves, by its names."""
        carried = 3 + len(self.memory)
        x, log_w, log_z = out[:3]
        mean, variance, expected = out[carried : carried + 3]
        memory = dict(zip(self.memory, out[3:carried], strict=True))
        told = Told(mean, variance, expected, dict(zip(self.trace, out[carried + 3 :], strict=True)))
        return Cloud(x, log_w, log_z, memory=memory), told


@dataclass(eq=False)
class Compiled:
    """A particle filter whose steps run compiled, with the same draws and, to rounding, the same results.

    The very first step runs as it is, since there a proposal may begin what it carries along. The second is recorded and
    compiled. From then on small steps are taken many together; one in which a particle has become NaN is done again
    uncompiled, and so are, compiled, those that were taken after it: at first one alone, then two, four and so on.
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
        t, many, length = 0, record.y.shape[1], record.y.shape[1]
        while t < length:
            own = draws.at(before + t + 1)
            graph = self._graph(stage(model, before + t), belief, record.at(t), own, first=before + t == 0)
            if graph is not None and isinstance(own, MonteCarlo):
                many = min(many, graph.most, length - t)
                followed = graph.follow(belief, _during(record, slice(t, t + many)), own)
                for belief, told in followed:
                    yield belief, self.method.tell(model, belief, told, partial(record.at, t))
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
            run, direct = _compiled(step, example)
            asked = (self.counter.count if self.counter else 0) - counted
            out = run(example)
        except Exception as error:  # torch raises many kinds
            why = f"{type(error).__name__}: {error}".splitlines()[0]
            log.warning("engine=compiled: this step cannot be compiled (%s); going on with compiled loops alone", why)
            log.debug("why", exc_info=True)
            return None
        finally:
            if self.counter:
                self.counter.count = counted
        took = self.clock() - begun
        self.seconds += took
        log.info("engine=compiled: the step compiled in %.1f s", took)
        memory, trace = names
        stays = [a.shape for a in out[: 3 + len(memory)]] == [a.shape for a in example[: len(state)]]
        most = _together(out) if stays else 1
        return Graph(run, direct, asked, memory, trace, most, model)


def _compiled(step: Callable[..., list[Tensor]], tensors: list[Tensor]) -> tuple[Step, tuple[int, list[Tensor]] | None]:
    """By torch's compiler, of which these are inner parts: its cache on disk wants to know the shapes from stand-ins."""
    from torch._functorch.config import patch as whole_cache
    from torch._guards import TracingContext, tracing
    from torch._inductor.compile_fx import compile_fx, compile_fx_inner  # takes seconds to import
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    graph = make_fx(step, decomposition_table={torch.ops.aten.stack.default: _stacked})(*tensors)
    on_cpu = not any(a.is_cuda for a in tensors)
    if not on_cpu:
        _join(graph.graph)
        graph.recompile()
    # on the CPU what calls the kernels is compiled with them, in the same time: from Python it takes half as long again
    by_name = {"aot_inductor.custom_ops_to_c_shims": native.shims()} if on_cpu else {}
    options = {"cpp_wrapper": on_cpu, "size_asserts": False, **by_name}  # a graph is only given what it was recorded with
    made: list[Any] = []

    def inner(*args: Any, **words: Any) -> Any:
        made.append(compile_fx_inner(*args, **words))
        return made[-1]

    stand_ins = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    with tracing(TracingContext(stand_ins)), whole_cache(enable_autograd_cache=False):  # the other one hides what is made
        examples = [stand_ins.from_tensor(a, static_shapes=True) for a in tensors]
        run: Any = compile_fx(graph, examples, inner_compile=inner, config_patches=options)
    return lambda given: run(*given), _direct(made, run, tensors) if on_cpu else None


def _together(out: Sequence[Tensor]) -> int:
    """Steps that may be taken one after the other before anybody looks: on a GPU, which would wait, large ones, too."""
    if not out[0].is_cuda:
        return max(1, _AHEAD // sum(a.numel() for a in out))
    free = torch.cuda.mem_get_info(out[0].device)[0]
    return max(1, min(_AHEAD_CUDA, free // 8 // sum(a.nbytes for a in out)))


def _join(graph: Operations) -> None:
    """Has parents copied, noise drawn and both moved to the next step in one pass, as a CUDA device can."""
    for node in graph.find_nodes(op="call_function", target=torch.ops.pfbench.affine.default):
        phi, x, gain, w = node.args
        copied, drawn = _origin(x, torch.ops.pfbench.copied.default), _origin(w, torch.ops.pfbench.normals.default)
        if copied is None or drawn is None:
            continue
        seed, purpose, step, runs, *_ = drawn.args
        with graph.inserting_before(node):
            joined = graph.call_function(
                torch.ops.pfbench.driven.default, (phi, *copied.args, gain, seed, purpose, step, runs)
            )
        node.replace_all_uses_with(joined)
    graph.eliminate_dead_code()


def _origin(node: Any, operator: Any) -> Any:
    """The call of this operator of which a node is all particles, seen as [R, N, ...]; None where it is something else."""
    aten, turned = torch.ops.aten, 0
    same = aten.alias.default, aten._to_copy.default
    while isinstance(node, Node) and node.target is not operator:
        of, *how = node.args
        if node.target is aten.permute.default and how == [[1, 2, 0]]:
            turned += 1
        elif node.target not in same and not (node.target is aten.slice.Tensor and how[:2] == [2, 0]):
            return None
        node = of
    return node if isinstance(node, Node) and turned == 1 else None


def _stacked(parts: Sequence[Tensor], dim: int = 0) -> Tensor:
    """torch.stack, component by component in memory where parts [R, N] become components: those can be computed side by side."""
    last = parts[0].dim()
    if dim not in (-1, last) or last < 2:
        return torch.cat([part.unsqueeze(dim) for part in parts], dim)
    return torch.cat([part.unsqueeze(0) for part in parts]).permute(*range(1, last + 1), 0)


def _direct(made: list[Any], run: Any, tensors: list[Tensor]) -> tuple[int, list[Tensor]] | None:
    """Where the C++ function lies that `run` comes down to, and the constants that it is given before the step's tensors.

    None, and a line, where what torch has made is not as expected: the step is then called from Python.
    """
    given: list[Tensor] = []
    try:
        (graph,) = made
        call = graph.current_callable

        def noted(args: list[Tensor]) -> Any:
            given.extend(args)
            return call(args)

        graph.current_callable = noted
        try:
            wanted = run(*tensors)
        finally:
            graph.current_callable = call
        constants, own = given[: -len(tensors)], given[-len(tensors) :]
        if not all(a is b for a, b in zip(own, tensors, strict=True)):
            raise TypeError("its arguments are in another order")
        entry = inspect.getclosurevars(call).nonlocals["f"]
        where = native.address(entry.__self__.__file__, _ENTRY)
        found = native.follow(where, len(wanted), constants, [], [a.unsqueeze(0) for a in tensors], [])
        if not all(torch.allclose(a.double(), _seen_as(b).double(), equal_nan=True) for a, b in zip(found, wanted, strict=True)):
            raise TypeError("its results differ")
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError, OSError, subprocess.CalledProcessError) as error:
        log.info("engine=compiled: steps are called from Python (%s: %s)", type(error).__name__, error)
        return None
    return where, constants


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
    """How many of the first steps' means [R, D] are finite."""
    if math.isfinite(float(torch.stack(means).sum())):
        return len(means)
    return next((t for t, mean in enumerate(means) if not math.isfinite(float(mean.sum()))), len(means))
