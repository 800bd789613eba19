"""Pairwise tests of filters within one condition: one `PairwiseTest` per pair.

Filters of a condition share the same episodes, so they are compared run by run (same seed and run)
on the log ratio of their RMSE. The test is Wilcoxon's signed-rank test with ranks of zeros split
evenly [Demsar 2006], with Holm's correction over all pairs of one group of one condition [Holm
1979]. Effect sizes are the rank-biserial correlation and the probability of improvement. The median
ratio has a bootstrap interval, and two one-sided tests show equivalence.

A lost run takes the largest rank. Two lost runs are a tie, and so are two runs whose RMSE agree to
the stored precision [ours].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest, decide_winner
from pfbench.results.comparison.run_errors import (
    ConditionKey,
    PairErrors,
    pair_errors,
    rmse_by_run,
)
from pfbench.results.error_measures import Array
from pfbench.results.statistics import power
from pfbench.results.statistics.effect_sizes import (
    log_ratio,
    probability_of_improvement,
    rank_biserial,
    rank_biserial_proportion,
)
from pfbench.results.statistics.intervals import (
    ConfidenceInterval,
    bootstrap_median_interval,
    proportion_interval,
)
from pfbench.results.statistics.signed_rank import equivalence_samples, holm, wilcoxon_samples


def compare_pairs(
    table: pd.DataFrame, alpha: float = 0.05, margin: float = 0.05, target_effect: float = 0.1
) -> list[PairwiseTest]:
    """Compare all pairs of filters of each condition and group.

    Args:
        table: Rows of `load_frame`; those of metric "rmse" and component "norm" are used.
        alpha: Level after Holm's correction.
        margin: Relative margin of equivalence.
        target_effect: Relative difference for which the required runs are computed.

    Returns:
        Tests in the order of the table. Pairs without a common run are left out.
    """
    tests: list[PairwiseTest] = []
    for condition, wide in rmse_by_run(table):
        family = _compare(condition, list(pair_errors(wide)), alpha, margin, target_effect)
        tests += correct_family(family, alpha)
    return tests


def correct_family(family: Sequence[PairwiseTest], alpha: float) -> list[PairwiseTest]:
    """Apply Holm's correction to the tests of one family and decide them.

    Args:
        family: Tests of one group of one condition.
        alpha: Level after correction.

    Returns:
        The tests with corrected p-values, winners, equivalence and required runs.
    """
    if not family:
        return []
    p_holm, p_raw = holm([v.p for v in family]), [v.p_equivalent for v in family]
    # A family is tested for equivalence as a whole: without one p-value, no pair has one.
    p_equal = holm(p_raw) if np.isfinite(p_raw).all() else np.full(len(family), np.nan)
    sizes = [_sample_sizes(v, alpha / len(family)) for v in family]
    return [
        replace(
            v,
            p_holm=float(p),
            family=len(family),
            winner=decide_winner(v.a, v.b, v.effect, float(p), alpha),
            p_equivalent=float(equal),
            equivalent=bool(equal <= alpha),
            needed=runs,
            detectable=effect,
        )
        for v, p, equal, (runs, effect) in zip(family, p_holm, p_equal, sizes, strict=True)
    ]


def correct_over_report(tests: Sequence[PairwiseTest]) -> list[PairwiseTest]:
    """Add p-values with Holm's correction over all tests; winners do not change."""
    adjusted = holm([v.p for v in tests])
    return [
        replace(v, p_page=float(p), page=len(tests)) for v, p in zip(tests, adjusted, strict=True)
    ]


def _compare(
    condition: ConditionKey,
    pairs: list[PairErrors],
    alpha: float,
    margin: float,
    target_effect: float,
) -> list[PairwiseTest]:
    """Test all pairs of a condition before Holm's correction."""
    differences = [log_ratio(*errors.T) for _, errors in pairs]
    statistic, p = wilcoxon_samples(differences)
    p_equivalent = equivalence_samples(differences, float(np.log1p(margin)))
    return [
        _describe(
            condition,
            labels,
            errors,
            d,
            1 - alpha,
            statistic=float(statistic[k]),
            p=float(p[k]),
            p_holm=float(p[k]),
            margin=margin,
            p_equivalent=float(p_equivalent[k]),
            target_effect=target_effect,
        )
        for k, ((labels, errors), d) in enumerate(zip(pairs, differences, strict=True))
    ]


def _describe(
    condition: ConditionKey,
    labels: tuple[str, str],
    errors: Array,
    d: Array,
    level: float,
    **p_values: Any,
) -> PairwiseTest:
    """Add effect sizes and intervals of a pair to its p-values."""
    a, b = errors.T
    finite = np.isfinite(errors).all(axis=1) & (errors > 0).all(axis=1)
    largest = np.abs(d[finite]).max(initial=0.0)
    # One run gives a median without an interval.
    none = ConfidenceInterval(-np.inf, np.inf, "none")
    interval = bootstrap_median_interval(d, level) if d.size > 1 else none
    median = float(np.median(d))
    ratio, low, high = (_to_ratio(v, largest) for v in (median, interval.low, interval.high))
    size = rank_biserial_proportion(d)
    better = probability_of_improvement(a, b)
    size_in, better_in = (
        proportion_interval(s.value, s.variance, d.size, level) for s in (size, better)
    )
    return PairwiseTest(
        *condition,
        metric="rmse",
        a=labels[0],
        b=labels[1],
        pairs=len(errors),
        lost_a=int(np.isinf(a).sum()),
        lost_b=int(np.isinf(b).sum()),
        family=1,
        effect=rank_biserial(d),
        ratio=ratio,
        low=low,
        high=high,
        level=level,
        interval=interval.method,
        winner=INCONCLUSIVE,
        effect_low=2 * size_in.low - 1,
        effect_high=2 * size_in.high - 1,
        better=better.value,
        better_low=better_in.low,
        better_high=better_in.high,
        scatter=float(np.std(d[finite], ddof=1)) if finite.sum() > 1 else np.nan,
        **p_values,
    )


def _sample_sizes(v: PairwiseTest, alpha: float) -> tuple[float, float]:
    """Compute the runs required for `target_effect` and the smallest detectable relative difference."""
    if not np.isfinite(v.scatter) or not np.isfinite(v.target_effect):
        return np.nan, np.nan
    if v.scatter == 0:
        least = power.min_pairs(alpha)
        return float(least), 0.0 if v.pairs >= least else np.inf
    runs = power.required_runs(float(np.log1p(v.target_effect)) / v.scatter, alpha)
    return runs, float(np.expm1(power.detectable_effect(v.scatter, v.pairs, alpha)))


def _to_ratio(log: float, largest: float) -> float:
    """Invert the logarithm; values beyond every finite difference represent lost runs."""
    if abs(log) > largest * (1 + 1e-12):
        return np.inf if log > 0 else 0.0
    return float(np.exp(log))
