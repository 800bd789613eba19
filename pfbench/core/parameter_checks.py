"""Checks of parameters in one form of refusal: key, requirement, value and remedy; ranges as intervals."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

RUN_NUMBERS = 1 << 32  # a run number is a word of the random counter; more would repeat streams
_RULE = re.compile(r"(null or )?(whole )?(([(\[])(\S+), ([^\s)\]]+)([)\]]))(?: (.+))?")


def require(ok: object, key: object, must: str, got: object, remedy: str = "") -> None:
    """Raise an error unless a requirement holds.

    Args:
        ok: Whether it holds.
        key: Name of the setting or of the data.
        must: What it must do, beginning with a verb: "be positive".
        got: What was given instead. It is formatted only if the requirement does not hold.
        remedy: What to do, a sentence; without one, to change the key.

    Raises:
        ValueError: If it does not hold.
    """
    if not ok:
        raise ValueError(f"{key} must {must}, got {got}. {remedy or f'Change {key}.'}")


def require_range(key: str, value: Any, rule: str) -> None:
    """Raise an error unless a number is in a range.

    Args:
        key: Name of the setting.
        value: The number.
        rule: An interval and a remedy: "(0, 1] Use 1 for no change.". In front of it may be "whole",
            for whole numbers, and in front of that "null or", where there may be no value.

    Raises:
        ValueError: If it is not.
    """
    range_ = _read(rule)
    got = repr(value) if isinstance(value, str) else value
    require(range_.has(value), key, range_.must, got, range_.remedy)


def require_ranges(owner: str, settings: object, **rules: str) -> None:
    """Raise an error unless the numbers of a part are in their ranges.

    Args:
        owner: Key of the part; empty if the names of the fields are the keys.
        settings: Object with the fields.
        rules: Rule of `require_range` by field.

    Raises:
        ValueError: If one is not.
    """
    for name, rule in rules.items():
        require_range(f"{owner}.{name}" if owner else name, getattr(settings, name), rule)


class _Range(NamedTuple):
    low: float
    high: float
    has_ends: tuple[bool, bool]  # whether low and high belong to it
    is_whole: bool
    may_be_null: bool
    must: str
    remedy: str

    def has(self, value: Any) -> bool:
        """Return whether a value is one of the range; NaN and texts are not."""
        if value is None or (self.is_whole and type(value) is not int):
            return value is None and self.may_be_null
        try:
            is_above = value >= self.low if self.has_ends[0] else value > self.low
            return bool(
                is_above and (value <= self.high if self.has_ends[1] else value < self.high)
            )
        except TypeError:
            return False


@cache
def _read(rule: str) -> _Range:
    """Read a rule of `require_range`."""
    match = _RULE.fullmatch(rule)
    assert match, f"{rule!r} must be an interval and a remedy"
    null, integer, interval, opening, low, high, closing, remedy = match.groups()
    words = f"in {interval}"
    if high == "inf":
        words = f"at least {low}" if opening == "[" else f"above {low}"
        words = "positive" if opening + low == "(0" else words
        words += " and finite" * (closing == ")" and not integer)
    if integer:
        words = f"a whole number {words}".replace("number at", "number of at")
    ends = opening == "[", closing == "]"
    return _Range(
        float(low), float(high), ends, bool(integer), bool(null), f"be {words}", remedy or ""
    )


def as_float64(values: Any) -> Tensor:
    """Return a float64 tensor; tensors inside nested lists keep their gradient."""
    import torch  # here, since rooms that need no torch use the other checks

    if _holds_tensors(values):
        return torch.stack([as_float64(value) for value in values])
    return torch.as_tensor(values, dtype=torch.float64)


def _holds_tensors(values: Any) -> bool:
    from torch import Tensor

    if not isinstance(values, list | tuple):
        return False
    return any(isinstance(value, Tensor) or _holds_tensors(value) for value in values)


def check_positive(name: str, values: Any) -> Tensor:
    """Return a float64 tensor of strictly positive numbers."""
    tensor = as_float64(values)
    ok = bool(((tensor > 0) & tensor.isfinite()).all())
    remedy = "A standard deviation or variance cannot be 0 or negative."
    require(ok, name, "be finite positive numbers", values, remedy)
    return tensor


def check_tuning(tuning: Any, kind: type) -> None:
    """Check that a model has the tuning of its own kind, not that of another recorded scenario."""
    remedy = "Choose another model: pfbench list model scenario=NAME"
    got = type(tuning).__name__
    require(isinstance(tuning, kind), "model.tuning", f"be a {kind.__name__}", got, remedy)


def check_three_positive(name: str, values: Sequence[float]) -> Tensor:
    """Check and return three positive numbers, [3].

    Returns the numbers, [3].
    """
    remedy = "Set one number for each axis."
    require(len(values) == 3, name, "have 3 numbers", list(values), remedy)
    return check_positive(name, list(values))
