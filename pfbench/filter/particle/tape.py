"""A model as a tape: the torch operations of its step on one particle, recorded once as instructions on numbers.

Recording runs `propagate` and `log_likelihood` once, on a few particles, and follows each number of each tensor. A number may depend on
the numbers of its own particle, on inputs of its run and on constants. What else a model does is refused with a reason: a branch on a
value, a mean over particles, a random draw, an operation that is not listed here. A tape contains the constants as they were.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from pfbench.core.record import Record
from pfbench.filter.particle.taken_steps import tensors_in
from pfbench.kernels import dispatch
from pfbench.model.base import StateSpaceModel

# instructions in the order of `execute` in kernels/src/tape.cpp
OPERATIONS = (
    "copy", "add", "sub", "mul", "div", "neg", "sqrt", "exp", "log", "sin", "cos", "atan2", "hypot", "pow", "minimum", "maximum",
    "remainder", "eq", "ne", "lt", "le", "abs", "round", "floor", "tan", "tanh", "log1p", "expm1", "special_ndtr", "where", "affine",
)  # fmt: skip
FEW = 2  # runs and particles of a recording
_MOST_INSTRUCTIONS = 2000  # per particle: longer ones are products of matrices of each particle
_MOST_NODES = 4 * _MOST_INSTRUCTIONS  # with constants, inputs and what nothing needs in the end
# Names of torch functions that are one, without underscores. Functions that move the numbers of a tensor, or of several, that change
# their type alone, that sum them, that fill a tensor, and those whose results depend on shapes.
_ALIASES = {
    "radd": "add", "rmul": "mul", "truediv": "div", "true_divide": "div", "divide": "div", "rtruediv": "rdiv", "multiply": "mul",
    "subtract": "sub", "negative": "neg", "absolute": "abs", "arctan2": "atan2", "mod": "remainder", "logical_and": "and",
    "bitwise_and": "and", "logical_or": "or", "bitwise_or": "or", "logical_not": "not", "bitwise_not": "not", "invert": "not",
}  # fmt: skip
_MOVES = {"getitem", "get", "unbind", "squeeze", "unsqueeze", "permute", "transpose", "swapaxes", "expand", "expand_as", "reshape", "view",
          "flatten", "unflatten", "movedim", "broadcast_to", "flip", "index_select", "repeat", "chunk", "split", "contiguous", "clone",
          "detach", "select", "narrow", "diag_embed", "t", "roll"}  # fmt: skip
_JOINS = {"stack", "cat", "concat"}
_CASTS = {"to", "double", "type_as"}
_SUMS = {"sum": "add", "prod": "mul", "all": "mul", "any": "maximum"}
_FILLS = {"zeros_like", "ones_like", "full_like", "new_zeros", "new_ones", "new_full", "new_tensor"}
_SHAPES = {"size", "dim", "stride", "numel", "len", "get", "is_floating_point", "is_contiguous", "is_complex", "ndimension"}  # fmt: skip
_TYPES = (torch.float64, torch.bool, torch.int64)
_FEW_TERMS = 2  # of a sum of products, which elementwise instructions compute as fast
# A number is followed as an atom: a node of the recorded expressions, times the number of lanes, plus its lane, which is 0 for all runs,
# 1 + r for a run, and 3 + 2 r + n for a particle.
_LANES = 16


class NoTapeError(Exception):
    """A model that cannot be a tape; the message is the reason."""


class Tape(NamedTuple):
    """Instructions of a step of a model for one particle.

    Attributes:
        code: Operation, result and three operands of each instruction, or of each term of a sum of products, int64 [I, 5]. From 0 on: registers of particles, first those
            of states and noise. ~0, ~1, ...: numbers of a run, which are constants, inputs of the step, results.
        outputs: Places of the new state and of its log likelihood, int64 [D + 1].
        constants: Constants, float64 [C].
        noises: Number of components of the noise.
        registers: Number of registers of particles.
        numbers: Number of numbers of a run.
    """

    code: Tensor
    outputs: Tensor
    constants: Tensor
    noises: int
    registers: int
    numbers: int


class _Graph:
    """Expressions of a recording. A node is a name and its operands: nodes, or the value or place of a leaf."""

    def __init__(self) -> None:
        self.nodes: list[tuple[Any, ...]] = []
        self.of_particles: list[bool] = []
        self._known: dict[tuple[Any, ...], int] = {}
        self.number(0.0)  # node 0, with which torch fills new places

    def add(self, *node: Any, of_particles: bool = False) -> int:
        """Return the number of a node, the same one for the same node."""
        if (number := self._known.get(node)) is None:
            if len(self.nodes) > _MOST_NODES:
                raise NoTapeError(f"it needs more than {_MOST_INSTRUCTIONS} instructions")
            number = self._known[node] = len(self.nodes)
            self.nodes.append(node)
            self.of_particles.append(of_particles)
        return number

    def number(self, value: float) -> int:
        """Return the atom of a constant."""
        return self.add("number", float(value).hex()) * _LANES

    def emit(self, name: str, *atoms: int) -> int:
        """Return the atom of an operation."""
        lane = max(atom % _LANES for atom in atoms)
        run = 1 + (lane - 3) // FEW if lane >= 3 else lane
        if any(atom % _LANES not in (0, run, lane) for atom in atoms):
            raise NoTapeError("it mixes particles or runs, which a tape cannot")
        operands = [atom // _LANES for atom in atoms]
        if name == "mul" and (unit := self.number(1.0) // _LANES) in operands:
            return operands[operands[0] == unit] * _LANES + lane
        return self.add(name, *operands, of_particles=lane >= 3) * _LANES + lane

    def add_products(self, row: Iterable[tuple[int, int]]) -> int:
        """Return the atom of a sum of products: one instruction for those of numbers of a run and of particles.

        Products of the state with zeros are left out, as by the operators: states and noise are finite.
        """
        ordered = (sorted(pair, key=lambda atom: atom % _LANES) for pair in row)
        pairs = [(a, b) for a, b in ordered if a != 0 or self.nodes[b // _LANES][0] != "state"]
        terms = [(a, b) for a, b in pairs if a % _LANES < 3 <= b % _LANES]
        is_short = len(terms) <= _FEW_TERMS
        sums = [] if is_short else [self.emit("affine", *chain(*terms))]
        sums += [self.emit("mul", *pair) for pair in pairs if is_short or pair not in terms]
        return reduce(partial(self.emit, "add"), sums or [0])


def _make_table(graph: _Graph) -> dict[str, Callable[..., int]]:
    """Return elementwise operations by the name of the torch function: atoms of the operands -> atom of the result."""
    e, number = graph.emit, graph.number
    unit, most = number(1.0), number(torch.finfo(torch.float64).max)
    least, infinite = number(-math.inf), number(math.inf)
    return {
        **{name: partial(e, name) for name in OPERATIONS},
        "add": lambda a, b, alpha=unit: e("add", a, e("mul", alpha, b)),
        "sub": lambda a, b, alpha=unit: e("sub", a, e("mul", alpha, b)),
        "rsub": lambda a, b: e("sub", b, a),
        "lerp": lambda a, b, weight: e("add", a, e("mul", weight, e("sub", b, a))),
        "rdiv": lambda a, b: e("div", b, a),
        "rpow": lambda a, b: e("pow", b, a),
        "gt": lambda a, b: e("lt", b, a),
        "ge": lambda a, b: e("le", b, a),
        "square": lambda a: e("mul", a, a),
        "reciprocal": lambda a: e("div", unit, a),
        "rsqrt": lambda a: e("div", unit, e("sqrt", a)),
        "sigmoid": lambda a: e("div", unit, e("add", unit, e("exp", e("neg", a)))),
        "atan": lambda a: e("atan2", a, unit),
        "ceil": lambda a: e("neg", e("floor", e("neg", a))),
        "sign": lambda a: e("sub", e("lt", 0, a), e("lt", a, 0)),
        "clamp": lambda a, min=least, max=infinite: e("minimum", e("maximum", a, min), max),  # noqa: A006
        "addcmul": lambda a, b, c, value=unit: e("add", a, e("mul", value, e("mul", b, c))),
        "addcdiv": lambda a, b, c, value=unit: e("add", a, e("div", e("mul", value, b), c)),
        "masked_fill": lambda a, mask, value: e("where", mask, value, a),
        "isnan": lambda a: e("ne", a, a),
        "isfinite": lambda a: e("lt", e("abs", a), infinite),
        "nan_to_num": lambda a, nan=0: e("where", e("ne", a, a), nan, e("maximum", e("minimum", a, most), e("neg", most))),
        "and": lambda a, b: e("mul", a, b),
        "or": lambda a, b: e("maximum", a, b),
        "not": lambda a: e("sub", unit, a),
    }  # fmt: skip


class _Recorder(TorchFunctionMode):
    """Follows the numbers of tensors through the torch functions that a model calls."""

    def __init__(self) -> None:
        super().__init__()
        self.graph = _Graph()
        self._table = _make_table(self.graph)
        self._atoms: dict[int, tuple[Tensor, Tensor]] = {}  # with the tensor, whose id no other has

    def follow(self, tensor: Tensor, atoms: Tensor) -> None:
        """Follow a tensor from now on."""
        self._atoms[id(tensor)] = tensor, atoms.expand(tensor.shape)

    def read(self, value: Any) -> Tensor:
        """Return the atoms of a tensor or a number."""
        if (entry := self._atoms.get(id(value))) is not None:
            return entry[1]
        if not isinstance(value, Tensor):
            return torch.tensor(self.graph.number(value))
        return _stack(map(self.graph.number, value.flatten().tolist()), value.shape)

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # fmt: skip
        """Run a function, and follow its result."""
        options = kwargs or {}
        result, name = (
            function(*args, **options),
            function.__name__.removeprefix("__").removesuffix("__"),
        )
        if name in _FILLS or (name in _SHAPES and not isinstance(result, Tensor)):
            return result
        if not any(id(a) in self._atoms for a in tensors_in((args, options))):
            return result
        if not (tensors := tensors_in(result)):
            raise NoTapeError(f"it asks for values by {name}, which a tape cannot give")
        name = _ALIASES.get(name, name)
        atoms = tensors_in(self._compute(function, name, tensors[0], args, options))
        for tensor, numbers in zip(tensors, atoms, strict=True):
            self.follow(tensor, numbers)
        return result

    def _compute(self, function: Any, name: str, result: Tensor, args: Any, options: Any) -> Any:
        """Return the atoms of the results of a function. The first of them is `result`."""
        if name in _MOVES:
            return function(self.read(args[0]), *args[1:], **options)
        if name in _JOINS:
            return function([self.read(a) for a in args[0]], *args[1:], **options)
        if name in _SUMS:
            return self._reduce(name, *args, **options).reshape(result.shape)
        if (products := self._compute_products(name, args, options)) is not None:
            return products.reshape(result.shape)
        if name in _CASTS and result.dtype in (torch.float64, args[0].dtype):
            return self.read(args[0])
        if name == "pow" and (short := {2: "square", 0.5: "sqrt"}.get(_plain(args[1]))):
            name, args = short, args[:1]
        # torch chooses between Python's numbers in single precision
        is_choice = name == "where" and all(_plain(a) in (0.0, 1.0) for a in args[1:])
        fits = name in self._table and (is_choice or result.dtype in _TYPES)
        if not fits or (result.dtype == torch.bool and name in ("add", "sub")):
            raise NoTapeError(f"it needs torch.{name} with a result of {result.dtype}")
        return self._combine(
            self._table[name],
            [self.read(a) for a in args],
            {key: self.read(a) for key, a in options.items() if a is not None},
        )

    def _compute_products(self, name: str, args: Any, options: Any) -> Tensor | None:
        """Return the atoms of products of matrices; None for another function."""
        if name == "linear":  # with a bias or without one
            bias = [self.read(a) for a in (*args[2:], *options.values()) if a is not None]
            return self._add(self._multiply(self.read(args[0]), self.read(args[1]).mT), *bias)
        if name == "baddbmm" and not options:
            first, *factors = map(self.read, args)
            return self._add(first, self._multiply(*factors))
        if name in ("matmul", "rmatmul", "mm", "mv", "bmm"):
            return self._multiply(*map(self.read, args[::-1] if name == "rmatmul" else args))
        if name == "propagate_affine.default":
            phi, x, gain, w = map(self.read, args)
            both = torch.cat([a.expand(len(x), -1, -1) for a in (phi, gain)], -1)
            return self._multiply(both, torch.cat([x, w], -1).mT).transpose(0, 1)
        return None

    def _combine(
        self, build: Callable[..., int], operands: Sequence[Tensor], options: dict[str, Tensor]
    ) -> Tensor:
        """Return the atoms of an elementwise operation."""
        operand_atoms = torch.broadcast_tensors(*operands, *options.values())
        rows, count = (
            zip(*(a.flatten().tolist() for a in operand_atoms), strict=True),
            len(operands),
        )
        atoms = (build(*row[:count], **dict(zip(options, row[count:], strict=True))) for row in rows)  # fmt: skip
        return _stack(atoms, operand_atoms[0].shape)

    def _add(self, *terms: Tensor) -> Tensor:
        """Return the atoms of a sum of tensors."""
        return self._combine(
            lambda *atoms: reduce(partial(self.graph.emit, "add"), atoms), terms, {}
        )

    def _reduce(self, name: str, a: Tensor, *args: Any, **options: Any) -> Tensor:
        """Return the atoms of a sum or a product over axes."""
        if set(options) - {"dim", "keepdim"} or len(args) > 1:
            raise NoTapeError(f"it needs torch.{name} with other options")
        axes = options.get("dim", args[0] if args else tuple(range(a.dim())))
        axes = axes if isinstance(axes, tuple | list) else (axes,)
        atoms = self.read(a).movedim(tuple(axes), tuple(range(-len(axes), 0)))
        rows = atoms.flatten(-len(axes)).flatten(0, -2).tolist()
        return _stack(map(partial(reduce, partial(self.graph.emit, _SUMS[name])), rows), (-1,))

    def _multiply(self, matrix: Tensor, multiplier: Tensor) -> Tensor:
        """Return the atoms of a product of matrices."""
        rows = matrix.unsqueeze(0) if matrix.dim() == 1 else matrix
        columns = multiplier.unsqueeze(0) if multiplier.dim() == 1 else multiplier.mT
        pair = torch.broadcast_tensors(rows.unsqueeze(-2), columns.unsqueeze(-3))
        products = zip(*(m.reshape(-1, m.shape[-1]).tolist() for m in pair), strict=True)
        return _stack(
            (self.graph.add_products(zip(*row, strict=True)) for row in products),
            pair[0].shape[:-1],
        )


def _stack(atoms: Iterable[int], shape: Any) -> Tensor:
    return torch.tensor(list(atoms), dtype=torch.int64).reshape(shape)


def _plain(value: Any) -> Any:
    """Return a number of Python; None for a tensor."""
    return None if isinstance(value, Tensor) else value


def record_tape(model: StateSpaceModel, x: Tensor, w: Tensor, record: Record) -> tuple[Tape, Tensor, Tensor]:  # fmt: skip
    """Record a step of a model.

    Returns the tape, and the new states [R, N, D] and log likelihoods [R, N] that torch computed. Shapes: x [R, N, D], w [R, N, W],
    with two particles of one run or two, and the record of these runs.
    """
    recorder, sources = _Recorder(), x.shape[2] + w.shape[2]
    graph, lanes = recorder.graph, 3 + torch.arange(FEW * FEW).reshape(FEW, FEW, 1)[: len(x)]
    leaves = _stack((graph.add("state", k, of_particles=True) for k in range(sources)), (-1,))
    for tensor, nodes in zip((x, w), leaves.split([x.shape[2], w.shape[2]]), strict=True):
        recorder.follow(tensor, nodes * _LANES + lanes)
    inputs = _follow_inputs(recorder, list_inputs(record))
    state = torch.get_rng_state()
    with torch.no_grad(), dispatch.capture_graph(), recorder:
        states = model.propagate(x, record.u, w).expand(x.shape)
        value = model.log_likelihood(record.y, states, record.u).expand(x.shape[:2])
    if not torch.equal(state, torch.get_rng_state()):
        torch.set_rng_state(state)
        raise NoTapeError("it draws random numbers, which a tape cannot")
    atoms = torch.cat([recorder.read(states), recorder.read(value).unsqueeze(-1)], -1)
    lane, nodes = atoms % _LANES, atoms // _LANES
    is_own = (lane == 0) | (lane == lanes) | (lane == 1 + (lanes - 3) // FEW)
    if not bool(is_own.all() and (nodes == nodes[:1, :1]).all()):
        raise NoTapeError(
            "its numbers depend on the place of a particle or run, which a tape cannot follow"
        )
    return _arrange(graph, nodes[0, 0].tolist(), w.shape[2], sources, inputs), states, value


def list_inputs(record: Record) -> list[Tensor]:
    """Return the inputs of a tape, [R or 1, ...]: those that runs share, those of each run, and the measurement."""
    return [*sorted(tensors_in(record.u), key=len), record.y]


def _follow_inputs(recorder: _Recorder, tensors: Sequence[Tensor]) -> int:
    """Follow the inputs of runs, [R or 1, ...]. Returns the number of those of a run."""
    inputs = 0
    for leaf in tensors:
        if leaf.dtype not in _TYPES[:2]:
            raise NoTapeError(f"it needs inputs of {leaf.dtype}")
        places = range(inputs, inputs + leaf[0].numel())
        nodes = _stack((recorder.graph.add("input", k) for k in places), (-1,))
        lane = torch.arange(1, 1 + len(leaf)).unsqueeze(1) * (len(leaf) > 1)
        recorder.follow(leaf, (nodes * _LANES + lane).reshape(leaf.shape))
        inputs = places.stop
    return inputs


def _arrange(graph: _Graph, roots: list[int], noises: int, sources: int, inputs: int) -> Tape:
    """Return the instructions that compute some nodes from states and noises, which are `sources`, and from inputs.

    Each is computed as late as possible, so that few registers are in use.
    """
    order: dict[int, None] = {}
    for root in roots:
        _visit(graph, root, order)
    entries = [(k, *graph.nodes[k]) for k in order]
    values = [float.fromhex(row[2]) for row in entries if row[1] == "number"]
    numbers = [row[0] for row in entries if row[1] == "number"]
    register_of = {
        **{k: ~index for index, k in enumerate(numbers)},
        **{k: ~(len(values) + a[0]) for k, name, *a in entries if name == "input"},
        **{k: a[0] for k, name, *a in entries if name == "state"},
    }
    steps = [row for row in entries if row[0] not in register_of]
    last = {a: k for k, _, *operands in steps for a in operands} | dict.fromkeys(roots, -1)
    code: list[list[int]] = []
    free: list[int] = []
    registers, count = sources, len(values) + inputs
    for k, name, *operands in steps:
        if graph.of_particles[k]:
            registers += not free
            register_of[k] = free.pop() if free else registers - 1
        else:
            register_of[k], count = ~count, count + 1
        row, size = [register_of[a] for a in operands], 2 if name == "affine" else 3
        code += [
            [OPERATIONS.index(name), register_of[k], *some, *some[-1:] * (3 - len(some))]
            for some in (row[first : first + size] for first in range(0, len(row), size))
        ]
        # adjacent sums are computed together, so that none may write what another one reads
        free += [
            register_of[a]
            for a in set(operands)
            if last[a] == k and register_of[a] >= sources and name != "affine"
        ]
    if sum(graph.of_particles[row[0]] for row in steps) > _MOST_INSTRUCTIONS:
        raise NoTapeError(f"it needs more than {_MOST_INSTRUCTIONS} instructions")
    return Tape(
        _stack(chain(*code), (-1, 5)),
        _stack((register_of[k] for k in roots), (-1,)),
        torch.tensor(values, dtype=torch.float64),
        noises,
        registers,
        count,
    )


def _visit(graph: _Graph, node: int, order: dict[int, None]) -> None:
    """Add a node after the nodes that it needs."""
    name, *operands = graph.nodes[node]
    for operand in operands if name in OPERATIONS else ():
        if operand not in order:
            _visit(graph, operand, order)
    order[node] = None
