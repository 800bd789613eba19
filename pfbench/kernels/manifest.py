"""Manifest of the operators: their arguments, and the checks that are made from it.

`operators.toml` states kind and axes of each argument. The C++ operators check them by
`src/operator_checks.h`, which `python -m pfbench.kernels.manifest` writes. Eager functions and CUDA
kernels check them by `check_arguments`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import torch

FOLDER = Path(__file__).parent
HEADER = FOLDER / "src" / "operator_checks.h"
_ARGUMENT = re.compile(r"(\w+): (\w+)(?: \[(.*)\])?")
_KINDS = {
    "real": (torch.float32, torch.float64),
    "number": (torch.float32, torch.float64, torch.int64),
    "int64": (torch.int64,),
}


class Argument(NamedTuple):
    """An argument of an operator.

    Attributes:
        name: Name.
        kind: `real`, `number`, `int64`, or `int` for a plain integer.
        axes: Letter of each axis, in lower case where the size may also be 1.
    """

    name: str
    kind: str
    axes: str

    @property
    def shape(self) -> str:
        """Shape in words, as in the manifest."""
        words = [f"{axis.upper()} or 1" if axis.islower() else axis for axis in self.axes]
        return f"[{', '.join(words)}]"


@cache
def read_operators() -> dict[str, tuple[Argument, ...]]:
    """Read the arguments of all operators from operators.toml.

    Raises:
        ValueError: If an argument is not written as the head of the file says.
    """
    content = tomllib.loads((FOLDER / "operators.toml").read_text())
    return {
        name: tuple(_parse_argument(name, text) for text in operator["arguments"])
        for name, operator in content.items()
    }


def check_arguments(name: str, arguments: Sequence[Any]) -> None:
    """Check the arguments of an operator.

    Args:
        name: Name of the operator.
        arguments: Its arguments, in order.

    Raises:
        ValueError: If the number, the type or a shape is wrong. The message names the argument.
    """
    expected = read_operators()[name]
    if len(arguments) != len(expected):
        raise ValueError(f"{name} must have {len(expected)} arguments, got {len(arguments)}.")
    sizes: dict[str, int] = {}
    real: torch.dtype | None = None
    for argument, value in zip(expected, arguments, strict=True):
        if argument.kind == "int":
            if not isinstance(value, int | torch.SymInt) or value < 0:
                raise ValueError(
                    f"{name}: {argument.name} must be a whole number from 0 on, got {value!r}."
                )
            continue
        _check_type(name, argument, value, real)
        real = value.dtype if argument.kind == "real" else real
        _check_shape(name, argument, tuple(value.shape), sizes)


def _check_type(name: str, argument: Argument, value: Any, real: torch.dtype | None) -> None:
    """Check the type of a tensor."""
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name}: {argument.name} must be a tensor, got {type(value).__name__}.")
    kinds = _KINDS[argument.kind] if argument.kind != "real" or real is None else (real,)
    if value.dtype not in kinds:
        words = " or ".join(str(kind).removeprefix("torch.") for kind in kinds)
        raise ValueError(f"{name}: {argument.name} must be {words}, got {value.dtype}.")


def _check_shape(
    name: str, argument: Argument, shape: tuple[int, ...], sizes: dict[str, int]
) -> None:
    """Check the shape of a tensor against the sizes that earlier arguments have."""
    is_valid = len(shape) == len(argument.axes)
    for axis, size in zip(argument.axes, shape, strict=False):
        if axis.islower() and size == 1:
            continue
        expected_size = int(axis) if axis.isdigit() else sizes.setdefault(axis.upper(), size)
        is_valid = is_valid and size == expected_size
    if not is_valid:
        sizes_text = ", ".join(f"{axis} = {size}" for axis, size in sizes.items())
        raise ValueError(
            f"{name}: {argument.name} must have shape {argument.shape}, got {list(shape)}"
            f"{f' with {sizes_text}' if sizes_text else ''}."
        )


def _parse_argument(operator: str, text: str) -> Argument:
    """Parse an argument such as `n: number [R|1, 1]`."""
    match = _ARGUMENT.fullmatch(text)
    if match is None or match[2] not in (*_KINDS, "int"):
        raise ValueError(f"{operator}: an argument must be 'name: kind [axes]', got {text!r}.")
    axes = [axis.strip() for axis in (match[3] or "").split(",") if axis.strip()]
    if not all(re.fullmatch(r"[A-Z](\|1)?|1", axis) for axis in axes):
        raise ValueError(f"{operator}: axes must be letters, letters with |1, or 1, got {text!r}.")
    return Argument(match[1], match[2], "".join(a[0].lower() if "|" in a else a for a in axes))


def make_header() -> str:
    """Make the C++ checks of all operators."""
    lines = [
        "// Checks of the operators' arguments. Written by `python -m pfbench.kernels.manifest` from operators.toml.",
        "#pragma once",
        '#include "argument_check.h"',
        "",
        "namespace {",
        "namespace checks {",
    ]
    for name, arguments in read_operators().items():
        types = {"int": "int64_t"}
        signature = ", ".join(f"{types.get(a.kind, 'const Tensor&')} {a.name}" for a in arguments)
        lines += ["", f"inline void {name}({signature}) {{", f'    ArgumentCheck check("{name}");']
        for a in arguments:
            call = (
                f'check.integer("{a.name}", {a.name});'
                if a.kind == "int"
                else f'check.{a.kind}("{a.name}", {a.name}, "{a.axes}");'
            )
            lines.append(f"    {call}")
        lines.append("}")
    return "\n".join([*lines, "", "}  // namespace checks", "}  // namespace", ""])


if __name__ == "__main__":
    HEADER.write_text(make_header())
