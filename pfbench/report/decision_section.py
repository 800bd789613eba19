"""Section of the decisions of a study: planned pairs and all filters, in these worlds and in a new one."""

from __future__ import annotations

from collections.abc import Sequence
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
from pfbench.results.decisions.options import DecisionOptions, MetricRule
from pfbench.results.decisions.planned_pairs import decide_planned_pairs, decide_secondary_metrics
from pfbench.results.decisions.sentences import describe_pair, describe_ranking, describe_total
from pfbench.results.decisions.tidy_table import tidy_runs

# metrics of the second family: name in the table of runs, and in sentences
SECONDARY = {"max_error": "largest error", "energy": "energy score"}
_LARGEST_PERCENT = 10.0  # ratio from which an effect is a factor, not percent


def write_decisions(
    table: pd.DataFrame, group: str, context: ReportContext, note: str
) -> dict[str, Any]:
    """Decide planned pairs and all pairs, and write their tables, figure and records.

    Args:
        table: Rows of `load_frame` for the main groups, under one name.
        group: That name.
        context: Context of the report.
        note: Budget, below the tables.

    Returns:
        Template variables: sentences, tables and drawings.
    """
    options = DecisionOptions(context.options.alpha, context.options.equivalence_margin)
    tidy = tidy_runs(table, group=group)
    labels = sorted(tidy["filter"].unique(), key=natural_sort_key)
    pairs = [pair for pair in plan_installed_pairs(labels) if _share_runs(tidy, *pair)]
    rule = MetricRule(f"{group} error", group=group)
    planned = decide_planned_pairs(tidy, pairs, rule, options) if pairs else []
    secondary = _decide_secondary(table, group, pairs, options)
    orders = order_filters(tidy, rule, options) if _is_complete(tidy, labels) else ()
    folder = context.folder
    tables = {
        "planned": planned_table(planned),
        "secondary": planned_table(secondary),
        "ranks": rank_table(orders, tidy),
    }
    for name, rows in tables.items():
        if len(rows):
            writers.write_table(folder, f"decisions_{name}", rows, note)
    records = [*planned, *secondary, *(d for order in orders for d in order.decisions)]
    writers.write_json(folder, "decisions", records)
    figures = [_planned_figure(planned, tidy, options)] if planned else []
    return {
        **tables,
        "sentences": list_sentences(planned, orders),
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


def _decide_secondary(
    table: pd.DataFrame, group: str, pairs: Sequence[tuple[str, str]], options: DecisionOptions
) -> list[Decision]:
    """Decide the metrics of the second family that all rows of the main groups have."""
    present = set(table["metric"])
    names = [name for name in SECONDARY if name in present]
    if not pairs or not names:
        return []
    tables = {SECONDARY[name]: tidy_runs(table, name, group) for name in names}
    rules = [MetricRule(SECONDARY[name], group=group) for name in names]
    return decide_secondary_metrics(tables, pairs, rules, options)


def _share_runs(tidy: pd.DataFrame, a: str, b: str) -> bool:
    """Return whether two filters have a condition in common."""
    conditions = [
        set(map(tuple, tidy.loc[tidy["filter"] == label, ["scenario", "regime"]].to_numpy()))
        for label in (a, b)
    ]
    return bool(conditions[0] & conditions[1])


def _is_complete(tidy: pd.DataFrame, labels: Sequence[str]) -> bool:
    """Return whether there are several filters, and all have all conditions."""
    conditions = tidy[["filter", "scenario", "regime"]].drop_duplicates()
    counts = conditions["filter"].value_counts()
    return len(labels) > 1 and counts.nunique() == 1


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
