"""Errors of all filters in one condition, as they are printed in a table of a paper."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pfbench.report.journal.study_pack import Pack, find_rows, is_number

_KILO = {"m": "km", "": ""}


class ErrorColumn(NamedTuple):
    """Errors of one condition.

    Attributes:
        world: Key of the world.
        regime: Key of the regime.
        unit: Unit that is printed.
        entries: Text, interval and verdict by filter.
    """

    world: str
    regime: str
    unit: str
    entries: dict[str, tuple[str, str, str]]

    def best(self) -> set[str]:
        """Return the filters whose printed number is the smallest of those not shown to be worse."""
        numbers = {
            key: float(text)
            for key, (text, _, verdict) in self.entries.items()
            if verdict != "worse" and is_printed_number(text)
        }
        least = min(numbers.values(), default=math.nan)
        return {key for key, number in numbers.items() if number == least}


def format_error_value(value: Any, digits: int = 3) -> str:
    """Format an error with some significant digits, without an exponent below a million.

    Args:
        value: Error; None if no number exists.
        digits: Number of digits.
    """
    if not is_number(value):
        return "--"
    if value and not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    return np.format_float_positional(
        float(f"{value:.{digits - 1}e}"), trim="-" if value >= 10 ** (digits - 1) else "k",
        precision=digits, unique=False, fractional=False,
    ).rstrip(".")  # fmt: skip


def make_column(pack: Pack, world: str, regime: str) -> ErrorColumn:
    """Collect the entries of one condition, in a unit without many zeros."""
    rows = find_rows(pack, world, regime)
    values = [row["value"] for row in rows.values() if is_number(row["value"])]
    unit = next((str(row["unit"]) for row in rows.values() if row["unit"]), "")
    is_kilo = unit == "m" and bool(values) and float(np.median(values)) >= 1e3
    scale = 1e-3 if is_kilo else 1.0
    entries = {}
    for key, row in rows.items():
        value, low, high = (
            scale * row[name] if is_number(row[name]) else None for name in ("value", "low", "high")
        )
        interval = (
            ""
            if low is None or high is None
            else f"[{format_error_value(low, 2)}, {format_error_value(high, 2)}]"
        )
        text = "lost" if value is None and row.get("lost") else format_error_value(value)
        entries[key] = (text, interval, str(row["verdict"]))
    return ErrorColumn(world, regime, _KILO.get(unit, unit) if is_kilo else unit, entries)


def is_printed_number(text: str) -> bool:
    """Return whether an entry is a number."""
    return text not in ("--", "lost")
