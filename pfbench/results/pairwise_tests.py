"""Pairwise tests of filters within one condition: one `PairwiseTest` per pair.

Filters of a condition share the same episodes, so they are compared run by run (same seed and run)
on the log ratio of their RMSE: Wilcoxon's signed-rank test with ranks of zeros split evenly
[Demsar 2006], Holm's correction over all pairs of one group of one condition [Holm 1979], the
rank-biserial correlation and the probability of improvement as effect sizes, a bootstrap interval
of the median ratio, and two one-sided tests of equivalence.

A lost run takes the largest rank. Two lost runs are a tie, and so are two runs whose RMSE agree to
the stored precision [ours]. `lost_rule_sensitivity` repeats the decisions with other rules.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results import power, statistics
from pfbench.results.error_measures import Array
from pfbench.results.intervals import (
    ConfidenceInterval,
    bootstrap_median_interval,
    proportion_interval,
)
from pfbench.results.statistics import ProportionEstimate, holm, log_ratio, rank_biserial

INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class PairwiseTest:
    """Comparison of filter a with filter b on one group of one condition.

    Attributes:
        scenario: Scenario of the condition.
        noise: Noise regime of the condition.
        model: Model of the condition.
        group: Group of the state.
        metric: Metric compared; rmse is the RMSE of the norm of the group, per run.
        a: Label of the first filter.
        b: Label of the second filter.
        pairs: Runs that both filters have.
        lost_a: Lost runs of a among them.
        lost_b: Lost runs of b among them.
        statistic: Wilcoxon's T, the smaller of the two rank sums.
        p: Two-sided p-value of this pair alone.
        p_holm: p-value corrected over `family` pairs.
        family: Pairs in Holm's correction.
        effect: Rank-biserial correlation, -1 to 1; positive if a has the smaller error.
        ratio: Median over runs of RMSE(a) / RMSE(b); 0 or infinite if lost runs decide it.
        low: Lower end of the bootstrap interval of the ratio.
        high: Upper end of that interval.
        level: Coverage of that interval.
        interval: Method of that interval: "BCa", "percentile" or "none".
        winner: Better filter, or "inconclusive".
        effect_low: Lower end of the interval of the effect.
        effect_high: Upper end of that interval.
        better: Probability that a run of a has a smaller error than a run of b; ties count half.
        better_low: Lower end of the interval of that probability.
        better_high: Upper end of that interval.
        margin: Relative difference of RMSE within which filters are equivalent.
        p_equivalent: p-value of equivalence within the margin, Holm over `family`.
        equivalent: Whether equivalence is shown.
        wanted: Relative difference of RMSE for which `needed` is computed.
        scatter: SD over runs of the log ratio, over runs that neither filter lost.
        needed: Runs required to show the difference `wanted` with power 0.8.
        detectable: Smallest relative difference that the available pairs show with power 0.8.
        p_page: p-value corrected over all `page` comparisons of a report; NaN without one.
        page: Comparisons of the report.
    """

    scenario: str
    noise: str
    model: str
    group: str
    metric: str
    a: str
    b: str
    pairs: int
    lost_a: int
    lost_b: int
    statistic: float
    p: float
    p_holm: float
    family: int
    effect: float
    ratio: float
    low: float
    high: float
    level: float
    interval: str
    winner: str
    effect_low: float = np.nan
    effect_high: float = np.nan
    better: float = np.nan
    better_low: float = np.nan
    better_high: float = np.nan
    margin: float = np.nan
    p_equivalent: float = np.nan
    equivalent: bool = False
    wanted: float = np.nan
    scatter: float = np.nan
    needed: float = np.nan
    detectable: float = np.nan
    p_page: float = np.nan
    page: int = 0


class LostRunRule(NamedTuple):
    """Rule for lost runs in a comparison.

    Attributes:
        name: Description of the rule.
        apply: Function of the errors of one condition and group, one row per run and one column
            per filter, infinite where lost. NaN removes a run.
    """

    name: str
    apply: Callable[[pd.DataFrame], pd.DataFrame]


@dataclass(frozen=True)
class LostRunSensitivity:
    """Decision that depends on the rule for lost runs.

    Attributes:
        cell: Condition, as scenario / noise / model.
        group: Group of the state.
        a: Label of the first filter.
        b: Label of the second filter.
        winners: Decision by each of `LOST_RUN_RULES`.
    """

    cell: str
    group: str
    a: str
    b: str
    winners: tuple[str, ...]


def _use_largest_error(wide: pd.DataFrame) -> pd.DataFrame:
    """Replace infinite errors by the largest finite one."""
    values = wide.to_numpy(dtype=np.float64)
    finite = values[np.isfinite(values)]
    return wide.replace(np.inf, finite.max()) if finite.size else wide


WORST_RANK = LostRunRule("worst rank", lambda wide: wide)
LEFT_OUT = LostRunRule("pairs with a lost run left out", lambda wide: wide.replace(np.inf, np.nan))
LARGEST_ERROR = LostRunRule("largest finite error of the condition", _use_largest_error)
LOST_RUN_RULES = (WORST_RANK, LEFT_OUT, LARGEST_ERROR)
ConditionKey = tuple[str, str, str, str]
_PairErrors = tuple[tuple[str, str], Array]


def compare_pairs(
    table: pd.DataFrame, alpha: float = 0.05, margin: float = 0.05, target_effect: float = 0.1
) -> list[PairwiseTest]:
    """Compare all pairs of filters of each condition and group.

    Args:
        table: Rows of `load_frame`; those of metric "rmse" and component "norm" are used.
        alpha: Level after Holm's correction.
        margin: Relative margin of equivalence.
        wanted: Relative difference for which the required runs are computed.

    Returns:
        Tests in the order of the table. Pairs without a common run are left out.
    """
    tests: list[PairwiseTest] = []
    for condition, wide in rmse_by_run(table):
        family = _compare(condition, list(_pair_errors(wide)), alpha, margin, target_effect)
        tests += correct_family(family, alpha)
    return tests


def rmse_by_run(
    table: pd.DataFrame, rule: LostRunRule = WORST_RANK
) -> Iterator[tuple[ConditionKey, pd.DataFrame]]:
    """Yield the RMSE of each condition and group, one row per run and one column per filter.

    Args:
        table: Rows of `load_frame`.
        rule: Rule for lost runs; infinite errors without one.

    Yields:
        Scenario, noise, model and group, and errors indexed by seed and run.
    """
    rows = table[(table.metric == "rmse") & (table.component == "norm")]
    keys = ["scenario", "noise", "model", "group"]
    for (scenario, noise, model, group), part in rows.groupby(keys, sort=False):
        wide = part.pivot(index=["seed", "run"], columns="label", values="value").sort_index()
        condition = str(scenario), str(noise), str(model), str(group)
        yield condition, rule.apply(wide[part.label.unique()])


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
            winner=_decide(v.a, v.b, v.effect, float(p), alpha),
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


def lost_rule_sensitivity(table: pd.DataFrame, alpha: float = 0.05) -> list[LostRunSensitivity]:
    """List the comparisons whose winner changes with the rule for lost runs.

    Args:
        table: Rows of `load_frame`.
        alpha: Level after Holm's correction.

    Returns:
        One entry per comparison that changes.
    """
    rows = (table.metric == "rmse") & (table.component == "norm")
    if not np.isinf(table.value[rows]).any():
        return []
    cache: dict[bytes, tuple[float, float]] = {}  # pairs without a lost run are equal by each rule
    by_rule = [_winners(table, alpha, rule, cache) for rule in LOST_RUN_RULES]
    changed = []
    for (scenario, noise, model, group, a, b), worst in by_rule[0].items():
        key = (scenario, noise, model, group, a, b)
        winners = (worst, *(others.get(key, "no pair left") for others in by_rule[1:]))
        if len(set(winners)) > 1:
            condition = f"{scenario} / {noise} / {model}"
            changed.append(LostRunSensitivity(condition, group, a, b, winners))
    return changed


def _winners(
    table: pd.DataFrame, alpha: float, rule: LostRunRule, cache: dict[bytes, tuple[float, float]]
) -> dict[tuple[str, ...], str]:
    """Decide all pairs by a rule for lost runs."""
    winners: dict[tuple[str, ...], str] = {}
    for condition, wide in rmse_by_run(table, rule):
        pairs = list(_pair_errors(wide))
        fresh = [errors for _, errors in pairs if errors.tobytes() not in cache]
        differences = [log_ratio(*errors.T) for errors in fresh]
        for errors, d, p in zip(fresh, differences, _wilcoxon(differences)[1], strict=True):
            cache[errors.tobytes()] = float(p), rank_biserial(d)
        tested = [cache[errors.tobytes()] for _, errors in pairs]
        for (labels, _), (_, effect), p in zip(
            pairs, tested, holm([p for p, _ in tested]), strict=True
        ):
            winners[(*condition, *labels)] = _decide(*labels, effect, float(p), alpha)
    return winners


def _pair_errors(wide: pd.DataFrame) -> Iterator[_PairErrors]:
    """Yield labels and errors [n, 2] of each pair with a common run."""
    values = wide.to_numpy(dtype=np.float64)  # slicing frames takes longer than the tests
    for (i, a), (j, b) in combinations(enumerate(map(str, wide.columns)), 2):
        errors = values[:, [i, j]]
        errors = errors[~np.isnan(errors).any(axis=1)]
        if len(errors):
            yield (a, b), errors


def _wilcoxon(differences: Sequence[Array]) -> tuple[Array, Array]:
    """Test differences of several pairs, all of one length at once; see `_by_length`."""
    statistic, p = np.empty((2, len(differences)))
    for index, d in _by_length(differences):
        statistic[index], p[index] = statistics.wilcoxon_signed_rank_rows(d)
    return statistic, p


def _equivalence(differences: Sequence[Array], margin: float) -> Array:
    """Test the equivalence of several pairs, all of one length at once."""
    p = np.empty(len(differences))
    for index, d in _by_length(differences):
        p[index] = statistics.equivalence_p_values(d, margin)
    return p


def _by_length(differences: Sequence[Array]) -> Iterator[tuple[list[int], Array]]:
    """Stack differences of the same length; yields their indices and rows [K, n]."""
    for n in sorted({d.size for d in differences}):
        index = [k for k, d in enumerate(differences) if d.size == n]
        yield index, np.stack([differences[k] for k in index])


def _compare(
    condition: ConditionKey, pairs: list[_PairErrors], alpha: float, margin: float, wanted: float
) -> list[PairwiseTest]:
    """Test all pairs of a condition before Holm's correction."""
    differences = [log_ratio(*errors.T) for _, errors in pairs]
    statistic, p = _wilcoxon(differences)
    p_equivalent = _equivalence(differences, float(np.log1p(margin)))
    tests = []
    for k, ((labels, errors), d) in enumerate(zip(pairs, differences, strict=True)):
        test = _describe(condition, labels, errors, d, 1 - alpha)
        tests.append(
            replace(
                test,
                statistic=float(statistic[k]),
                p=float(p[k]),
                p_holm=float(p[k]),
                margin=margin,
                p_equivalent=float(p_equivalent[k]),
                wanted=wanted,
            )
        )
    return tests


def _describe(
    condition: ConditionKey, labels: tuple[str, str], errors: Array, d: Array, level: float
) -> PairwiseTest:
    """Compute effect sizes and intervals of a pair."""
    a, b = errors.T
    finite = np.isfinite(errors).all(axis=1) & (errors > 0).all(axis=1)
    largest = np.abs(d[finite]).max(initial=0.0)
    # One run has no interval, only a median.
    none = ConfidenceInterval(-np.inf, np.inf, "none")
    interval = bootstrap_median_interval(d, level) if d.size > 1 else none
    median = float(np.median(d))
    ratio, low, high = (_to_ratio(v, largest) for v in (median, interval.low, interval.high))
    size = statistics.rank_biserial_proportion(d)
    better = statistics.probability_of_improvement(a, b)
    size_in, better_in = (
        proportion_interval(s.value, _variance(s), d.size, level) for s in (size, better)
    )
    return PairwiseTest(
        *condition,
        metric="rmse",
        a=labels[0],
        b=labels[1],
        pairs=len(errors),
        lost_a=int(np.isinf(a).sum()),
        lost_b=int(np.isinf(b).sum()),
        statistic=np.nan,
        p=np.nan,
        p_holm=np.nan,
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
    )


def _decide(a: str, b: str, effect: float, p: float, alpha: float) -> str:
    """Return the better filter, or "inconclusive"."""
    if not p <= alpha or effect == 0:
        return INCONCLUSIVE
    return a if effect > 0 else b


def _sample_sizes(v: PairwiseTest, alpha: float) -> tuple[float, float]:
    """Compute the runs required for `wanted` and the smallest detectable relative difference."""
    if not np.isfinite(v.scatter) or not np.isfinite(v.wanted):
        return np.nan, np.nan
    if v.scatter == 0:
        least = power.min_pairs(alpha)
        return float(least), 0.0 if v.pairs >= least else np.inf
    runs = power.required_runs(float(np.log1p(v.wanted)) / v.scatter, alpha)
    return runs, float(np.expm1(power.detectable_effect(v.scatter, v.pairs, alpha)))


def _variance(estimate: ProportionEstimate) -> float:
    """Compute the variance of a proportion over runs; NaN of one run."""
    parts = estimate.parts
    return float(np.var(parts, ddof=1)) / parts.size if parts.size > 1 else np.nan


def _to_ratio(log: float, largest: float) -> float:
    """Invert the logarithm; values beyond every finite difference represent lost runs."""
    if abs(log) > largest * (1 + 1e-12):
        return np.inf if log > 0 else 0.0
    return float(np.exp(log))
