"""Main table of a paper: errors of all filters in all conditions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.study_pack import (
    Pack,
    filters_by_family,
    find_rows,
    is_number,
    list_cells,
    name_of,
    name_with_star,
)
from pfbench.report.journal.table_captions import describe_columns
from pfbench.report.journal.table_layout import (
    INTERVAL_SIZE,
    SIZE,
    Column,
    LatexCell,
    LatexTable,
    text_cell,
)
from pfbench.report.journal.text_width import text_width

ONE_TABLE, WITH_INTERVALS = 8, 16  # cells at most of one table, and of tables with intervals
_KILO = {"m": "km", "": ""}
_DAGGER = r"\rlap{\textsuperscript{\textdagger}}"


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
            if verdict != "worse" and _is_printed_number(text)
        }
        least = min(numbers.values(), default=math.nan)
        return {key for key, number in numbers.items() if number == least}


def make_main_tables(pack: Pack) -> list[LatexTable]:
    """Build the main table: one, or one per regime above eight conditions.

    Args:
        pack: Data of the report.

    Returns:
        Tables of the paper. Above 16 conditions they lack intervals, see `make_supplement`.
    """
    cells = list_cells(pack)
    return _split(pack, cells, "main", has_intervals=len(cells) <= WITH_INTERVALS)


def make_supplement(pack: Pack) -> list[LatexTable]:
    """Build the tables with intervals that the main tables lack, one per regime; empty if they have them.

    Args:
        pack: Data of the report.
    """
    cells = list_cells(pack)
    if len(cells) <= WITH_INTERVALS:
        return []
    return _split(pack, cells, "supplement", has_intervals=True)


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


def _split(
    pack: Pack, cells: Sequence[tuple[str, str]], name: str, *, has_intervals: bool
) -> list[LatexTable]:
    """Build one table, or one per regime if there are many cells."""
    regimes = list(dict.fromkeys(regime for _, regime in cells))
    if len(cells) <= ONE_TABLE and name == "main":
        return [_make_table(pack, cells, name, has_intervals)]
    groups = [[cell for cell in cells if cell[1] == regime] for regime in regimes]
    return [
        _make_table(pack, group, f"{name}_{i}", has_intervals) for i, group in enumerate(groups, 1)
    ]


def _make_table(
    pack: Pack, cells: Sequence[tuple[str, str]], name: str, has_intervals: bool
) -> LatexTable:
    """Build the table of some conditions."""
    columns = [_make_column(pack, *cell) for cell in cells]
    per_cell = 2 if has_intervals else 1
    specs = [Column("l")]
    for _ in columns:
        specs += [Column("r"), Column("l", is_close=True)] if has_intervals else [Column("r")]
    has_one_regime = len({column.regime for column in columns}) == 1
    head, rules = _make_head(pack, columns, per_cell, has_one_regime)
    groups = [
        [[_name_cell(pack, key), *_error_cells(columns, key, has_intervals)] for key in family]
        for family in filters_by_family(pack)
    ]
    caption = describe_columns(
        pack, [(column.world, column.regime) for column in columns], has_intervals, has_one_regime
    )
    return LatexTable(name, caption, specs, head, groups, rules)


def _make_head(
    pack: Pack, columns: Sequence[ErrorColumn], per_cell: int, has_one_regime: bool
) -> tuple[list[list[LatexCell]], list[tuple[int, int]]]:
    """Build the rows of the head: worlds with units, then regimes unless there is one."""
    worlds = list(dict.fromkeys(column.world for column in columns))
    first, rules, start = [text_cell("Method" if has_one_regime else "")], [], 2
    for world in worlds:
        members = [column for column in columns if column.world == world]
        span = per_cell * len(members)
        unit = f" ({members[0].unit})" if members[0].unit else ""
        first.append(text_cell(f"{name_of(pack, 'worlds', world)}{unit}", span=span))
        rules.append((start, start + span - 1))
        start += span
    if has_one_regime:
        return [first], []
    second = [text_cell("Method")]
    for column in columns:
        second.append(text_cell(name_of(pack, "regimes", column.regime), span=per_cell))
    return [first, second], rules


def _make_column(pack: Pack, world: str, regime: str) -> ErrorColumn:
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


def _name_cell(pack: Pack, key: str) -> LatexCell:
    """Return the cell with the name of a filter."""
    name = name_with_star(pack, key)
    tex = escape_latex(name.removesuffix("*")) + (
        r"\textsuperscript{*}" if name[-1:] == "*" else ""
    )
    return LatexCell(tex, text_width(name, SIZE))


def _error_cells(columns: Sequence[ErrorColumn], key: str, has_intervals: bool) -> list[LatexCell]:
    """Return the cells of a filter: number with its mark, and interval."""
    cells = []
    for column in columns:
        text, interval, verdict = column.entries.get(key, ("--", "", ""))
        is_best, is_worse = key in column.best(), verdict == "worse"
        number = rf"\num{{{text}}}" if _is_printed_number(text) else text
        tex = rf"\textbf{{{text}}}" if is_best else number
        tex = rf"\textcolor{{black!62}}{{{number}{_DAGGER}}}" if is_worse else tex
        cells.append(
            LatexCell(tex + r"\phantom{\textsuperscript{\textdagger}}", _error_width(text, is_best))
        )
        if has_intervals:
            small = (
                rf"{{\fontsize{{{INTERVAL_SIZE:g}}}{{{SIZE:g}}}\selectfont {interval}}}"
                if interval
                else ""
            )
            cells.append(LatexCell(small, text_width(interval, INTERVAL_SIZE)))
    return cells


def _error_width(text: str, is_best: bool) -> float:
    """Return the width of a number and the dagger after it."""
    printed = text.replace("e", "×10") if "e" in text and text != "lost" else text
    return text_width(printed, SIZE, is_bold=is_best) + text_width("†", INTERVAL_SIZE)


def _is_printed_number(text: str) -> bool:
    """Return whether an entry is a number."""
    return text not in ("--", "lost")
