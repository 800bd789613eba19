"""Table of the planned pairs of a paper, and table of cost and reliability."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.main_table import format_error_value
from pfbench.report.journal.study_pack import (
    Pack,
    Row,
    filters_by_family,
    filters_by_key,
    find_rows,
    is_number,
    list_pairs,
    name_with_star,
)
from pfbench.report.journal.table_layout import (
    SIZE,
    Column,
    LatexCell,
    LatexTable,
    number_column,
    text_cell,
    text_width,
)

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
        name = f"{looks[str(pair['a'])]['name']} against"
        title = text_cell(name, span=len(head))._replace(alignment="@{}l")
        baseline = _indent(text_cell(str(looks[str(pair["b"])]["name"])))
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
    word = str(pair["word"])
    effect = (
        _effect_cell(_ratio(pair["estimate"]), word)
        if is_number(pair["estimate"])
        else text_cell("--")
    )
    ends = [_ratio(pair[name]) for name in ("low", "high")]
    interval = "--" if "--" in ends else f"[{', '.join(ends)}]"
    return [effect, text_cell(interval), text_cell(_p_value(pair.get("p"))), text_cell(word)]


def make_cost_table(pack: Pack, particles: Mapping[str, str]) -> LatexTable:
    """Build the table of cost and reliability of each filter over all conditions."""
    rows = find_rows(pack)
    has_rounds = any(is_number(row.get("cost")) for row in rows.values())
    columns = [
        Column("l"), Column("r"), number_column(_whole_digits(rows, "ms"), 2), *([Column("l")] * has_rounds),
        number_column(3, 0), number_column(_whole_digits(rows, "lost"), 0), number_column(3, 0),
    ]  # fmt: skip
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
        rf"that keep track, lost runs of {runs}, coverage of 90\,\% regions. \textsuperscript{{*}}: proposed methods. "
        + (_ROUNDS if has_rounds else "Times: one timing per job.")
    )
    return LatexTable("cost", caption, columns, [[_head_cell(text) for text in head]], groups)


def _cost_cells(row: Row, particles: str, has_rounds: bool) -> list[LatexCell]:
    """Return the cells of a filter."""
    track, coverage = (
        f"{100 * row[name]:.0f}" if is_number(row[name]) else "--" for name in ("track", "coverage")
    )
    cost = f"{row['ms']:.2f}" if is_number(row["ms"]) else "--"
    values = (cost, track, str(int(row["lost"] or 0)), coverage)
    cells = [LatexCell("{--}" if text == "--" else text, text_width(text, SIZE)) for text in values]
    if has_rounds:
        ends = f" [{_ratio(row['cost_low'])}, {_ratio(row['cost_high'])}]"
        cells.insert(1, text_cell(_ratio(row["cost"]) + ends if is_number(row["cost"]) else "--"))
    return [text_cell(particles or "--"), *cells]


def _indent(cell: LatexCell) -> LatexCell:
    """Indent a cell."""
    return cell._replace(tex=rf"\hspace*{{{_INDENT:g}pt}}{cell.tex}", width=cell.width + _INDENT)


def _head_cell(text: str) -> LatexCell:
    """Return a cell of the head, protected from siunitx."""
    return LatexCell(f"{{{escape_latex(text)}}}", text_width(text, SIZE))


def _whole_digits(rows: dict[str, Row], name: str) -> int:
    """Return the number of digits before the point of the largest value."""
    values = [float(row[name]) for row in rows.values() if is_number(row[name])]
    return max(1, len(str(int(max(values, default=0.0)))))


def _ratio(value: Any) -> str:
    """Format a ratio with two places, three near 1, or two digits if it is large."""
    if not is_number(value):
        return r"--"
    if f"{value:.2f}" == "1.00" and abs(value - 1) > _EQUAL:
        return f"{value:.3f}"
    return f"{value:.2f}" if 0.095 <= value < 9.995 else format_error_value(value, 2)


def _effect_cell(text: str, word: str) -> LatexCell:
    """Return the cell of an effect: bold if better, with a dagger if worse."""
    tex = escape_latex(text)
    tex = rf"\textbf{{{tex}}}" if word == "better" else tex
    tex += r"\rlap{\textsuperscript{\textdagger}}" if word == "worse" else ""
    return LatexCell(tex, text_width(text, SIZE, is_bold=word == "better"))


def _p_value(value: Any) -> str:
    """Format a p-value with three places."""
    if not is_number(value) or math.isnan(value):
        return "--"
    return f"<{_LEAST_P:g}" if value < _LEAST_P else f"{value:.3f}"
