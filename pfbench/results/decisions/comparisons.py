"""Comparisons of one metric of one pair of filters, for both questions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.decisions.decision import Scale
from pfbench.results.decisions.options import DecisionOptions, MetricRule
from pfbench.results.decisions.pair_effects import (
    PairEffects,
    location_effects,
    share_effects,
)
from pfbench.results.decisions.study_runs import PairRuns
from pfbench.results.error_measures import Array
from pfbench.results.statistics.paired_effects import (
    TRIM_SHARE,
    ConditionEffects,
    log_levels,
    order_failed_runs,
    paired_log_ratio,
    subtract_levels,
    trimmed_effects,
)

TRACK = "keeps track"


class PairComparison(NamedTuple):
    """One metric of one pair before the test of its family.

    Attributes:
        pair: Runs of both filters.
        metric: Name of the metric.
        group: Group of the state.
        scale: Scale of the effect.
        margin: Margin of equivalence in the unit of the effect.
        effects: Effects for both questions.
        both_keep: Effect among the runs in which both keep track.
    """

    pair: PairRuns
    metric: str
    group: str
    scale: Scale
    margin: float
    effects: PairEffects
    both_keep: float


def paired_differences(pair: PairRuns, rule: MetricRule) -> Array:
    """Compute the differences of a metric, [W, C, N]; NaN for an absent run.

    Args:
        pair: Runs of both filters.
        rule: Rule of the metric.

    Returns:
        Differences, negative where the first filter is better; infinite where only one of two
        trimmed values is of a run that keeps track.
    """
    sign = -1.0 if rule.higher_is_better else 1.0
    succeeds = (pair.keeps_a, pair.keeps_b)
    if rule.scale == "log ratio":
        ratio = paired_log_ratio(pair.value_a, pair.value_b, *succeeds)
        failed = ~(pair.keeps_a & pair.keeps_b)
        d = np.where(failed, ratio, sign * ratio)
    else:
        with np.errstate(invalid="ignore"):
            d = sign * (pair.value_a - pair.value_b)
        d = np.where(pair.value_a == pair.value_b, 0.0, d)
        d = order_failed_runs(d, *succeeds) if rule.scale == "difference" else d
    return np.where(pair.present, d, np.nan)


def compare_metric(pair: PairRuns, rule: MetricRule, options: DecisionOptions) -> PairComparison:
    """Compare a metric of a pair.

    Args:
        pair: Runs of both filters.
        rule: Rule of the metric.
        options: Options.

    Returns:
        PairComparison for both questions.
    """
    d, shared = paired_differences(pair, rule), options.shared_runs
    margin = rule.margin if rule.margin is not None else options.log_margin
    if rule.scale == "share":
        effects = share_effects(d, pair.weights, shared, _key(pair, rule.name))
        return PairComparison(pair, rule.name, rule.group, "share", margin, effects, np.nan)
    trim = 0.0 if rule.scale == "mean difference" else TRIM_SHARE
    is_ratio = rule.scale == "log ratio"
    by_levels = is_ratio and options.estimate == "levels"
    levels = _subtract_pair_levels(pair, rule) if by_levels else None
    effects = location_effects(d, pair.weights, trim, shared, levels)
    scale: Scale = "log ratio" if is_ratio else "difference"
    scale = "runs won" if effects.by_runs_won else scale
    both_kept = np.where(pair.keeps_a & pair.keeps_b, d, np.nan)
    both = _mean_location(both_kept, pair.weights, trim)
    return PairComparison(pair, rule.name, rule.group, scale, margin, effects, both)


def compare_track(pair: PairRuns, group: str, options: DecisionOptions) -> PairComparison:
    """Compare the shares of runs that keep track.

    Args:
        pair: Runs of both filters.
        group: Group of the state.
        options: Options.

    Returns:
        PairComparison for both questions.
    """
    d = np.where(pair.present, pair.keeps_b.astype(float) - pair.keeps_a, np.nan)
    effects = share_effects(d, pair.weights, options.shared_runs, _key(pair, TRACK))
    return PairComparison(pair, TRACK, group, "share", options.track_margin, effects, np.nan)


def _subtract_pair_levels(pair: PairRuns, rule: MetricRule) -> ConditionEffects:
    """Subtract the levels of the second filter from those of the first, by condition."""
    first, second = (pair.value_a, pair.value_b)
    if rule.higher_is_better:
        first, second = 1 / first, 1 / second
    return subtract_levels(
        log_levels(first, pair.keeps_a, pair.present),
        log_levels(second, pair.keeps_b, pair.present),
    )


def _mean_location(d: Array, weights: Array, trim: float) -> float:
    """Average the locations of the conditions that have runs; NaN without one."""
    location = trimmed_effects(d, trim).location
    used = np.where(np.isfinite(location), weights, 0.0)
    total = used.sum()
    return (
        float((used * np.nan_to_num(location, posinf=0.0, neginf=0.0)).sum() / total)
        if total
        else np.nan
    )


def _key(pair: PairRuns, metric: str) -> str:
    return f"{pair.a} {pair.b} {metric}"
