"""Tests of single claims: samples, regions, p-values and intervals, before Holm's correction.

A test claims that the median over runs of a value lies in a region. The value is the logarithm of a
ratio to another filter in the same episodes or to a number, a difference, or a share. One-sided
signed-rank tests (exact binomial for shares) show that the median lies in the region. The test
fails if sign tests, which the order-statistic interval inverts, exclude every effect that is large
enough: half of the printed effect on the logarithmic scale, or the margin. Both p-values are
corrected by Holm's method over the tests of the paper. Otherwise the runs are too few.

Lost runs rank last. If neither filter has half of its runs, the test is undecided. Times per step
are one measurement per job: only differences above 10 % count, without an interval [ours].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import stats

from pfbench.claims.claim_samples import (
    EFFECT_FACTOR,
    ClaimSample,
    exclusion_p_value,
    region_p_value,
    sample_claim_test,
)
from pfbench.claims.schema import LOST, NO_POWER, NOT_RUN, ClaimTest
from pfbench.results.decisions.words import FAILS, HOLDS
from pfbench.results.error_measures import Array
from pfbench.results.statistics.intervals import order_statistic_interval

NOT_DECIDED = "open"
_TIMING_FACTOR = 1.1  # between two timings


@dataclass(frozen=True)
class ClaimTestResult:
    """Decision on one test of a claim.

    Attributes:
        comparison: Test.
        outcome: "holds", "fails" or "open".
        reason: Reason of an open outcome, or what contradicts a claim that fails; may be empty.
        pairs: Runs included; 0 if nothing ran.
        lost_a: Lost runs of a.
        lost_b: Lost runs of b.
        unit: Unit of a level or a difference; empty for ratios and shares.
        effect: Median over runs of the ratio a / b, the difference, the level or the share.
        low: Lower end of its interval, infinite without one.
        high: Upper end of that interval.
        p: One-sided p-value of this test alone; NaN if nothing is tested.
        p_holm: p-value corrected over `family` tests of the paper.
        p_fails: Two-sided p-value that every sufficient effect is excluded; NaN if nothing is tested.
        p_fails_holm: That p-value, corrected over the tests of the paper.
        family: Number of these tests.
        within: Distance of the median from the border inside the claimed region, in SD over valid
            runs. Negative outside, NaN if lost runs decide the median.
        outside: Distance of the median outside the region of sufficient effects, in the same unit.
        needed: Runs per condition that decide the measured effect with power 0.8, if the runs were
            too few. Infinite if no number does, else NaN.
    """

    comparison: ClaimTest
    outcome: str
    reason: str = ""
    pairs: int = 0
    lost_a: int = 0
    lost_b: int = 0
    unit: str = ""
    effect: float = np.nan
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    p_holm: float = np.nan
    p_fails: float = np.nan
    p_fails_holm: float = np.nan
    family: int = 0
    within: float = np.nan
    outside: float = np.nan
    needed: float = np.nan


def run_claim_test(
    test: ClaimTest, series: Mapping[tuple[str, ...], pd.DataFrame], alpha: float
) -> ClaimTestResult:
    """Decide a test before Holm's correction.

    Args:
        test: Test.
        series: Rows of `load_claim_measurements` by study, cell, label and measure.
        alpha: Probability outside the interval.

    Returns:
        The decision; "open" if it needs Holm's correction.
    """
    tables = [series.get((*side, test.measure)) for side in test.sides]
    rows = [table.set_index(["seed", "run"]).sort_index() for table in tables if table is not None]
    if len(rows) < len(tables):
        return ClaimTestResult(test, NOT_DECIDED, NOT_RUN)
    columns = [table.value for table in rows]
    values = pd.concat(columns, axis=1, join="inner").dropna().to_numpy(dtype=np.float64)
    runs = min(len(table) for table in rows)
    lost_a, lost_b, *_ = [int(table.lost.sum()) for table in rows] + [0]
    has_unit = (len(rows) == 1 or test.statistic == "close") and runs
    unit = str(rows[0].unit.iloc[0]) if has_unit else ""
    result = ClaimTestResult(test, NOT_DECIDED, "", len(values), lost_a, lost_b, unit)
    # An infinite value is an answer if the test asks whether it stays below a limit.
    counts_lost = test.metric in ("settled", "severely_overconfident")
    counts_lost |= test.statistic == "below"
    finite = len(values) if counts_lost else int(np.isfinite(values).any(axis=1).sum())
    if finite < (runs + 1) // 2:
        return replace(result, reason=LOST if lost_a + lost_b else NOT_RUN)
    if test.statistic == "cost":
        return _test_cost(result, values)
    if test.statistic == "share":
        return _test_share(result, values[:, 0], alpha)
    b = values[:, 1] if values.shape[1] > 1 else None
    return _test_median(result, sample_claim_test(test, values[:, 0], b), alpha)


def check_effect_size(result: ClaimTestResult) -> ClaimTestResult:
    """Fail a result whose effect is not within a factor of the printed one, on a log scale."""
    printed = result.comparison.printed
    if result.outcome != HOLDS or np.isnan(printed) or result.comparison.statistic == "near":
        return result
    with np.errstate(divide="ignore"):
        share = float(np.log(result.effect) / np.log(printed))
    if 1 / EFFECT_FACTOR <= share <= EFFECT_FACTOR:
        return result
    reason = f"the direction holds, the effect is {share:.2g} of the printed effect"
    return replace(result, outcome=FAILS, reason=reason)


def _test_median(result: ClaimTestResult, s: ClaimSample, alpha: float) -> ClaimTestResult:
    """Decide a test about a median, as far as its interval decides it."""
    interval = order_statistic_interval(s.d, 1 - alpha)
    low, high = interval.low, interval.high
    # A level near a printed number is tested as a ratio and shown as a level.
    is_near = result.comparison.statistic == "near"
    scale = result.comparison.printed if is_near else 1.0
    values = (float(np.median(s.d)), low, high)
    effect, shown_low, shown_high = (scale * _display(value, s) for value in values)
    result = replace(result, effect=effect, low=shown_low, high=shown_high)
    if result.comparison.statistic == "report":
        return result
    inside, outside = _measure_depth(s)
    result = replace(result, p=region_p_value(s), p_fails=exclusion_p_value(s))
    return replace(result, within=inside, outside=outside, reason=NO_POWER)


def _measure_depth(s: ClaimSample) -> tuple[float, float]:
    """Compute `within` and `outside` of a result."""
    valid, median = s.d[np.abs(s.d) <= s.largest], float(np.median(s.d))
    if valid.size < 2 or abs(median) > s.largest:
        return np.nan, np.nan
    inside = min(s.high - median, median - s.low)
    outside = max(median - s.high, s.low - median) + s.worth
    with np.errstate(divide="ignore", invalid="ignore"):  # equal runs: infinite
        depths = np.array([inside, outside]) / valid.std(ddof=1)
    return float(depths[0]), float(depths[1])


def _test_share(result: ClaimTestResult, hits: Array, alpha: float) -> ClaimTestResult:
    """Test whether the share of runs with metric 1 exceeds a limit."""
    count, limit = int(hits.sum()), result.comparison.low
    p = stats.binomtest(count, hits.size, limit, alternative="greater").pvalue
    interval = stats.binomtest(count, hits.size, limit).proportion_ci(1 - alpha, method="exact")
    result = replace(
        result,
        effect=count / hits.size,
        low=float(interval.low),
        high=float(interval.high),
        p=float(p),
    )
    p_fails = min(1.0, 2 * float(stats.binom.cdf(count, hits.size, limit)))
    return replace(result, reason=NO_POWER, p_fails=p_fails)


def _test_cost(result: ClaimTestResult, seconds: Array) -> ClaimTestResult:
    """Compare two times per step, or one time with limits; each was measured once."""
    test = result.comparison
    ratio = float(seconds[0, 0] / (seconds[0, 1] if seconds.shape[1] > 1 else 1.0))
    result = replace(result, effect=ratio, low=-np.inf, high=np.inf)
    if np.isfinite(test.printed):
        is_same_side = (ratio > 1) == (test.printed > 1)
        return check_effect_size(replace(result, outcome=HOLDS if is_same_side else FAILS))
    if test.low * _TIMING_FACTOR <= ratio <= test.high / _TIMING_FACTOR:
        return replace(result, outcome=HOLDS)
    is_outside = ratio < test.low / _TIMING_FACTOR or ratio > test.high * _TIMING_FACTOR
    return replace(result, outcome=FAILS) if is_outside else replace(result, reason=NO_POWER)


def _display(value: float, s: ClaimSample) -> float:
    """Invert the logarithm; values beyond every valid number represent lost runs."""
    if np.isinf(value) or abs(value) > s.largest:
        return 0.0 if s.logs and value < 0 else float(np.sign(value) * np.inf)
    return float(np.exp(value)) if s.logs else value
