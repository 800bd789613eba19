"""Section of the decisions of a study: planned pairs and all filters, in these worlds and in a new one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from pfbench.config.paper_files import plan_installed_pairs
from pfbench.report import writers
from pfbench.report.options import ReportContext
from pfbench.report.plots.decision_plots import plot_planned_pairs
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.results.conditions import natural_sort_key
from pfbench.results.decisions.comparisons import TRACK
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.filter_sets import FilterRanking, order_filters
from pfbench.results.decisions.options import DecisionOptions
from pfbench.results.decisions.planned_pairs import decide_planned_pairs, decide_secondary_metrics
from pfbench.results.decisions.sentences import describe_pair, describe_ranking, describe_total
from pfbench.results.study_decisions.common_conditions import select_common_runs
from pfbench.results.study_decisions.consistency_bands import ConsistencyBand, decide_consistency
from pfbench.results.study_decisions.main_metrics import (
    RULES,
    main_rule,
    tidy_main,
    tidy_secondary,
)

_LARGEST_PERCENT = 10.0  # ratio from which an effect is a factor, not percent


def write_decisions(
    table: pd.DataFrame,
    group: str,
    context: ReportContext,
    note: str,
    all_groups: pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Decide planned pairs and all pairs, and write their tables, figure and records.

    Args:
        table: Rows of `select_main_metrics`.
        group: Name of the main group in these rows.
        context: Context of the report.
        note: Budget, below the tables.
        all_groups: Rows of all groups, for the consistency of the filters; None for those of the table.

    Returns:
        Template variables: sentences, tables and drawings.
    """
    options = DecisionOptions(context.options.alpha, context.options.equivalence_margin)
    metric = context.options.metric
    tidy = tidy_main(table, metric, group)
    labels = sorted(tidy["filter"].unique(), key=natural_sort_key)
    pairs = [pair for pair in plan_installed_pairs(labels) if _share_runs(tidy, *pair)]
    rule = main_rule(metric, group)
    planned = decide_planned_pairs(tidy, pairs, rule, options) if pairs else []
    secondary = _decide_secondary(table, group, pairs, context)
    common, scope = select_common_runs(tidy)
    orders = order_filters(common, rule, options, planned) if len(common) else ()
    bands = decide_consistency(table if all_groups is None else all_groups, options)
    folder = context.folder
    tables = {
        "planned": planned_table(planned),
        "secondary": planned_table(secondary),
        "ranks": rank_table(orders, common),
        "consistency": consistency_table(bands),
    }
    for name, rows in tables.items():
        if len(rows):
            writers.write_table(folder, f"decisions_{name}", rows, note)
    pairwise = [d for order in orders for d in order.decisions if d not in planned]
    writers.write_json(folder, "decisions", [*planned, *secondary, *pairwise])
    writers.write_json(folder, "consistency", bands)
    figures = [_planned_figure(planned, tidy, options)] if planned else []
    return {
        **tables,
        "sentences": [*list_sentences(planned, orders), *([scope] if scope else [])],
        "drawings": writers.render_figures(
            figures, "decisions", folder, context.options.figure_formats
        ),
    }


def list_sentences(
    planned: Sequence[Decision], orders: Sequence[FilterRanking], status: str = ""
) -> list[str]:
    """List the sentences of the decisions: totals, ranking, and each planned pair by size.

    Args:
        planned: Records of `decide_planned_pairs`.
        orders: Orders for both questions, or none.
        status: Sentence that comes first.

    Returns:
        The sentences.
    """
    texts = [status] if status else []
    if planned:
        texts.append(describe_total(planned))
    if orders:
        same_worlds, new = orders
        best = min(
            same_worlds.top_group,
            key=lambda label: (same_worlds.ranks[label], natural_sort_key(label)),
        )
        texts.append(describe_ranking(same_worlds, new, best))
    records = {(d.question, d.a, d.b, d.metric == TRACK): d for d in planned}
    errors = [d for d in planned if d.question == "a" and d.metric != TRACK]
    for error in sorted(errors, key=lambda d: d.estimate):
        for question in ("a", "b"):
            track = records[question, error.a, error.b, True]
            texts.append(describe_pair(track, records[question, error.a, error.b, False]))
    return list(dict.fromkeys(texts))


def planned_table(decisions: Sequence[Decision]) -> pd.DataFrame:
    """Build the table of decisions on pairs, a row per pair, metric and question."""
    return pd.DataFrame(
        [
            {
                "a": d.a,
                "b": d.b,
                "metric": d.metric,
                "question": "in these worlds" if d.question == "a" else "in a new world",
                "effect of a vs b": _format_effect(d, d.estimate),
                "lower": _format_effect(d, d.low),
                "upper": _format_effect(d, d.high),
                "level of the interval [%]": 100 * d.level,
                "adjusted p (Holm)": d.p_corrected,
                "decision on the metric": d.word,
                "decision on the pair": d.pair_word or "–",
                "worlds": d.worlds,
                "runs per condition": d.runs,
                "track kept a [%]": 100 * d.share_a,
                "track kept b [%]": 100 * d.share_b,
                "reason": d.reason,
            }
            for d in decisions
        ]
    )


def rank_table(orders: Sequence[FilterRanking], tidy: pd.DataFrame) -> pd.DataFrame:
    """Build the table of rank intervals, a row per filter.

    Args:
        orders: Orders for both questions, or none.
        tidy: Table of `tidy_runs`.

    Returns:
        The table, best filters first; empty without orders.
    """
    if not orders:
        return pd.DataFrame()
    same_worlds, new = orders
    shares = tidy.groupby("filter")["keeps_track"].mean()
    labels = sorted(
        same_worlds.ranks, key=lambda label: (same_worlds.ranks[label], natural_sort_key(label))
    )
    return pd.DataFrame(
        [
            {
                "filter": label,
                "rank in these worlds": "{} to {}".format(*same_worlds.ranks[label]),
                "rank in a new world": "{} to {}".format(*new.ranks[label]),
                "top group in these worlds": label in same_worlds.top_group,
                "track kept [%]": 100 * float(shares[label]),
            }
            for label in labels
        ]
    )


def consistency_table(bands: Sequence[ConsistencyBand]) -> pd.DataFrame:
    """Build the table of mean NEES and NIS over their expectation, a row per filter and group."""
    return pd.DataFrame(
        [
            {
                "filter": band.label,
                "quantity": band.quantity,
                "group": band.group,
                "mean / expectation": band.estimate,
                "lower": band.low,
                "upper": band.high,
                "adjusted p (Holm)": band.p_corrected,
                "decision": band.word,
                "lost runs": band.lost,
                "reason": band.reason,
            }
            for band in bands
        ]
    )


def _decide_secondary(
    table: pd.DataFrame, group: str, pairs: Sequence[tuple[str, str]], context: ReportContext
) -> list[Decision]:
    """Decide the metrics of the second family: all that have values, except the main one."""
    options = DecisionOptions(context.options.alpha, context.options.equivalence_margin)
    metrics = tidy_secondary(table, group)
    metrics.pop(context.options.metric, None)
    if not pairs or not metrics:
        return []
    rules = [replace(RULES[name], group=group) for name in metrics]
    tables = {rule.name: rows for rule, rows in zip(rules, metrics.values(), strict=True)}
    return decide_secondary_metrics(tables, pairs, rules, options)


def _share_runs(tidy: pd.DataFrame, a: str, b: str) -> bool:
    """Return whether two filters have a condition in common."""
    conditions = [
        set(map(tuple, tidy.loc[tidy["filter"] == label, ["scenario", "regime"]].to_numpy()))
        for label in (a, b)
    ]
    return bool(conditions[0] & conditions[1])


def _format_effect(decision: Decision, value: float) -> str:
    """Format an effect with its unit: percent or a factor for ratios, points for shares."""
    if not np.isfinite(value):
        return "–"
    if decision.scale == "difference":
        return f"{value:+.3g}"
    if decision.scale != "log ratio":
        return f"{0.0 - 100 * value:+.1f} points"  # no negative zero
    if abs(value) > np.log(_LARGEST_PERCENT):
        return f"factor {np.exp(value):.3g}"
    return f"{100 * np.expm1(value):+.1f} %"


def _planned_figure(
    planned: Sequence[Decision], tidy: pd.DataFrame, options: DecisionOptions
) -> FigureSpec:
    """Return the forest of planned pairs."""
    errors = [d for d in planned if d.metric != TRACK]
    worlds = tidy["family"].nunique()
    text = (
        f"Error of the first filter divided by that of the second, {worlds} "
        f"{'world' if worlds == 1 else 'worlds'}. Thick: in these worlds. "
        + ("Thin: in a new world of this kind. " if worlds > 1 else "")
        + "Simultaneous intervals. Filled: decided. Shaded: equivalence within "
        f"{100 * options.margin:g} %. Blue is better, orange is worse."
    )
    return FigureSpec("planned", text, partial(plot_planned_pairs, errors, options.margin))
