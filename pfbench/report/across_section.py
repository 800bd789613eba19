"""Section of the comparison across conditions, and the summary of a large study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report import baselines, comparison_tables, summary, writers
from pfbench.report.condition_section import PAIRS
from pfbench.report.options import ReportContext, select_line_styles
from pfbench.report.plots import comparison_figures, summary_figures
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.plotting import format_slug
from pfbench.results.comparison import condition_blocks, rankings
from pfbench.results.comparison.lost_run_rules import LOST_RUN_RULES
from pfbench.results.comparison.lost_run_sensitivity import lost_rule_sensitivity
from pfbench.results.comparison.pairwise_results import PairwiseTest
from pfbench.results.comparison.ranking_results import RankingResult
from pfbench.results.status import StatusCounts


def write_comparison(
    sections: Sequence[Mapping[str, Any]],
    tests: Sequence[PairwiseTest],
    table: pd.DataFrame,
    context: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write the comparison across conditions and return its template variables.

    Args:
        sections: Template variables of the conditions.
        tests: All pairwise tests.
        table: Rows of the runs.
        context: Context of the report.
        note: Budget, below the tables.
    """
    options = context.options
    mains = {section["key"]: section["main"] for section in sections}
    rows, main_tests, name = summary.select_main_rows(table, tests, mains)
    if context.brief and name == summary.MAIN:
        table = pd.concat([rows, table], ignore_index=True)
    scored = [group for group in (name, *context.groups) if (table.group == group).any()]
    results = [
        rankings.rank_filters(table, group, options.alpha, options.equivalence_margin)
        for group in dict.fromkeys(scored)
    ]
    writers.write_json(context.folder, "across", results)
    matrix_tests = [*main_tests, *tests] if scored[0] == summary.MAIN else tests
    across = _write_across(table, results, matrix_tests, context, note)
    if not context.brief:
        return {"across": across, "headline": None}
    counts = [count for section in sections for count in section["status_counts"]]
    return {
        "across": across,
        "headline": _write_headline(table, results[0], main_tests, mains, counts, context, note),
    }


def _write_across(
    table: pd.DataFrame,
    results: Sequence[RankingResult],
    tests: Sequence[PairwiseTest],
    context: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write the figures and tables across conditions and return their template variables."""
    folder, options = context.folder, context.options
    group_rows = table[table.group != summary.MAIN]
    ranks = comparison_tables.rank_table(results)
    changes = comparison_tables.lost_rule_table(lost_rule_sensitivity(group_rows, options.alpha))
    for name, values in (("ranks", ranks), ("lost_rules", changes)):
        if len(values):
            writers.write_table(folder, f"across_{name}", values, note)
    drawings = [
        drawing for ranking in results for drawing in _list_figures(table, ranking, tests, context)
    ]
    refused: dict[str, list[str]] = {}
    for ranking in results:
        if ranking.refused:
            refused.setdefault(ranking.refused, []).append(ranking.group)
    return {
        "parts": [_write_group(table, ranking, context, note) for ranking in results],
        "refused": refused,
        "ranked": ranks,
        "sensitive": changes,
        "lost": bool(table.lost.any()),
        "drawings": writers.render_figures(drawings, "across", folder, options.figure_formats),
    }


def _write_group(
    table: pd.DataFrame, ranking: RankingResult, context: ReportContext, note: str
) -> dict[str, Any]:
    """Write the pairs of a group across conditions and return their template variables."""
    pairs = comparison_tables.ranking_pair_table(ranking)
    if len(pairs):
        name = f"across_{format_slug(ranking.group)}"
        writers.write_table(context.folder, name, pairs, note)
    best = min(zip(ranking.ranks, ranking.filters, strict=True))[1] if ranking.ranks else ""
    with_best = pairs[(pairs.a == best) | (pairs.b == best)] if len(pairs) > PAIRS else pairs
    winners_by_rule = {
        rule.name: rankings.winners_by_rule(table, ranking.group, context.options.alpha, rule)
        for rule in LOST_RUN_RULES[1:]
    }
    return {
        "one": ranking,
        "pairs": with_best,
        "n": len(pairs),
        "best": best,
        "changed": _format_changes(ranking, winners_by_rule),
    }


def _list_figures(
    table: pd.DataFrame,
    ranking: RankingResult,
    tests: Sequence[PairwiseTest],
    context: ReportContext,
) -> list[FigureSpec]:
    """List the figures of a group across conditions."""
    blocks = condition_blocks.ranking_blocks(table, ranking.group)
    values = ranking.ranks or tuple(map(float, np.median(blocks.values, axis=0)))
    labels = [label for _, label in sorted(zip(values, ranking.filters, strict=True))]
    quantity = "the best mean ranks" if ranking.ranks else "the smallest median RMSE"
    criterion = f"{quantity} of {ranking.group}"
    style, note = select_line_styles(context, ranking.filters, labels, criterion)
    return comparison_figures.study_figures([(ranking, blocks)], tests, style, note)


def _write_headline(
    table: pd.DataFrame,
    ranking: RankingResult,
    tests: Sequence[PairwiseTest],
    mains: Mapping[summary.CellName, str],
    status_counts: Sequence[tuple[str, StatusCounts]],
    context: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write the figures and the table of the summary and return its template variables."""
    folder, options = context.folder, context.options
    blocks = condition_blocks.ranking_blocks(table, ranking.group)
    pairs = baselines.compare_with_baselines(blocks, tests, options.alpha)
    planned = comparison_tables.baseline_table(pairs)
    if pairs:
        writers.write_table(folder, "proposed", planned, note)
        writers.write_json(folder, "proposed", pairs)
    group_rows = table[table.group == ranking.group]
    text = summary.summarise_study(ranking, tests, pairs, group_rows, mains, status_counts)
    drawings = summary_figures.summary_figures(ranking, blocks, pairs, options.alpha, text.group)
    return {
        "said": text,
        "planned": planned,
        "drawings": writers.render_figures(drawings, "all", folder, options.figure_formats),
        "critical": f"across_critical_difference_{format_slug(ranking.group)}",
    }


def _format_changes(
    ranking: RankingResult, winners_by_rule: Mapping[str, dict[tuple[str, str], str] | str]
) -> list[str]:
    """Format the number of decisions across conditions that change under other lost-run rules."""
    if ranking.refused:
        return []
    texts = []
    for rule, winners in winners_by_rule.items():
        if isinstance(winners, str):
            texts.append(f"{rule}: {winners}")
        else:
            n = sum(winners.get((p.a, p.b)) != p.winner for p in ranking.pairs)
            texts.append(f"{rule}: {n} of {len(ranking.pairs)}")
    return texts
