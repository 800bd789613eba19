"""Manifest of the operators: name, purpose, arguments and results of each, as `operators.toml` states them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Sequence
from functools import cache, wraps
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor

KERNELS_FOLDER = Path(__file__).parent

_ARGUMENT = re.compile(r"(\w+): (\w+)(?: \[(.*)\])?(?: (below|to) (?:(\d+) )?([A-Z]|1))?")

_RESULT = re.compile(r"(real|float32|float64|int64|bool) \[(.*)\]")

_TERM = re.compile(r"(?:(\d+) )?(\w+)")

_KINDS = ("real", "number", "int64", "int")


class Limit(NamedTuple):
    """Largest value of an argument: `factor` times the size of `axis`, minus 1 for indices.

    Attributes:
        factor: Factor of the size.
        axis: Letter of an axis, or `1`.
        is_index: Whether the values are indices, which lie below the size.
    """

    factor: int
    axis: str
    is_index: bool

    @property
    def text(self) -> str:
        """The largest value in words, for instance `2 N - 1`."""
        size = self.axis if self.factor == 1 else f"{self.factor} {self.axis}"
        return f"{size} - 1" if self.is_index else size

    def largest(self, sizes: dict[str, int]) -> int:
        """Return the largest value for the sizes of a call by letter."""
        size = 1 if self.axis == "1" else sizes[self.axis]
        return self.factor * size - self.is_index


class Argument(NamedTuple):
    """An argument of an operator.

    Attributes:
        name: Name.
        kind: `real`, `number`, `int64`, or `int` for a plain integer.
        axes: Letter of each axis, in lower case where the size may also be 1.
        positive: Letters of the axes that must have an entry.
        limit: Range of the values from 0 on, or None.
        has_batch: Whether the first axis is any number of batch axes.
    """

    name: str
    kind: str
    axes: str
    positive: str = ""
    limit: Limit | None = None
    has_batch: bool = False

    @property
    def shape(self) -> str:
        """Shape in words, as in the manifest."""
        words = [f"{axis.upper()} or 1" if axis.islower() else axis for axis in self.axes]
        return f"[{', '.join(['...', *words[1:]] if self.has_batch else words)}]"


class OperatorResult(NamedTuple):
    """A result of an operator.

    Attributes:
        kind: Type, or `real` for that of the real arguments.
        axes: Size of each axis: sums of sizes with factors, as (factor, name) pairs.
    """

    kind: str
    axes: tuple[tuple[tuple[int, str], ...], ...]


class Operator(NamedTuple):
    """An operator of the kernels.

    Attributes:
        name: Name.
        summary: What it computes, one sentence.
        arguments: Its arguments, in order.
        results: Its results, in order.
        is_on_cpu: Whether it has a C++ function for the CPU.
        text: Arguments and results as they are written in the manifest.
    """

    name: str
    summary: str
    arguments: tuple[Argument, ...]
    results: tuple[OperatorResult, ...]
    is_on_cpu: bool
    text: tuple[str, ...]

    @property
    def schema(self) -> str:
        """Arguments and results as torch writes them, for instance `(Tensor x, SymInt n) -> Tensor`."""
        words = ("SymInt" if a.kind == "int" else "Tensor" for a in self.arguments)
        parameters = ", ".join(f"{w} {a.name}" for w, a in zip(words, self.arguments, strict=True))
        result_types = ", ".join(["Tensor"] * len(self.results))
        return (
            f"({parameters}) -> {result_types if len(self.results) == 1 else f'({result_types})'}"
        )


@cache
def read_operators() -> dict[str, Operator]:
    """Read all operators from operators.toml."""
    content = tomllib.loads((KERNELS_FOLDER / "operators.toml").read_text())
    return {
        name: Operator(
            name,
            entry["summary"],
            tuple(_parse_argument(name, text) for text in entry["arguments"]),
            tuple(_parse_result(name, text) for text in entry["results"]),
            entry.get("device") != "cuda",
            (*entry["arguments"], *entry["results"]),
        )
        for name, entry in content.items()
    }


def _parse_argument(operator: str, text: str) -> Argument:
    """Parse an argument such as `n: number [R|1, 1] to N`."""
    match = _ARGUMENT.fullmatch(text)
    if match is None or match[2] not in _KINDS:
        raise ValueError(f"{operator}: an argument must be 'name: kind [axes]', got {text!r}.")
    axes = [axis.strip() for axis in (match[3] or "").split(",") if axis.strip()]
    has_batch = axes[:1] == ["..."]
    axes = ["B", *axes[1:]] if has_batch else axes
    if not all(re.fullmatch(r"[A-Z](\|1|>0)?|1", axis) for axis in axes):
        raise ValueError(
            f"{operator}: axes must be letters, letters with |1 or >0, or 1, got {text!r}."
        )
    letters = "".join(a[0].lower() if "|" in a else a[0] for a in axes)
    positive = "".join(a[0] for a in axes if ">" in a)
    limit = Limit(int(match[5] or 1), match[6], match[4] == "below") if match[4] else None
    return Argument(match[1], match[2], letters, positive, limit, has_batch)


def _parse_result(operator: str, text: str) -> OperatorResult:
    """Parse a result such as `float32 [components, R, 4 quarters]`."""
    match = _RESULT.fullmatch(text)
    words = [axis.strip() for axis in match[2].split(",") if axis.strip()] if match else []
    words = ["B" if axis == "..." else axis for axis in words]
    terms = [[_TERM.fullmatch(term) for term in axis.split(" + ")] for axis in words]
    if match is None or any(term is None for axis in terms for term in axis):
        raise ValueError(f"{operator}: a result must be 'kind [axes]', got {text!r}.")
    axes = tuple(tuple((int(term[1] or 1), term[2]) for term in axis if term) for axis in terms)
    return OperatorResult(match[1], axes)


# --------------------------------------------------------------------------------------------------
# Checks of an operator's arguments in Python.
#
# Eager functions and CUDA kernels make them before they run. The C++ operators make the same ones in
# `src/operators.cpp`.

_F = TypeVar("_F", bound=Callable[..., Any])

LARGEST_SIZE = (1 << 30) - 1  # of an axis: counters of particles have 32 bits

LARGEST_INTEGER = (1 << 32) - 1

_TYPES = {
    "real": (torch.float32, torch.float64),
    "number": (torch.float32, torch.float64, torch.int64),
    "int64": (torch.int64,),
}


def check_first(kernel: _F) -> _F:
    """Check the arguments before a kernel runs.

    Returns the function with the checks. It raises ValueError for a wrong argument.
    """
    name = kernel.__name__.removeprefix("_")

    @wraps(kernel)
    def call(*args: Any) -> Any:
        check_arguments(name, args)
        return kernel(*args)

    return cast(_F, call)


def check_arguments(name: str, arguments: Sequence[Any], with_values: bool = True) -> None:
    """Check the arguments of an operator."""
    expected = read_operators()[name].arguments
    if len(arguments) != len(expected):
        raise ValueError(f"{name} must have {len(expected)} arguments, got {len(arguments)}.")
    sizes: dict[str, int] = {}
    real: torch.dtype | None = None
    device: torch.device | None = None
    for argument, value in zip(expected, arguments, strict=True):
        if argument.kind == "int":
            _check_integer(name, argument, value)
            continue
        _check_type(name, argument, value, real)
        real = value.dtype if argument.kind == "real" else real
        if value.shape:  # a number [] may lie on the host
            device = device or value.device
            if value.device != device:
                raise ValueError(
                    f"{name}: {argument.name} must be on {device}, got {value.device}."
                )
        _check_shape(name, argument, value.shape, sizes)
    if with_values:
        for argument, value in zip(expected, arguments, strict=True):
            if argument.limit is not None:
                _check_values(name, argument, value, sizes)


def _check_integer(name: str, argument: Argument, value: Any) -> None:
    """Check a plain integer."""
    if not isinstance(value, int | torch.SymInt) or not 0 <= value <= LARGEST_INTEGER:
        raise ValueError(
            f"{name}: {argument.name} must be a whole number from 0 to 2^32 - 1, got {value!r}."
        )


def _check_type(name: str, argument: Argument, value: Any, real: torch.dtype | None) -> None:
    """Check the type of a tensor."""
    if not isinstance(value, Tensor):
        raise ValueError(f"{name}: {argument.name} must be a tensor, got {type(value).__name__}.")
    kinds = _TYPES[argument.kind] if argument.kind != "real" or real is None else (real,)
    if value.dtype not in kinds:
        words = " or ".join(str(kind).removeprefix("torch.") for kind in kinds)
        raise ValueError(f"{name}: {argument.name} must be {words}, got {value.dtype}.")


def _check_shape(
    name: str, argument: Argument, shape: Sequence[int], sizes: dict[str, int]
) -> None:
    """Check the shape of a tensor against the sizes that earlier arguments have."""
    axes, last = argument.axes, list(shape)
    if argument.has_batch:
        axes = axes[1:]
        last = last[max(0, len(last) - len(axes)) :]
    is_valid = len(last) == len(axes)
    for axis, size in zip(axes, last, strict=False):
        if axis.islower() and size == 1:
            continue
        expected_size = 1 if axis == "1" else sizes.setdefault(axis.upper(), size)
        is_valid = (
            is_valid and size == expected_size and (size > 0 or axis not in argument.positive)
        )
    if is_valid and max(shape, default=0) <= LARGEST_SIZE:
        return
    text = ", ".join(f"{axis} = {size}" for axis, size in sizes.items())
    bound = "".join(f" and {axis} at least 1" for axis in argument.positive)
    raise ValueError(
        f"{name}: {argument.name} must have shape {argument.shape}{bound}, got {list(shape)}"
        f"{f' with {text}' if text else ''}. Sizes must be below 2^30."
    )


def _check_values(name: str, argument: Argument, value: Tensor, sizes: dict[str, int]) -> None:
    """Check the range of the values of a tensor on the CPU."""
    if value.device.type != "cpu" or torch._C._functorch.is_functorch_wrapped_tensor(value):
        return
    assert argument.limit is not None
    largest = argument.limit.largest(sizes)
    if value.numel() == 0:
        return
    # one pass over the values; NaN passes through, and its comparison is false
    low, high = torch.aminmax(value)
    if low.item() >= 0 and high.item() <= largest:
        return
    wrong = value[~((value >= 0) & (value <= largest))][0].item()
    raise ValueError(
        f"{name}: {argument.name} must be from 0 to {argument.limit.text}, got {wrong:g} with "
        f"{', '.join(f'{axis} = {size}' for axis, size in sizes.items())}."
    )
