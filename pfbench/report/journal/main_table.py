"""Tables of a paper: errors of all filters in all conditions, planned pairs, cost and reliability."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.study_pack import (
    Pack,
    Row,
    filters_by_family,
    filters_by_key,
    find_rows,
    is_number,
    list_cells,
    list_pairs,
    name_baseline,
    name_of,
    name_with_star,
)
from pfbench.report.journal.table_layout import (
    INTERVAL_SIZE,
    SIZE,
    Column,
    LatexCell,
    LatexTable,
    text_cell,
    text_width,
)
from pfbench.report.writers import format_short

_DAGGER = r"\rlap{\textsuperscript{\textdagger}}"


Fits = Callable[[LatexTable], bool]


def make_main_tables(pack: Pack, fits: Fits) -> list[LatexTable]:
    """Build the main tables of a paper: one per noise regime, each with as many worlds as fit."""
    cells = list_cells(pack)
    parts: list[tuple[list[str], str]] = []
    for regime in dict.fromkeys(regime for _, regime in cells):
        worlds = [world for world, of in cells if of == regime]
        for count in range(1, len(worlds) + 1):
            ends = [i * len(worlds) // count for i in range(count + 1)]
            split = [worlds[start:end] for start, end in pairwise(ends)]
            if all(fits(_make_table(pack, some, regime, "main")) for some in split):
                break
        parts += [(some, regime) for some in split]
    names = [f"main_{i}" for i in range(1, len(parts) + 1)] if len(parts) > 1 else ["main"]
    return [
        _make_table(pack, worlds, regime, name)
        for (worlds, regime), name in zip(parts, names, strict=True)
    ]


def _make_table(pack: Pack, worlds: Sequence[str], regime: str, name: str) -> LatexTable:
    """Build the table of some worlds in a noise regime."""
    columns = [make_column(pack, world, regime) for world in worlds]
    specs = [Column("l"), *[Column("r"), Column("l", is_close=True)] * len(columns)]
    groups = [
        [[text_cell(name_with_star(pack, key)), *_error_cells(columns, key)] for key in family]
        for family in filters_by_family(pack)
    ]
    names = [  # of worlds with units, in lines of about equal width
        _break_name(f"{name_of(pack, 'worlds', c.world)}{f' ({c.unit})' if c.unit else ''}") for c in columns
    ]  # fmt: skip
    upper, lower = (
        [text_cell(first), *(text_cell(line, span=2) for line in lines)]
        for first, lines in zip(("", "Method"), zip(*names, strict=True), strict=True)
    )
    head = [upper, lower] if any(line for line, _ in names) else [lower]
    return LatexTable(name, describe_columns(pack, worlds, regime), specs, head, groups)


def _break_name(name: str) -> tuple[str, str]:
    """Break a name at the space that gives the least width; the first line is empty without a space."""
    words = name.split(" ")
    breaks = [(" ".join(words[:i]), " ".join(words[i:])) for i in range(1, len(words))]
    return min(breaks, key=lambda lines: max(map(len, lines)), default=("", name))


def _error_cells(columns: Sequence[ErrorColumn], key: str) -> list[LatexCell]:
    """Return the cells of a filter: number with its mark, and interval."""
    cells = []
    for column in columns:
        text, interval, verdict = column.entries.get(key, ("--", "", ""))
        is_best, is_number = key in column.best(), is_printed_number(text)
        number = rf"\num{{{text}}}" if is_number else text
        tex = rf"\textbf{{{text}}}" if is_best else number
        if verdict == "worse":
            tex = rf"\textcolor{{black!62}}{{{number}{_DAGGER}}}"
        printed = text.replace("e", "×10") if is_number else text
        width = text_width(printed, SIZE, is_bold=is_best) + text_width("†", INTERVAL_SIZE)
        cells.append(LatexCell(tex + r"\phantom{\textsuperscript{\textdagger}}", width))
        cells.append(text_cell(interval, size=INTERVAL_SIZE))
    return cells


# --------------------------------------------------------------------------------------------------
# Columns of errors of a table of a paper: entries as they are printed, and their caption.

_KILO = {"m": "km", "": ""}


class ErrorColumn(NamedTuple):
    """Errors of one condition.

    Attributes:
        world: Key of the world.
        unit: Unit that is printed.
        entries: Text, interval and verdict by filter.
    """

    world: str
    unit: str
    entries: dict[str, tuple[str, str, str]]

    def best(self) -> set[str]:
        """Return the filters whose printed number is the smallest."""
        numbers = {
            key: float(text)
            for key, (text, _, _) in self.entries.items()
            if is_printed_number(text)
        }
        least = min(numbers.values(), default=math.nan)
        return {key for key, number in numbers.items() if number == least}


def format_entry(value: Any, digits: int = 3) -> str:
    """Format a number with significant digits; two hyphens without one."""
    return format_short(value, digits) if is_number(value) else "--"


def make_column(pack: Pack, world: str, regime: str) -> ErrorColumn:
    """Collect the entries of one condition, in a unit without many zeros."""
    rows = find_rows(pack, world, regime)
    values = [row["value"] for row in rows.values() if is_number(row["value"])]
    unit = next((str(row["unit"]) for row in rows.values() if row["unit"]), "")
    is_kilo = unit == "m" and bool(values) and float(np.median(values)) >= 1e3
    scale = 1e-3 if is_kilo else 1.0
    entries = {}
    for key, row in rows.items():
        value, *ends = (scale * row[name] if is_number(row[name]) else None for name in ("value", "low", "high"))  # fmt: skip
        loses = row["verdict"] == "loses track"
        interval = f"[{', '.join(format_entry(end, 2) for end in ends)}]"
        text = "lost" if loses or (value is None and row.get("lost")) else format_entry(value)
        entries[key] = (text, "" if loses or None in ends else interval, str(row["verdict"]))
    return ErrorColumn(world, _KILO.get(unit, unit) if is_kilo else unit, entries)


def is_printed_number(text: str) -> bool:
    """Return whether an entry is a number."""
    return text not in ("--", "lost")


def describe_columns(pack: Pack, worlds: Sequence[str], regime: str) -> str:
    """Write the caption of a table of errors: metric, interval, marks and lost runs.

    Returns LaTeX.
    """
    metric = escape_latex(str(pack["metrics"][0]["name"]))
    level = f"{100 * (1 - float(pack['alpha'])):g}"
    tables = [find_rows(pack, world, regime) for world in worlds]
    noise = f", {escape_latex(name_of(pack, 'regimes', regime).lower())}"
    where = noise if len(pack["regimes"]) > 1 else ""
    has_dash = any(
        key not in row or (row[key]["value"] is None and not row[key].get("lost"))
        for row in tables
        for key in filters_by_key(pack)
    )
    dash = " --: no error to compare, because the track is not kept or the filter was not run."
    return (
        rf"{metric}: median over runs and its {level}\,\% interval{where}. Bold: smallest. "
        rf"\textsuperscript{{\textdagger}}: shown to be worse than {escape_latex(name_baseline(pack))}, jointly for all filters "
        r"of the column. lost: shown to keep track in fewer than 80\,\% of runs. \textsuperscript{*}: proposed methods."
        + dash * has_dash
        + _describe_lost(pack, tables)
    )


def _describe_lost(pack: Pack, tables: Sequence[Mapping[str, Row]]) -> str:
    """List the filters that lost runs in these conditions."""
    counts: Counter[str] = Counter()
    for rows in tables:
        counts.update({key: int(row.get("lost") or 0) for key, row in rows.items()})
    lost = +counts
    if not lost:
        return " No run was lost."
    if len(lost) > 6:
        return rf" Lost runs of {len(lost)} filters: Table~\ref{{tab:cost}}."
    looks = filters_by_key(pack)
    listed = ", ".join(f"{escape_latex(str(looks[k]['name']))} {n}" for k, n in lost.items())
    return f" Lost runs, which are worse than all others: {listed}."


# --------------------------------------------------------------------------------------------------
# Table of the planned pairs of a paper, and table of cost and reliability.

_INDENT = 6.0  # points, of a baseline below its method
_EQUAL = 5e-4  # ratios further from 1 are not printed as 1.00
_LEAST_P = 0.001
_ROUNDS = "Times: medians of rounds in which the filters took turns; ratio to the baseline by round with its interval."


def make_planned_table(pack: Pack) -> LatexTable | None:
    """Build the table of the pairs that were compared in advance; None without one that has a ratio."""
    if not list_pairs(pack):
        return None
    looks = filters_by_key(pack)
    head = ["Method and baseline", "ratio", "interval", "p", "verdict"]
    groups: dict[str, list[list[LatexCell]]] = {}
    for pair in pack["planned"]:
        method, name = (str(looks[str(pair[side])]["name"]) for side in ("a", "b"))
        title = text_cell(f"{method} against", span=len(head))._replace(alignment="@{}l")
        baseline = text_cell(name)
        baseline = baseline._replace(tex=rf"\hspace*{{{_INDENT:g}pt}}{baseline.tex}", width=baseline.width + _INDENT)  # fmt: skip
        groups.setdefault(str(pair["a"]), [[title]]).append([baseline, *_pair_cells(pair)])
    worlds = len(pack["worlds"])
    where = f"these {worlds} worlds" if worlds > 1 else "the runs of this world"
    caption = (
        rf"Pairs compared in advance: error of the method divided by that of the baseline over {where}, by Hodges "
        r"and Lehmann. Intervals are simultaneous, with Holm's correction of \textit{p} over all pairs."
    )
    heads = [[text_cell(text) for text in head]]
    specs = list(map(Column, ["l", "r", "l", "r", "l"]))
    return LatexTable("planned", caption, specs, heads, list(groups.values()))


def _pair_cells(pair: Pack) -> list[LatexCell]:
    """Return the cells of a pair after its name."""
    word, p = str(pair["word"]), pair.get("p")
    effect = text_cell(_ratio(pair["estimate"]), is_bold=word == "better")
    if not is_number(pair["estimate"]):
        effect = text_cell("--")
    elif word == "worse":
        effect = effect._replace(tex=effect.tex + _DAGGER)
    ends = [_ratio(pair[name]) for name in ("low", "high")]
    interval = "--" if "--" in ends else f"[{', '.join(ends)}]"
    p_value = "--" if p is None or not is_number(p) else f"<{_LEAST_P:g}" if p < _LEAST_P else f"{p:.3f}"  # fmt: skip
    return [effect, text_cell(interval), text_cell(p_value), text_cell(word)]


def make_cost_table(pack: Pack, particles: Mapping[str, str]) -> LatexTable:
    """Build the table of cost and reliability of each filter over all conditions."""
    rows = find_rows(pack)
    has_rounds = any(is_number(row.get("cost")) for row in rows.values())
    columns = [*map(Column, "lrr"), *([Column("l")] * has_rounds), *map(Column, "rrr")]
    ratio = ["ratio"] if has_rounds else []
    head = ["Method", "N", "ms/step", *ratio, "track (%)", "lost", "coverage (%)"]
    groups = [
        [
            [
                text_cell(name_with_star(pack, key)),
                *_cost_cells(rows[key], particles.get(key, ""), has_rounds),
            ]
            for key in family
            if key in rows
        ]
        for family in filters_by_family(pack)
    ]
    runs = sum(int(cell["runs"]) for cell in pack["cells"])
    caption = (
        r"Cost and reliability over all conditions: particles \textit{N}, time per step of a batch of runs, share of runs "
        rf"that keep track, lost runs of {runs}, coverage of 90\,\% intervals. \textsuperscript{{*}}: proposed methods. "
        + (
            _ROUNDS
            if has_rounds
            else "Times: one timing per job, none of one with its first steps."
        )
    )
    return LatexTable("cost", caption, columns, [[text_cell(text) for text in head]], groups)


def _cost_cells(row: Row, particles: str, has_rounds: bool) -> list[LatexCell]:
    """Return the cells of a filter."""
    track, coverage = (
        f"{100 * row[name]:.0f}" if is_number(row[name]) else "--" for name in ("track", "coverage")
    )
    cost = f"{row['ms']:.2f}" if is_number(row["ms"]) else "--"
    cells = [text_cell(text) for text in (cost, track, str(int(row["lost"] or 0)), coverage)]
    if has_rounds:
        ends = f" [{_ratio(row['cost_low'])}, {_ratio(row['cost_high'])}]"
        cells.insert(1, text_cell(_ratio(row["cost"]) + ends if is_number(row["cost"]) else "--"))
    return [text_cell(particles or "--"), *cells]


def _ratio(value: Any) -> str:
    """Format a ratio with two places, three near 1, or two digits if it is large."""
    if not is_number(value):
        return r"--"
    if f"{value:.2f}" == "1.00" and abs(value - 1) > _EQUAL:
        return f"{value:.3f}"
    return f"{value:.2f}" if 0.095 <= value < 9.995 else format_entry(value, 2)
