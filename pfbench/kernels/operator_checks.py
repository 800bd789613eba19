"""Checks of an operator's arguments in Python, by the manifest.

Eager functions and CUDA kernels make them before they run. The C++ operators make the same ones in
`src/operators.cpp`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

from pfbench.kernels.manifest import Argument, read_operators

_F = TypeVar("_F", bound=Callable[..., Any])
LARGEST_SIZE = (1 << 30) - 1  # of an axis: counters of particles have 32 bits
LARGEST_INTEGER = (1 << 32) - 1
_KINDS = {
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
    kinds = _KINDS[argument.kind] if argument.kind != "real" or real is None else (real,)
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
