"""Results of the operators by the manifest: their types and shapes, for torch's compiler."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.kernels.manifest import FOLDER, read_operators

_RESULT = re.compile(r"(real|float32|float64|int64|bool) \[(.*)\]")
_TERM = re.compile(r"(?:(\d+) )?(\w+)")


class OperatorResult(NamedTuple):
    """A result of an operator.

    Attributes:
        kind: Type, or `real` for that of the real arguments.
        axes: Size of each axis: sums of sizes with factors, as (factor, name) pairs.
    """

    kind: str
    axes: tuple[tuple[tuple[int, str], ...], ...]


@cache
def read_results() -> dict[str, tuple[OperatorResult, ...]]:
    """Read the results of all operators from operators.toml.

    Raises:
        ValueError: If a result is not written as the head of the file says.
    """
    content = tomllib.loads((FOLDER / "operators.toml").read_text())
    return {
        name: tuple(_parse_result(name, text) for text in operator["results"])
        for name, operator in content.items()
    }


def make_empty_results(name: str, *arguments: Any) -> Any:
    """Make results of an operator with the right types and shapes, contiguous, without values.

    Args:
        name: Name of the operator.
        arguments: Its valid arguments, in order, with its batch as one axis.

    Returns:
        A tensor, or a tuple of several.
    """
    sizes: dict[str, Any] = {"1": 1}
    template, real = next(a for a in arguments if isinstance(a, Tensor)), None
    for argument, value in zip(read_operators()[name], arguments, strict=True):
        if argument.kind == "int":
            sizes[argument.name] = value
            continue
        if argument.kind == "real" and real is None:
            real = value.dtype
        if value.dim():
            template = value
        for axis, size in zip(argument.axes, value.shape, strict=True):
            if axis.isupper():
                sizes[axis] = size
            else:  # R or 1
                sizes.setdefault(axis.upper(), size)
    results = []
    for kind, axes in read_results()[name]:
        shape = [sum(factor * sizes[axis] for factor, axis in terms) for terms in axes]
        dtype = real if kind == "real" else getattr(torch, kind)
        results.append(template.new_empty(shape, dtype=dtype))
    return results[0] if len(results) == 1 else tuple(results)


def register_shapes(name: str) -> None:
    """Register the results of an operator for torch's compiler.

    Args:
        name: Name of the operator.
    """
    function: Callable[..., Any] = partial(make_empty_results, name)
    torch.library.register_fake(f"pfbench::{name}", function)


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
