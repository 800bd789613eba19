"""Captions of the tables of errors."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.study_pack import Pack, find_rows, name_of


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
