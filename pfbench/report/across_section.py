"""Section of a study as a whole: decisions, status of the runs, and figures across conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report import summary, writers
from pfbench.report.decision_section import write_decisions
from pfbench.report.options import ReportContext, select_line_styles
from pfbench.report.plots import comparison_figures, summary_figures
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.results.comparison import condition_blocks
from pfbench.results.comparison.pairwise_results import PairwiseTest


def write_comparison(
    sections: Sequence[Mapping[str, Any]],
    tests: Sequence[PairwiseTest],
    table: pd.DataFrame,
    context: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write decisions and figures across conditions and return their template variables.

    Args:
        sections: Template variables of the conditions.
        tests: All pairwise tests within conditions.
        table: Rows of the runs.
        context: Context of the report.
        note: Budget, below the tables.

    Returns:
        Variables `decisions`, `across` and `said`.
    """
    mains = {section["key"]: section["main"] for section in sections}
    every_group = table
    rows, main_tests, name = summary.select_main_rows(table, tests, mains)
    if name == summary.MAIN:
        table, tests = pd.concat([rows, table], ignore_index=True), [*main_tests, *tests]
    groups = [group for group in (name, *context.groups) if (table.group == group).any()]
    figures = [
        figure
        for group in dict.fromkeys(groups)
        for figure in _list_figures(table, group, tests, context)
    ]
    blocks = condition_blocks.ranking_blocks(rows, name)
    figures = [*summary_figures.summary_figures(blocks, name), *figures]
    counts = [count for section in sections for count in section["status_counts"]]
    formats = context.options.figure_formats
    return {
        "decisions": write_decisions(rows, name, context, note, every_group) if len(rows) else None,
        "across": {"drawings": writers.render_figures(figures, "across", context.folder, formats)},
        "said": summary.summarise_study(main_tests, rows, mains, counts),
    }


def _list_figures(
    table: pd.DataFrame, group: str, tests: Sequence[PairwiseTest], context: ReportContext
) -> list[FigureSpec]:
    """List the figures of a group across conditions."""
    blocks = condition_blocks.ranking_blocks(table, group)
    values = tuple(map(float, np.median(blocks.values, axis=0))) if len(blocks.values) else ()
    labels = [label for _, label in sorted(zip(values, blocks.filters, strict=False))]
    criterion = f"the smallest median RMSE of {group}"
    style, note = select_line_styles(context, blocks.filters, labels, criterion)
    return comparison_figures.study_figures(blocks, tests, style, note)
