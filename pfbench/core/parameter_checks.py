"""Conversion and checks of numerical parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor

RUN_NUMBERS = 1 << 32  # a run number is a word of the random counter; more would repeat streams


def as_float64(values: Any) -> Tensor:
    """Return a float64 tensor; tensors inside nested lists keep their gradient."""
    if _holds_tensors(values):
        return torch.stack([as_float64(value) for value in values])
    return torch.as_tensor(values, dtype=torch.float64)


def _holds_tensors(values: Any) -> bool:
    if not isinstance(values, list | tuple):
        return False
    return any(isinstance(value, Tensor) or _holds_tensors(value) for value in values)


def check_positive(name: str, values: Any) -> Tensor:
    """Return a float64 tensor of strictly positive numbers."""
    tensor = as_float64(values)
    if not bool(((tensor > 0) & torch.isfinite(tensor)).all()):
        raise ValueError(
            f"{name} must be finite positive numbers, got {values}. "
            "A standard deviation or variance cannot be 0 or negative."
        )
    return tensor


def check_tuning(tuning: Any, kind: type) -> None:
    """Check that a model has the tuning of its own kind, not that of another recorded scenario."""
    if not isinstance(tuning, kind):
        raise ValueError(
            f"model.tuning must be a {kind.__name__}, got {type(tuning).__name__}. Choose another model: "
            "pfbench list model scenario=NAME"
        )


def check_whole_number(name: str, value: Any, least: int, remedy: str) -> None:
    """Check a whole number."""
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(
            f"{name} must be a whole number of at least {least}, got {value}. {remedy}"
        )


def check_three_positive(name: str, values: Sequence[float]) -> Tensor:
    """Check and return three positive numbers, [3].

    Returns the numbers, [3].
    """
    if len(values) != 3:
        raise ValueError(
            f"{name} must have 3 numbers, got {list(values)}. Set one number for each axis."
        )
    return check_positive(name, list(values))


def check_run_numbers(runs: Tensor) -> None:
    """Check the range of run numbers on the CPU. On another device the host would wait for them.

    Shapes: runs [R].
    """
    if runs.device.type != "cpu" or isinstance(runs, FakeTensor):
        return
    wrong = runs[(runs < 0) | (runs >= RUN_NUMBERS)].tolist()
    if wrong:
        raise ValueError(
            f"runs must be from 0 to 2**32 - 1, got {wrong[0]}. Use another seed for more runs."
        )
