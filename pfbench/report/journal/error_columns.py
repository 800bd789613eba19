"""Columns of errors of a table of a paper: entries as they are printed, and their caption."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.study_pack import Pack, find_rows, is_number, name_of

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
    """Collect the entries of one condition, in a unit without many zeros.

    Args:
        pack: Data of the report.
        world: Key of the world.
        regime: Key of the regime.
    """
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


def describe_columns(
    pack: Pack, cells: Sequence[tuple[str, str]], has_intervals: bool, has_one_regime: bool
) -> str:
    """Write the caption of a table of errors: metric, interval, marks and lost runs.

    Args:
        pack: Data of the report.
        cells: Worlds and regimes of the columns.
        has_intervals: State the intervals.
        has_one_regime: State the regime, which the head lacks.

    Returns:
        LaTeX.
    """
    metric = escape_latex(str(pack["metrics"][0]["name"]))
    level = f"{100 * (1 - float(pack['alpha'])):g}"
    interval = rf" and its {level}\,\% interval" if has_intervals else ""
    where = (
        f", {escape_latex(name_of(pack, 'regimes', cells[0][1]).lower())}"
        if has_one_regime and len(pack["regimes"]) > 1
        else ""
    )
    return (
        f"{metric}: trimmed mean over runs on the logarithmic scale{interval}{where}. Bold: smallest. "
        r"\textsuperscript{\textdagger}: shown to be worse than the smallest, jointly for all comparisons "
        r"of the column; the others are not told apart from it. \textsuperscript{*}: proposed methods."
        + _describe_absent(pack, cells)
        + _describe_lost(pack, cells)
    )


def _describe_absent(pack: Pack, cells: Sequence[tuple[str, str]]) -> str:
    """Explain the dash of filters without an error in a condition; empty if there is none."""
    rows = [find_rows(pack, world, regime) for world, regime in cells]
    keys = [str(look["key"]) for look in pack["filters"]]
    has_dash = any(
        key not in row or (row[key]["value"] is None and not row[key].get("lost"))
        for row in rows
        for key in keys
    )
    return (
        " --: no error to compare, because the track is not kept or the filter was not run."
        if has_dash
        else ""
    )


def _describe_lost(pack: Pack, cells: Sequence[tuple[str, str]]) -> str:
    """List the filters that lost runs in these conditions."""
    counts: dict[str, int] = {}
    for world, regime in cells:
        for key, row in find_rows(pack, world, regime).items():
            counts[key] = counts.get(key, 0) + int(row.get("lost") or 0)
    lost = {key: number for key, number in counts.items() if number}
    if not lost:
        return " No run was lost."
    if len(lost) > 6:
        return rf" Lost runs of {len(lost)} filters: Table~\ref{{tab:cost}}."
    names = {str(look["key"]): str(look["name"]) for look in pack["filters"]}
    listed = ", ".join(f"{escape_latex(names[key])} {number}" for key, number in lost.items())
    return f" Lost runs, counted as the largest errors: {listed}."
