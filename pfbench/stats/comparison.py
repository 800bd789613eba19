"""Comparison of two filters: the effect on paired losses, and the verdicts on a family of effects.

All pages decide here. The loss of a run is the logarithm of its error, infinite for a lost run: it is worse than every
kept one, and two lost runs tie. Ranks, signs and means of pairs need no number for it, so no error is replaced.

A verdict needs three tests that agree: Wilcoxon's signed-rank test, whose estimate is that of Hodges and Lehmann and
whose interval is printed, the t test of the trimmed mean, and the sign test. Each holds the error rate of the family by
Holm's correction. With skewed differences the first two reject although each filter has the smaller error in half of the
runs; the sign test does not. It is of one side, that of the ratio. Lost runs have a word of
their own, by McNemar's exact test.

References:
    F. Wilcoxon (1945), Individual comparisons by ranking methods.
    Q. McNemar (1947), Note on the sampling error of the difference between correlated proportions.
    J. L. Hodges and E. L. Lehmann (1963), Estimates of location based on rank tests.
    C. J. Clopper and E. S. Pearson (1934), The use of confidence or fiducial limits in the case of the binomial.
    S. Holm (1979), A simple sequentially rejective multiple test procedure.
    O. Guilbaud (2008), Simultaneous confidence regions corresponding to Holm's step-down procedure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import scipy  # scipy.special is imported at its first use, which takes a tenth of the start of a job

from pfbench.core.parameter_checks import require
from pfbench.stats.error_measures import Array
from pfbench.stats.rank_tests import (
    EXACT_DIFFERENCES,
    Alternative,
    holm,
    rank_sum_cdf,
    wilcoxon_signed_rank_rows,
)

Unit = Literal["run", "block", "drive", "world"]
Word = Literal["better", "worse", "equal", "equal in kept runs", "identical", "not decided"]
LossWord = Literal["loses more", "loses fewer", ""]
BETTER_THAN: Final = "better"
WORSE_THAN: Final = "worse"
EQUAL_WORD: Final = "equal"
EQUAL_KEPT: Final = "equal in kept runs"
EQUAL_WORDS: Final = (EQUAL_WORD, EQUAL_KEPT, "identical")
LOSES_MORE: Final = "loses more"
LOSES_FEWER: Final = "loses fewer"
SAME_RUNS: Final = "identical"
NO_DECISION: Final = "not decided"
EQUALITY_MARGIN = math.log(1.05)  # log ratios within it are equal [ours]
ALPHA = 0.05
MIN_RUNS = 10  #: units that a decision requires [ours]
TRIM_SHARE = 0.2  # removed at each end; the middle 60 % of the units remain
MOST_LOST = 0.2  # of the pairs may have a lost run; above it no ratio is given [ours]
TRACK_BOUND = (
    0.1  # of the runs that a filter may lose alone and be called equal, as an upper bound [ours]
)
# Errors are stored in single precision: smaller differences of a logarithm are rounding. Without
# the tolerance, EKF and UKF of a linear model would differ by how they round.
LOG_TOLERANCE = 1e-6
_ROUNDING = 1e-12  # relative spread of equal values
_FEW_DIFFERENCES = 200  # up to which the means of all pairs are formed
_HALVINGS = 52  # of the range of the differences: the precision of a double
_LEAST_SUM = 1e-300  # of errors relative to the largest one
FAR = 1e4  # replaces an infinite log ratio in means of pairs; all finite ones are below 1500


class LostRuns(NamedTuple):
    """Runs of a pair that one or both filters lost.

    Attributes:
        a: Number of runs that the first filter lost alone.
        b: Number of runs that the second filter lost alone.
        both: Number of runs that both lost.
        word: Whether it is shown that the first filter loses more runs, or fewer; empty for neither.
    """

    a: int = 0
    b: int = 0
    both: int = 0
    word: LossWord = ""


class Evidence(NamedTuple):
    """Evidence of a verdict besides its p-value.

    Attributes:
        smaller: Share of the runs in which the first filter has the smaller error.
        larger: Share of the runs in which it has the larger one.
        p_trimmed: p-value of the trimmed mean with Holm's correction.
        p_sign: p-value of the sign test on the side of the ratio with Holm's correction.
        p_lost: p-value of McNemar's test with Holm's correction.
        pairs: Number of pairs of the family.
    """

    smaller: float = math.nan
    larger: float = math.nan
    p_trimmed: float = math.nan
    p_sign: float = math.nan
    p_lost: float = math.nan
    pairs: int = 0


class Effect(NamedTuple):
    """Effect of the first filter of a pair against the second.

    Attributes:
        a: Name of the first filter.
        b: Name of the second filter.
        unit: What was drawn independently: a run, a block of time, a drive or a world.
        differences: Log ratios of their losses, [n]; negative where the first filter is better, infinite where one is
            lost, 0 where both are.
        p: p-value of the signed-rank test, two-sided; 1 without a difference.
        p_trimmed: p-value of the trimmed mean.
        p_sign: p-value of the sign test, of the side on which the log ratio is.
        lost: Runs that are lost.
        mean: Log ratio of the mean errors over the runs that both keep; NaN without one.
    """

    a: str
    b: str
    unit: Unit
    differences: Array
    p: float
    p_trimmed: float
    p_sign: float
    lost: LostRuns = LostRuns()
    mean: float = math.nan

    @property
    def location(self) -> float:
        """Log ratio by Hodges and Lehmann: the median of all means of two differences."""
        return self.estimate(ALPHA)[0]

    @property
    def is_smaller(self) -> bool:
        """Return whether the log ratio is negative, by counting, which is a tenth of the work of the log ratio."""
        ordered = np.sort(self.differences)
        places = np.arange(len(ordered))
        below = np.searchsorted(ordered, -ordered, side="left") - places
        negative, count = int(np.maximum(below, 0).sum()), len(ordered) * (len(ordered) + 1) // 2
        return self.location < 0 if 2 * negative == count else 2 * negative > count

    @property
    def p_lost(self) -> float:
        """p-value of McNemar's exact test: whether one filter loses more runs than the other."""
        return float(_sign_p(self.lost.a, self.lost.b))

    @property
    def has_ratio(self) -> bool:
        """Return whether at most a fifth of the pairs has a lost run."""
        return sum(self.lost[:3]) <= MOST_LOST * len(self.differences)

    def estimate(self, alpha: float) -> tuple[float, float, float]:
        """Return the log ratio, and the ends of its interval that belongs to the signed-rank test."""
        n = len(self.differences)
        k, count = _count_outside(n, alpha), n * (n + 1) // 2
        ranks = [max(k, 1), (count + 1) // 2, count // 2 + 1, count + 1 - max(k, 1)]
        low, *middle, high = _select_means(np.clip(self.differences, -FAR, FAR), ranks)
        value = (middle[0] + middle[1]) / 2
        low, value, high = (
            math.copysign(math.inf, x) if abs(x) > FAR / 4 else x for x in (low, value, high)
        )
        return value, low if k else -math.inf, high if k else math.inf


class Verdict(NamedTuple):
    """Verdict on a pair, with one interval: the simultaneous one of its family.

    Attributes:
        a: Name of the first filter.
        b: Name of the second filter.
        word: better, worse, equal, equal in kept runs, identical or not decided, of the first filter.
        ratio: Error of the first filter divided by that of the second; NaN if more than a fifth of the pairs has a
            lost run.
        low: Lower end of the interval of the ratio.
        high: Upper end; infinite where lost runs or few runs leave it open.
        p: p-value of the signed-rank test with Holm's correction.
        n: Number of runs, blocks or worlds.
        lost: Runs that one or both filters lost.
        evidence: Evidence of the verdict besides `p`.
        reason: Why nothing is decided, or what a reader of the word must know; else empty.
    """

    a: str
    b: str
    word: Word
    ratio: float
    low: float
    high: float
    p: float
    n: int
    lost: LostRuns = LostRuns()
    evidence: Evidence = Evidence()
    reason: str = ""

    def to_row(self) -> dict[str, Any]:
        """Return the values of the verdict as one row of a table."""
        row = {name: getattr(self, name) for name in Verdict._fields[:8]}
        a, b, both, loses = self.lost
        lost = {"loses": loses, "lost_a": a, "lost_b": b, "lost_both": both}
        return {**row, **lost, **self.evidence._asdict(), "reason": self.reason}


def compare(a: tuple[str, Array], b: tuple[str, Array], unit: Unit = "run") -> Effect:
    """Compare the losses of two filters in the same runs, blocks or worlds.

    Args:
        a: Name and losses of the first filter, [n].
        b: Name and losses of the second filter, [n].
        unit: What was drawn independently.

    Raises:
        ValueError: If the losses do not belong to the same units.
    """
    return compare_all([(a, b)], unit)[0]


def compare_all(
    pairs: Sequence[tuple[tuple[str, Array], tuple[str, Array]]], unit: Unit = "run"
) -> list[Effect]:
    """Compare several pairs, those of equal length in one call of the test."""
    places: dict[int, list[int]] = {}
    for k, ((name, first), (name_b, second)) in enumerate(pairs):
        require(
            np.shape(first) == np.shape(second) and np.ndim(first) == 1,
            f"{name} and {name_b}",
            f"have losses of the same {unit}s",
            f"{np.shape(first)} and {np.shape(second)}",
            f"Select common {unit}s.",
        )
        places.setdefault(len(first), []).append(k)
    effects: dict[int, Effect] = {}
    for index in places.values():
        first, second = (np.stack([pairs[k][side][1] for k in index]) for side in (0, 1))
        d = subtract_losses(first, second)
        counts, means = _describe_losses(first, second)
        columns = (d, _signed_rank_p(d), _trimmed_p(d), counts, means)
        for k, row, signed, trimmed, lost, mean in zip(index, *columns, strict=True):
            names = pairs[k][0][0], pairs[k][1][0]
            effects[k] = Effect(*names, unit, row, float(signed), float(trimmed), math.nan, LostRuns(*lost.tolist()), float(mean))  # fmt: skip
        sides = np.array([effects[k].differences.any() and effects[k].is_smaller for k in index])
        p_sign = _side_p(np.where(sides[:, None], d, -d))
        effects |= {k: effects[k]._replace(p_sign=float(p)) for k, p in zip(index, p_sign, strict=True)}  # fmt: skip
    return [effects[k] for k in range(len(pairs))]


def _describe_losses(first: Array, second: Array) -> tuple[Array, Array]:
    """Count the lost runs of pairs, [K, 3], and compare the mean errors of their other runs, [K]. Shapes: losses [K, n]."""
    lost_a, lost_b = np.isposinf(first), np.isposinf(second)
    counts = np.stack([lost_a & ~lost_b, lost_b & ~lost_a, lost_a & lost_b], 1).sum(axis=2)
    errors_left = np.where(lost_a | lost_b, -np.inf, np.stack([first, second]))
    largest = errors_left.max(axis=(0, 2), initial=-np.inf)
    has_kept = np.isfinite(largest)
    sums = np.exp(errors_left - np.where(has_kept, largest, 0.0)[:, None]).sum(axis=2)
    a, b = np.log(np.maximum(sums, _LEAST_SUM))
    return counts, np.where(has_kept, a - b, np.nan)


def decide(
    effects: Sequence[Effect], margin: float = EQUALITY_MARGIN, alpha: float = ALPHA
) -> list[Verdict]:
    """Decide a family of pairs with Holm's correction.

    Args:
        effects: Effects of all pairs of the family.
        margin: Log ratio within which two filters are equal.
        alpha: Error rate of the family.

    Returns:
        A verdict for each effect. "better" and "worse" need the signed-rank test, the trimmed mean and the sign test, each
        after Holm's correction. The word "equal" needs the interval within the margin, and bounds on the
        runs that one filter loses alone.
    """
    return [verdict() for verdict in open_family(effects, margin, alpha)]


def open_family(
    effects: Sequence[Effect], margin: float, alpha: float
) -> list[Callable[[], Verdict]]:
    """Correct the tests of a family. Its verdicts are made when they are called: an interval costs most of a verdict."""
    tested = [
        is_testable(effect) for effect in effects
    ]  # the others cannot be decided, but stay in the family
    corrected = [
        holm([getattr(e, name) if yes else 1.0 for e, yes in zip(effects, tested, strict=True)])
        for name in ("p", "p_trimmed", "p_sign", "p_lost")
    ]
    return [
        partial(
            _decide_one,
            effect,
            float(p),
            Evidence(*_share_signs(effect), float(q), float(s), float(r), len(effects)),
            (alpha / len(effects), margin, alpha),
        )
        for effect, p, q, s, r in zip(effects, *corrected, strict=True)
    ]


def _share_signs(effect: Effect) -> tuple[float, float]:
    """Return the shares of the units in which the first filter is better and worse; NaN without a unit."""
    d, n = effect.differences, len(effect.differences) or math.nan
    return (d < 0).sum() / n, (d > 0).sum() / n


def is_testable(effect: Effect) -> bool:
    """Return whether a pair has enough units, and differences that vary over them."""
    return _varies(effect.differences)


def find_largest_p(pairs: Sequence[tuple[Array, Array]]) -> float:
    """Return the largest one-sided p-value of all three tests: whether a filter is better than all others.

    Each pair has the losses of the filter and of one other in their common runs. The test of the union of the
    hypotheses needs no correction for their number.
    Shapes: losses [n] of a pair.
    """
    some = [subtract_losses(first, second) for first, second in pairs]
    if not some or not all(map(_varies, some)):
        return 1.0
    rows = [np.stack([d for d in some if len(d) == n]) for n in {len(d) for d in some}]
    tests = (_signed_rank_p, _trimmed_p, lambda d, _: _side_p(d))
    return max(float(test(d, "less").max()) for test in tests for d in rows)


def _signed_rank_p(d: Array, alternative: Alternative = "two-sided") -> Array:
    """Return a p-value for each row of differences, [K]; 1 for empty ones. Shapes: d [K, n]."""
    return wilcoxon_signed_rank_rows(d, alternative)[1] if d.shape[1] else np.ones(len(d))


def subtract_losses(first: Array, second: Array) -> Array:
    """Return log ratios of losses [n]; those within the stored precision are 0."""
    with np.errstate(invalid="ignore"):
        d = np.where(np.equal(first, second), 0.0, np.subtract(first, second))
    return np.where(np.abs(d) <= LOG_TOLERANCE, 0.0, d)


def _sign_p(more: Array | int, fewer: Array | int) -> Array:
    """Return the p-value of the exact test that two counts have the same expectation, two-sided; 1 without any."""
    least, total = np.minimum(more, fewer), np.add(more, fewer)
    return np.asarray(np.minimum(1.0, 2 * scipy.special.bdtr(least, total, 0.5)))


def _side_p(d: Array) -> Array:
    """Return the p-value of the sign test against a smaller error in most units, for each row: of one side; 1 without a difference."""
    return np.asarray(scipy.special.bdtr((d > 0).sum(axis=1), (d != 0).sum(axis=1), 0.5))


def _varies(d: Array) -> bool:
    """Return whether there are enough differences, and they are not all equal; lost runs always count."""
    if len(d) < MIN_RUNS:
        return False
    return bool(np.isinf(d[0]) or subtract_losses(d, np.full_like(d, d[0])).any())


def _decide_one(
    effect: Effect, p: float, evidence: Evidence, levels: tuple[float, float, float]
) -> Verdict:
    """Decide one pair: `p` is corrected, and `levels` has those of the interval, of equality and of the tests."""
    n, (level, margin, alpha) = len(effect.differences), levels
    nothing = Verdict(effect.a, effect.b, NO_DECISION, math.nan, 0.0, math.inf, math.nan, n, effect.lost, evidence)  # fmt: skip
    if n == 0:
        return nothing._replace(reason=f"no common {effect.unit}s")
    if effect.lost.both == n:
        return nothing._replace(reason=f"both lose track in all {n} runs")
    if not effect.differences.any():
        return nothing._replace(
            word=SAME_RUNS, ratio=1.0, low=1.0, high=1.0, reason=f"all {effect.unit}s agree"
        )
    location, low, high = effect.estimate(level)
    decided = nothing._replace(lost=effect.lost._replace(word=_word_lost(effect, evidence, alpha)))
    if effect.has_ratio:
        decided = decided._replace(ratio=math.exp(location))
    if not is_testable(effect):
        units = f"{n} {effect.unit}{'' if n == 1 else 's'}"
        few = f"{units}, {MIN_RUNS} are required" if n < MIN_RUNS else "no variation"
        return decided._replace(reason=few)
    if p < alpha:  # the interval that belongs to Holm's test may end at 0
        low, high = (low, min(high, 0.0)) if location < 0 else (max(low, 0.0), high)
    else:
        low, high = min(low, 0.0), max(high, 0.0)
    word, reason = _choose_word(effect, (p, evidence), (location, low, high), (margin, alpha))
    if effect.has_ratio:
        decided = decided._replace(
            low=math.exp(low), high=math.exp(high) if high < 700.0 else math.inf
        )
    else:
        decided = decided._replace(low=math.nan, high=math.nan)
        reason = describe_lost(effect)
    return decided._replace(word=word, p=p, reason=reason)


def _choose_word(
    effect: Effect,
    tests: tuple[float, Evidence],
    ends: tuple[float, float, float],
    levels: tuple[float, float],
) -> tuple[Word, str]:
    """Return the word on the errors of a pair, with the reason of a word that needs one."""
    (p, evidence), (location, low, high), (margin, alpha) = tests, ends, levels
    if -margin < low and high < margin:
        is_kept = not any(effect.lost[:3])
        is_bounded = all(_bound_lost(count, effect) < TRACK_BOUND for count in effect.lost[:2])
        return (EQUAL_WORD if is_kept or is_bounded else EQUAL_KEPT), ""
    if p >= alpha:
        return NO_DECISION, ""
    side = math.copysign(1.0, location)
    if evidence.p_trimmed >= alpha or _trimmed_mean(effect.differences[None])[0] * side <= 0:
        return NO_DECISION, "the trimmed mean does not agree"
    if evidence.p_sign >= alpha:
        return NO_DECISION, "the sign test does not agree"
    is_opposite = effect.unit == "run" and effect.mean * side < 0
    first, second = (effect.a, effect.b) if side < 0 else (effect.b, effect.a)
    reason = f"the mean error of {first} over the kept runs is larger than that of {second}" if is_opposite else ""  # fmt: skip
    return (BETTER_THAN if side < 0 else WORSE_THAN), reason


def _word_lost(effect: Effect, evidence: Evidence, alpha: float) -> LossWord:
    """Return whether a filter is shown to lose more or fewer runs than the other."""
    if evidence.p_lost >= alpha:
        return ""
    return LOSES_MORE if effect.lost.a > effect.lost.b else LOSES_FEWER


def _bound_lost(count: int, effect: Effect) -> float:
    """Return the upper 95 % bound of Clopper and Pearson of a share of lost runs; 0 for other units than runs."""
    n = len(effect.differences)
    return (
        float(scipy.special.betaincinv(count + 1, n - count, 1 - ALPHA))
        if effect.unit == "run"
        else 0.0
    )


def describe_lost(effect: Effect) -> str:
    """Say how many runs each filter of a pair loses."""
    n, (a, b, both, _) = len(effect.differences), effect.lost
    return f"{effect.a} loses {a + both} and {effect.b} {b + both} of {n} runs"


def flip(verdict: Verdict) -> Verdict:
    """Return the verdict on the second filter of a pair against the first."""
    words: dict[str, Word] = {BETTER_THAN: WORSE_THAN, WORSE_THAN: BETTER_THAN}
    losses: dict[str, LossWord] = {LOSES_MORE: LOSES_FEWER, LOSES_FEWER: LOSES_MORE}
    ratio, high, low = (
        1 / x if x > 0 else math.inf * (x == 0) for x in (verdict.ratio, verdict.low, verdict.high)
    )
    a, b, both, loses = verdict.lost
    evidence = verdict.evidence._replace(
        smaller=verdict.evidence.larger, larger=verdict.evidence.smaller
    )
    return verdict._replace(
        a=verdict.b, b=verdict.a, word=words.get(verdict.word, verdict.word), ratio=ratio, low=low, high=high,
        lost=LostRuns(b, a, both, losses.get(loses, "")), evidence=evidence,
    )  # fmt: skip


def _select_means(d: Array, ranks: Sequence[int]) -> list[float]:
    """Return some order statistics, from rank 1, of the means of all pairs of differences [n], each with itself.

    For many differences the means are not formed: the number below a value follows from the sorted differences.
    """
    if len(d) <= _FEW_DIFFERENCES:
        means = np.add.outer(d, d)[np.triu_indices(len(d))] / 2
        means.partition([rank - 1 for rank in ranks])
        return [float(means[rank - 1]) for rank in ranks]
    ordered, places = np.sort(d), np.arange(len(d))
    low, high = (np.full(len(ranks), end) for end in (ordered[0], ordered[-1]))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        below = np.searchsorted(ordered, 2 * middle[:, None] - ordered, side="right") - places
        is_enough = np.maximum(below, 0).sum(axis=1) >= ranks
        low, high = np.where(is_enough, low, middle), np.where(is_enough, middle, high)
    return [float(value) for value in high]


@cache
def _count_outside(n: int, alpha: float) -> int:
    """Return the number of means of pairs up to the end of the interval; 0 if it has none."""
    if n <= EXACT_DIFFERENCES:
        return int(np.searchsorted(rank_sum_cdf(n), alpha / 2, side="right"))
    centre, sd = n * (n + 1) / 4, math.sqrt(n * (n + 1) * (2 * n + 1) / 24)
    return max(int(centre + scipy.special.ndtri(alpha / 2) * sd), 0)


def _trimmed_mean(d: Array) -> tuple[Array, Array]:
    """Return the trimmed mean of rows of differences and its standard error, [K].

    The error is that of Tukey and McLaughlin, from the winsorised differences. Where lost runs remain after trimming, the
    sum of the signs replaces the mean, without an error. Shapes: d [K, n].
    """
    n = d.shape[1]
    cut = int(TRIM_SHARE * n + 1e-9)
    ordered, middle = np.sort(d, axis=1), n - 2 * cut
    ends = ordered[:, [cut, n - cut - 1]]
    has_mean = np.asarray(np.isfinite(ends).all(axis=1))  # else only signs are numbers
    low, high = np.where(has_mean[:, None], ends, 0.0).T[..., None]
    location = np.clip(ordered[:, cut : n - cut], low, high).mean(axis=1)
    winsorised = np.clip(d, low, high)
    squares = ((winsorised - winsorised.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    is_flat = np.ptp(winsorised, axis=1) <= _ROUNDING * np.abs(winsorised).max(axis=1)
    squares = np.where(is_flat, 0.0, squares) / (middle * (middle - 1)) if middle > 1 else np.inf
    return np.where(has_mean, location, np.sign(d).sum(axis=1)), np.where(
        has_mean, np.sqrt(squares), np.nan
    )


def _trimmed_p(d: Array, alternative: Alternative = "two-sided") -> Array:
    """Return the p-value of the trimmed mean of each row of differences, 1 where the middle runs do not differ; of the signs where lost runs are among them.

    Shapes: d [K, n].
    """
    if d.shape[1] < 2:
        return np.ones(len(d))
    value, error = _trimmed_mean(d)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(value == 0.0, 0.0, value / error)
    df = max(d.shape[1] - 2 * int(TRIM_SHARE * d.shape[1] + 1e-9) - 1, 1)
    if alternative == "less":
        p, of_signs = scipy.special.stdtr(df, t), _side_p(d)
    else:
        p = 2 * scipy.special.stdtr(df, -np.abs(t))
        of_signs = _sign_p((d > 0).sum(axis=1), (d < 0).sum(axis=1))
    return np.where(np.isnan(error), of_signs, np.where(value == 0.0, 1.0, p))


# --------------------------------------------------------------------------------------------------
# Estimate with a Student distribution.


class EffectEstimate(NamedTuple):
    """Estimate with a Student distribution, [...].

    Attributes:
        value: Estimate.
        standard_error: Standard error.
        df: Degrees of freedom, NaN if the error cannot be estimated.
    """

    value: Array
    standard_error: Array
    df: Array

    @property
    def p(self) -> Array:
        """Two-sided p-value of no effect; NaN without degrees of freedom or for an infinite value.

        An effect that is exactly 0 without any spread has p = 1.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(self.value == 0.0, 0.0, np.abs(self.value) / self.standard_error)
            p = 2 * scipy.special.stdtr(self.df, -t)
        return np.where(np.isfinite(self.value) & (self.df > 0), p, np.nan)

    def interval(self, alpha: float | Array) -> tuple[Array, Array]:
        """Return the ends of the interval of level 1 - alpha; infinite if it does not exist."""
        df = np.where(self.df > 0, self.df, 1.0)
        with np.errstate(invalid="ignore"):
            half = -scipy.special.stdtrit(df, np.asarray(alpha) / 2) * self.standard_error
        exists = np.isfinite(self.value) & np.isfinite(half) & (self.df > 0)
        half = np.where(exists, half, np.inf)
        centre = np.where(exists, self.value, 0.0)
        return centre - half, centre + half


def estimate_mean(values: Array) -> EffectEstimate:
    """Estimate the mean of independent values [n], whose error follows from their spread."""
    n = values.size
    if not n:
        return EffectEstimate(*(np.asarray(np.nan) for _ in range(3)))
    error = values.std(ddof=1) / np.sqrt(n) if n > 1 else np.nan
    return EffectEstimate(np.asarray(values.mean()), np.asarray(error), np.asarray(n - 1.0))
