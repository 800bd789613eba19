"""Comparison of two filters: the effect on paired losses, and the verdicts on a family of effects.

All pages decide here. The loss of a run is the logarithm of its error, at most that of the cap of the world. A
lost run has the loss of the cap, so that no filter, pair or world leaves a table for one lost run.

A verdict needs two tests that agree: Wilcoxon's signed-rank test, whose estimate is that of Hodges and Lehmann
and whose interval is printed, and the t test of the trimmed mean. The first asks which filter has the smaller
error in most runs; with skewed differences it rejects although the means are equal, and the second does not.

References:
    F. Wilcoxon (1945), Individual comparisons by ranking methods.
    J. L. Hodges and E. L. Lehmann (1963), Estimates of location based on rank tests.
    S. Holm (1979), A simple sequentially rejective multiple test procedure.
    O. Guilbaud (2008), Simultaneous confidence regions corresponding to Holm's step-down procedure.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Final, Literal, NamedTuple

import numpy as np
import scipy  # scipy.special is imported at its first use, which takes a tenth of the start of a job

from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import (
    EXACT_DIFFERENCES,
    Alternative,
    holm,
    rank_sum_cdf,
    wilcoxon_signed_rank_rows,
)

Unit = Literal["run", "block", "drive", "world"]
Word = Literal["better", "worse", "equal", "identical", "not decided"]
BETTER_THAN: Final = "better"
WORSE_THAN: Final = "worse"
EQUAL_WORD: Final = "equal"
SAME_RUNS: Final = "identical"
NO_DECISION: Final = "not decided"
EQUALITY_MARGIN = math.log(1.05)  # log ratios within it are equal [ours]
ALPHA = 0.05
MIN_RUNS = 10  # units that a decision requires [ours]
TRIM_SHARE = 0.2  # removed at each end; the middle 60 % of the units remain
# Errors are stored in single precision: smaller differences of a logarithm are rounding. Without
# the tolerance, EKF and UKF of a linear model would differ by how they round.
LOG_TOLERANCE = 1e-6
_ROUNDING = 1e-12  # relative spread of equal values
_FEW_DIFFERENCES = 200  # up to which the means of all pairs are formed
_HALVINGS = 52  # of the range of the differences: the precision of a double


class Effect(NamedTuple):
    """Effect of the first filter of a pair against the second.

    Attributes:
        a: Name of the first filter.
        b: Name of the second filter.
        unit: What was drawn independently: a run, a block of time, a drive or a world.
        differences: Log ratios of their losses, [n]; negative where the first filter is better.
        p: p-value of the signed-rank test, two-sided; 1 without a difference.
        p_trimmed: p-value of the trimmed mean.
    """

    a: str
    b: str
    unit: Unit
    differences: Array
    p: float
    p_trimmed: float

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

    def estimate(self, alpha: float) -> tuple[float, float, float]:
        """Return the log ratio, and the ends of its interval that belongs to the signed-rank test."""
        n = len(self.differences)
        k, count = _count_outside(n, alpha), n * (n + 1) // 2
        ranks = [max(k, 1), (count + 1) // 2, count // 2 + 1, count + 1 - max(k, 1)]
        low, *middle, high = _select_means(self.differences, ranks)
        return (middle[0] + middle[1]) / 2, low if k else -math.inf, high if k else math.inf


class Verdict(NamedTuple):
    """Verdict on a pair, with one interval: the simultaneous one of its family.

    Attributes:
        a: Name of the first filter.
        b: Name of the second filter.
        word: better, worse, equal, identical or not decided, of the first filter.
        ratio: Error of the first filter divided by that of the second.
        low: Lower end of the interval of the ratio.
        high: Upper end.
        p: p-value of the signed-rank test with Holm's correction.
        n: Number of runs, blocks or worlds.
        reason: Why nothing is decided; empty otherwise.
    """

    a: str
    b: str
    word: Word
    ratio: float
    low: float
    high: float
    p: float
    n: int
    reason: str


def bound_losses(error: Array, keeps_track: Flags, cap: float) -> Array:
    """Return the losses of runs: the logarithm of the error, at most that of the cap.

    Args:
        error: Errors, [...], not negative. NaN and infinity count as the cap.
        keeps_track: Runs that keep track, [...]. The others count as the cap.
        cap: Largest error that counts, positive, in the unit of the error.

    Raises:
        ValueError: If the cap is not a positive number.
    """
    if not (cap > 0 and math.isfinite(cap)):
        raise ValueError(
            f"cap must be a positive number, got {cap}. State the divergence threshold of the world."
        )
    counts = keeps_track & np.isfinite(error)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.where(counts, np.minimum(error, cap), cap)))


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
    differences = []
    for (name, first), (name_b, second) in pairs:
        if np.shape(first) != np.shape(second) or np.ndim(first) != 1:
            raise ValueError(
                f"{name} and {name_b} must have losses of the same {unit}s, got {np.shape(first)} and "
                f"{np.shape(second)}. Select common {unit}s."
            )
        differences.append(subtract_losses(first, second))
    return [
        Effect(a[0], b[0], unit, d, float(value), _trimmed_p(d))
        for (a, b), d, value in zip(pairs, differences, _signed_rank_p(differences), strict=True)
    ]


def decide(
    effects: Sequence[Effect], margin: float = EQUALITY_MARGIN, alpha: float = ALPHA
) -> list[Verdict]:
    """Decide a family of pairs with Holm's correction.

    Args:
        effects: Effects of all pairs of the family.
        margin: Log ratio within which two filters are equal.
        alpha: Error rate of the family.

    Returns:
        A verdict for each effect. "better" and "worse" need both tests after Holm's correction; "equal" needs
        the interval within the margin.
    """
    if not effects:
        return []
    tested = [
        is_testable(effect) for effect in effects
    ]  # the others cannot be decided, but stay in the family
    corrected = [
        holm([getattr(e, name) if yes else 1.0 for e, yes in zip(effects, tested, strict=True)])
        for name in ("p", "p_trimmed")
    ]
    return [
        _decide_one(effect, (p, q), alpha / len(effects), margin, alpha)
        for effect, p, q in zip(effects, *corrected, strict=True)
    ]


def is_testable(effect: Effect) -> bool:
    """Return whether a pair has enough units, and differences that vary over them."""
    return _varies(effect.differences)


def find_largest_p(pairs: Sequence[tuple[Array, Array]]) -> float:
    """Return the largest one-sided p-value of both tests: whether a filter is better than all others.

    Each pair has the losses of the filter and of one other in their common runs. The test of the union of the
    hypotheses needs no correction for their number. Shapes: losses [n] of a pair.
    """
    differences = [subtract_losses(first, second) for first, second in pairs]
    if not differences or not all(map(_varies, differences)):
        return 1.0
    signed = map(float, _signed_rank_p(differences, "less"))
    return max(*signed, *(_trimmed_p(d, "less") for d in differences))


def _signed_rank_p(differences: Sequence[Array], alternative: Alternative = "two-sided") -> Array:
    """Return a p-value for each array of differences [n], 1 for an empty one: those of equal length in one call."""
    p = np.ones(len(differences))
    sizes = np.array([len(d) for d in differences], dtype=int)
    for size in np.unique(sizes[sizes > 0]):
        d = np.stack([row for row in differences if len(row) == size])
        p[sizes == size] = wilcoxon_signed_rank_rows(d, alternative)[1]
    return p


def subtract_losses(first: Array, second: Array) -> Array:
    """Return log ratios of losses [n]; those within the stored precision are 0."""
    with np.errstate(invalid="ignore"):
        d = np.where(np.equal(first, second), 0.0, np.subtract(first, second))
    return np.where(np.abs(d) <= LOG_TOLERANCE, 0.0, d)


def _varies(d: Array) -> bool:
    """Return whether there are enough differences, and they are not all equal."""
    return len(d) >= MIN_RUNS and bool(np.ptp(d) > LOG_TOLERANCE)


def _decide_one(
    effect: Effect, p: tuple[float, float], level: float, margin: float, alpha: float
) -> Verdict:
    """Decide one pair: `p` has the corrected p-values of both tests."""
    names, n = (effect.a, effect.b), len(effect.differences)
    if n == 0:
        return Verdict(
            *names, NO_DECISION, math.nan, 0.0, math.inf, math.nan, 0, f"no common {effect.unit}s"
        )
    if not effect.differences.any():
        return Verdict(*names, SAME_RUNS, 1.0, 1.0, 1.0, math.nan, n, f"all {effect.unit}s agree")
    location, low, high = effect.estimate(level)
    if not is_testable(effect):
        units = f"{n} {effect.unit}{'' if n == 1 else 's'}"
        reason = f"{units}, {MIN_RUNS} are required" if n < MIN_RUNS else "no variation"
        return Verdict(*names, NO_DECISION, math.exp(location), 0.0, math.inf, math.nan, n, reason)
    is_signed, is_trimmed = p[0] < alpha, p[1] < alpha
    if is_signed:  # the interval that belongs to Holm's test may end at 0
        low, high = (low, min(high, 0.0)) if location < 0 else (max(low, 0.0), high)
    else:
        low, high = min(low, 0.0), max(high, 0.0)
    trimmed = _trimmed_mean(effect.differences)[0]
    word: Word = NO_DECISION
    reason = ""
    if -margin < low and high < margin:
        word = EQUAL_WORD
    elif is_signed and is_trimmed and trimmed * location > 0:
        word = BETTER_THAN if location < 0 else WORSE_THAN
    elif is_signed:
        reason = "the trimmed mean does not agree"
    ends = (math.exp(location), math.exp(low), math.exp(high))
    return Verdict(*names, word, *ends, float(p[0]), n, reason)


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


def _trimmed_mean(d: Array) -> tuple[float, float, float]:
    """Return the trimmed mean of differences, its standard error and its degrees of freedom.

    The error is that of Tukey and McLaughlin, from the winsorised differences.
    """
    n, cut = len(d), int(TRIM_SHARE * len(d) + 1e-9)
    middle = n - 2 * cut
    ordered = np.sort(d)
    location = float(ordered[cut : n - cut].mean())
    if middle < 2:
        return location, math.inf, 1.0
    winsorised = np.clip(d, ordered[cut], ordered[n - cut - 1])
    squares = float(((winsorised - winsorised.mean()) ** 2).sum())
    if np.ptp(winsorised) <= _ROUNDING * np.abs(winsorised).max():
        squares = 0.0
    return location, math.sqrt(squares / (middle * (middle - 1))), middle - 1.0


def _trimmed_p(d: Array, alternative: str = "two-sided") -> float:
    """Return the p-value of the trimmed mean; 1 where the middle runs do not differ."""
    if len(d) < 2:
        return 1.0
    value, error, df = _trimmed_mean(d)
    if value == 0:
        return 1.0
    t = value / error if error > 0 else math.copysign(math.inf, value)
    return (
        float(scipy.special.stdtr(df, t))
        if alternative == "less"
        else float(2 * scipy.special.stdtr(df, -abs(t)))
    )


# --------------------------------------------------------------------------------------------------
# Estimate with a Student distribution, and log ratios of losses that can be infinite.


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


def log_ratio(a: Array, b: Array) -> Array:
    """Compute finite log ratios of the losses of two filters.

    Where one of the two is lost, the result lies beyond all others. Where both are lost, or the
    ratio differs from 1 by less than the stored precision, it is 0.

    Shapes: a [n], b [n].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a) - np.log(b)
    d = np.where((a == b) | (np.abs(d) <= LOG_TOLERANCE), 0.0, d)
    return np.where(np.isfinite(d), d, np.sign(d) * beyond_finite(d))


def beyond_finite(d: Array) -> float:
    """Return a number so large that its mean with any finite difference exceeds them all."""
    return 4 * float(np.abs(d[np.isfinite(d)]).max(initial=0.0)) + 1
