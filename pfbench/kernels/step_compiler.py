"""Compilation of a pure function of tensors by inner parts of torch's compiler.

The parts are `make_fx` (record the operations), Inductor (generate C++ or Triton code) and its cache
on disk. Operators of pfbench stay whole in the compiled function.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from operator import getitem
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph as Operations, GraphModule, Node

from pfbench.kernels import cuda
from pfbench.kernels.dispatch import kept_validation, mark_operators, prepare_compiler

log = logging.getLogger("pfbench")

TensorFunction = Callable[[list[Tensor]], Sequence[Tensor]]


def compile_function(
    function: Callable[..., list[Tensor]], example: list[Tensor]
) -> TensorFunction:
    """Compile a function of tensors for the shapes of an example."""
    prepare_compiler()  # before the imports, which choose a folder
    from torch._functorch.config import patch as patch_functorch
    from torch._guards import TracingContext, tracing
    from torch._inductor.compile_fx import compile_fx  # takes seconds to import
    from torch._subclasses import FakeTensorMode
    from torch.fx.experimental.proxy_tensor import make_fx
    from torch.fx.experimental.symbolic_shapes import ShapeEnv

    decompositions = {torch.ops.aten.stack.default: _stack_by_component}
    trace = make_fx(function, decomposition_table=decompositions)
    on_cpu = not any(a.is_cuda for a in example)
    graph = trace(*example) if on_cpu else _trace_for_device(trace, example)
    options = {"size_asserts": False}  # the shapes are those of the example
    fake_mode = FakeTensorMode(shape_env=ShapeEnv(), allow_non_fake_inputs=True)
    # the cache of autograd would load whole steps
    with (
        tracing(TracingContext(fake_mode)),
        patch_functorch(enable_autograd_cache=False),
        kept_validation(),
    ):
        fakes = [fake_mode.from_tensor(a, static_shapes=True) for a in example]
        run: Any = compile_fx(graph, fakes, config_patches=options)
    return lambda tensors: run(*tensors)


def _fuse_propagation(graph: Operations) -> None:
    """Fuse the copy of parents, their noise and `propagate_affine` into one operator of a CUDA device.

    The operator draws noise of the type of the particles.
    """
    normals = {
        torch.float32: torch.ops.pfbench.philox_normals.default,
        torch.float64: torch.ops.pfbench.philox_normals_float64.default,
    }
    for node in graph.find_nodes(
        op="call_function", target=torch.ops.pfbench.propagate_affine.default
    ):
        phi, x, gain, w = node.args
        copied = _find_source(x, torch.ops.pfbench.gather_particles.default)
        draw = normals.get(x.meta["val"].dtype)
        noise = _find_source(w, draw) if draw is not None else None
        if copied is None or noise is None:
            continue
        seed, purpose, step, runs, *_ = noise.args
        with graph.inserting_before(node):
            fused = graph.call_function(
                torch.ops.pfbench.gather_propagate.default,
                (phi, *copied.args, gain, seed, purpose, step, runs),
            )
        node.replace_all_uses_with(fused)
    graph.eliminate_dead_code()


def _trace_for_device(trace: Callable[..., GraphModule], example: list[Tensor]) -> GraphModule:
    """Record a step with operators of a CUDA device: one for the whole step of a SIR filter, and one for propagation."""
    with mark_operators():
        graph = trace(*example)
    _fuse_propagation(graph.graph)
    if not _fuse_steps(graph):  # another step
        graph = trace(*example)
        _fuse_propagation(graph.graph)
    graph.recompile()
    return graph


def _fuse_steps(module: GraphModule) -> bool:
    """Fuse all that a SIR filter does with its particles in a step into one operator of a CUDA device.

    It resamples at each step and measures some components with normal errors.

    Returns whether this was done, and no operator is left that is marked.
    """
    graph, ops = module.graph, torch.ops.pfbench
    marked = ops.log_normal.default, ops.sum_log_weights.default, ops.normalise_weights.default
    for weights in graph.find_nodes(op="call_function", target=marked[-1]):
        match = _match_step(module, weights)
        if match is None:
            continue
        propagation, counts, arguments = match
        results = _call_before(weights, ops.sir_step.default, arguments, 8)
        w = next((node for node in weights.users if node.args[1] == 2), None)
        moments = [
            node
            for node in (w.users if w is not None else ())
            if node.target is ops.weighted_moments.default
            and _strip_permutations(node.args[0], (1, 2, 0)) is propagation
        ]
        for first, node in ((1, weights), *((5, node) for node in moments)):
            for result in list(node.users):
                result.replace_all_uses_with(results[first + result.args[1]])
        for count in counts:
            count.replace_all_uses_with(results[7])
        propagation.replace_all_uses_with(results[0])
        _move_behind(results)
        graph.eliminate_dead_code()
    return not any(node.target in marked for node in graph.nodes)


def _match_step(
    module: GraphModule, weights: Node
) -> tuple[Node, list[Node], tuple[Any, ...]] | None:
    """Return propagation, counts of ancestors and arguments of `sir_step` for a step with these normalised weights.

    None if it is another step, or one that the kernel does not take.
    """
    ops, measurement = torch.ops.pfbench, _match_measurement(module, weights.args[0])
    if measurement is None:
        return None
    propagation, prior, measured = measurement
    phi, x, ancestors, gain, *key = propagation.args
    if _get_target(ancestors) is not ops.resample_systematic.default:
        return None
    a, n, u = ancestors.args
    counts = [node for node in ancestors.users if node is not propagation]
    arguments = a, n, u, phi, x, gain, *key, *measured
    fits = (
        all(node.target is ops.count_unique.default and node.args[1] is prior for node in counts)
        and _is_equal_weight(prior, n)
        and not _depend_on(arguments, propagation)
        and cuda.can_take_step(x.meta["val"], gain.meta["val"])
    )
    return (propagation, counts, arguments) if fits else None


def _match_measurement(module: GraphModule, total: Any) -> tuple[Any, Any, tuple[Any, ...]] | None:
    """Return propagation, prior log weights, and components, measurements, scales and constants of log weights.

    None unless they are a prior and a normal density of different components of propagated particles.
    """
    aten, ops, target = torch.ops.aten, torch.ops.pfbench, _get_target
    views = aten.expand.default, aten.alias.default, aten.slice.Tensor
    if target(total) is not ops.sum_log_weights.default:
        return None
    likelihood, prior, ratio = total.args
    likelihood, ratio = _strip(likelihood, views[:2]), _strip(ratio, views)
    is_normal = target(likelihood) is ops.log_normal.default
    if not is_normal or target(ratio) is not aten.zeros_like.default:
        return None
    y, mean, scale, constant = likelihood.args
    selection = _strip_permutations(mean, (1, 2, 0))
    if target(selection) is not aten.index_select.default or selection.args[1] != 0:
        return None
    propagation = _strip_permutations(selection.args[0], (0, 1, 2))
    components = selection.args[2]
    indices = getattr(module, str(components.target)) if components.op == "get_attr" else None
    if indices is None or len(indices.unique()) < len(indices):
        return None
    if target(propagation) is not ops.gather_propagate.default:
        return None
    return propagation, prior, (components, y, scale, constant)


def _get_target(node: Any) -> Any:
    """Return what a node calls; None if it is not a node."""
    return node.target if isinstance(node, Node) else None


def _strip(node: Any, operators: tuple[Any, ...]) -> Any:
    """Return the node that is left of a chain of calls without those of some operators."""
    while _get_target(node) in operators:
        node = node.args[0]
    return node


def _strip_permutations(node: Any, axes: tuple[int, ...]) -> Any:
    """Return the node whose axes a chain of permutations puts in this order; None if it is another order."""
    order = list(range(len(axes)))
    while _get_target(node) is torch.ops.aten.permute.default:
        order = [node.args[1][axis] for axis in order]
        node = node.args[0]
    return node if tuple(order) == axes else None


def _is_equal_weight(node: Any, n: Any) -> bool:
    """Return whether log weights are -log n at the first n slots and -inf at all others."""
    aten = torch.ops.aten
    if _get_target(node) is not aten.where.self:
        return False
    below, level, none = node.args
    if (_get_target(below), _get_target(level), _get_target(none)) != (
        aten.lt.Tensor, aten.neg.default, aten.scalar_tensor.default,
    ):  # fmt: skip
        return False
    slots, log_n = below.args[0], level.args[0]
    return bool(
        below.args[1] is n
        and _get_target(slots) is aten.arange.default
        and len(slots.args) == 1
        and _get_target(log_n) is aten.log.default
        and log_n.args[0] is n
        and none.args[0] == -math.inf
    )


def _depend_on(arguments: Sequence[Any], source: Node) -> bool:
    """Return whether one of some arguments is computed from a node."""
    waiting: list[Node] = [a for a in arguments if isinstance(a, Node)]
    visited: set[Node] = set()
    while waiting:
        node = waiting.pop()
        if node is source:
            return True
        if node not in visited:
            visited.add(node)
            waiting += node.all_input_nodes
    return False


def _call_before(node: Node, operator: Any, arguments: tuple[Any, ...], results: int) -> list[Node]:
    """Insert a call of an operator before a node. Returns its results."""
    with node.graph.inserting_before(node):
        call = node.graph.call_function(operator, arguments)
        return [node.graph.call_function(getitem, (call, k)) for k in range(results)]


def _move_behind(results: list[Node]) -> None:
    """Move what is computed from some results behind them, in its order."""
    last, late = results[-1], set(results)
    for node in list(last.graph.nodes):
        if node is last:
            break
        if node not in late and not late.isdisjoint(node.all_input_nodes):
            late.add(node)
    behind = [node for node in last.graph.nodes if node in late and node not in results]
    for node in behind:
        last.append(node)
        last = node


def _find_source(node: Any, operator: Any) -> Any:
    """Return the call of `operator` that a node views as [R, N, ...]; None if it is another node."""
    aten, permutations = torch.ops.aten, 0
    copies = aten.alias.default, aten._to_copy.default
    while isinstance(node, Node) and node.target is not operator and node.args:
        source, *options = node.args
        if node.target is aten.permute.default and options == [[1, 2, 0]]:
            permutations += 1
        elif node.target not in copies and not (
            node.target is aten.slice.Tensor and options[:2] == [2, 0]
        ):
            return None
        node = source
    return node if _get_target(node) is operator and permutations == 1 else None


def _stack_by_component(tensors: Sequence[Tensor], dim: int = 0) -> Tensor:
    """Stack tensors [R, N] as components, component-major in memory; otherwise as torch.stack."""
    last = tensors[0].dim()
    if dim not in (-1, last) or last < 2:
        return torch.cat([a.unsqueeze(dim) for a in tensors], dim)
    return torch.cat([a.unsqueeze(0) for a in tensors]).permute(*range(1, last + 1), 0)


def to_storage(a: Tensor) -> Tensor:
    """Return [R, N, ...] as contiguous [..., R, N]; tensors of two axes or fewer keep their shape."""
    return (a.permute(*range(2, a.dim()), 0, 1) if a.dim() > 2 else a).contiguous()


def from_storage(a: Tensor) -> Tensor:
    """Return the view [R, N, ...] of a result of `to_storage`."""
    return a.permute(a.dim() - 2, a.dim() - 1, *range(a.dim() - 2)) if a.dim() > 2 else a


def steps_to_storage(a: Tensor) -> Tensor:
    """Return inputs [R, T, ...] as [T, ...], each step in the layout of `to_storage`."""
    return a.permute(1, *range(3, a.dim()), 0, *range(2, min(a.dim(), 3))).contiguous()
