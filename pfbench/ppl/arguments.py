"""Checks of the arguments of inference algorithms."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any


def check_counts(algorithm: str, counts: Mapping[str, tuple[Any, int]]) -> None:
    """Check whole numbers.

    Args:
        algorithm: Name of the algorithm, for the message.
        counts: Value and least value by argument.

    Raises:
        ValueError: If a value is not a whole number, or is too small.
    """
    for name, (value, least) in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(
                f"{algorithm}.{name} must be a whole number of at least {least}, got {value!r}. "
                f"Change {name}."
            )


def check_kinds(algorithm: str, values: Mapping[str, tuple[Any, Any]]) -> None:
    """Check the classes of arguments.

    Args:
        algorithm: Name of the algorithm, for the message.
        values: Value and class by argument.

    Raises:
        ValueError: If a value is of another class.
    """
    for name, (value, kind) in values.items():
        is_class = isinstance(value, type) and kind is not Callable
        if is_class or not isinstance(value, kind):
            class_name = (value if isinstance(value, type) else type(value)).__name__
            raise ValueError(
                f"{algorithm}.{name} must be a {kind.__name__}, got {class_name}. "
                f"Pass an instance of {kind.__name__}."
            )


def check_number(
    algorithm: str, name: str, value: Any, low: float, high: float, bounds: str
) -> None:
    """Check a real number.

    Args:
        algorithm: Name of the algorithm, for the message.
        name: Argument.
        value: Its value.
        low: Least value.
        high: Largest value.
        bounds: Brackets of the interval, such as `[)` without the largest value.

    Raises:
        ValueError: If the value is not a number of the interval.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    is_inside = is_number and math.isfinite(value) and low <= value <= high
    if is_inside and (value > low or bounds[0] == "[") and (value < high or bounds[1] == "]"):
        return
    raise ValueError(
        f"{algorithm}.{name} must be a number in {bounds[0]}{low:g}, {high:g}{bounds[1]}, got "
        f"{value!r}. Change {name}."
    )
