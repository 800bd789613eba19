"""Tests without an assumption of normality: signed ranks with Holm's correction, label flips, e-values."""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from fractions import Fraction
from functools import cache, lru_cache
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import scipy  # scipy.stats is imported at its first use, which takes longer than a small report
from scipy.special import betaln, gammaln, ndtr

from pfbench.stats.error_measures import Array

# --------------------------------------------------------------------------------------------------
# Wilcoxon's signed-rank test, and Holm's correction.

_SIGNS_ENUMERATED = 13  # tied differences up to which all signs are enumerated, as in scipy
EXACT_DIFFERENCES = 50  # untied differences up to which the distribution is exact, as in scipy
Alternative = Literal["two-sided", "greater", "less"]


class SignedRankResult(NamedTuple):
    """Result of Wilcoxon's signed-rank test.

    Attributes:
        statistic: Smaller rank sum, or the positive one of a one-sided test.
        p: p-value.
    """

    statistic: float
    p: float


def holm(p: Sequence[float] | Array) -> Array:
    """Adjust p-values for multiple tests [Holm 1979], in the given order.

    The version of statsmodels collects garbage at each call, which dominates a report's time.
    """
    raw = np.asarray(p, dtype=np.float64)
    order = np.argsort(raw, kind="stable")
    adjusted = np.empty(raw.size)
    steps = raw[order] * np.arange(raw.size, 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return adjusted


def wilcoxon_signed_rank(d: Array, alternative: Alternative = "two-sided") -> SignedRankResult:
    """Test whether paired differences are centred at zero.

    Args:
        d: Differences, [n].
        alternative: As in `wilcoxon_signed_rank_rows`.
    """
    statistic, p = wilcoxon_signed_rank_rows(np.asarray(d, dtype=np.float64)[None], alternative)
    return SignedRankResult(float(statistic[0]), float(p[0]))


def wilcoxon_signed_rank_rows(
    d: Array, alternative: Alternative = "two-sided"
) -> tuple[Array, Array]:
    """Test each row of paired differences with Wilcoxon's signed-rank test.

    Ranks of zeros are split evenly [Demsar 2006]. The null distribution is chosen as scipy does:
    exact up to 13 differences, and up to 50 if none are tied, otherwise normal. All rows are
    tested at once, since one call of scipy per pair dominated the time of a report.

    Returns statistic and p-value of each row, [K]. The statistic is the smaller rank sum of a
    two-sided test, else the sum of the positive ranks. A row of zeros has p = 1. Shapes: d [K, n].
    """
    n = d.shape[1]
    size = np.abs(d)
    ranks = np.asarray(scipy.stats.rankdata(size, axis=1), dtype=np.float64)
    ordered = np.sort(size, axis=1)
    has_ties = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1) | (d == 0).any(axis=1)
    half_zero = np.where(d == 0, ranks, 0.0).sum(axis=1) / 2
    above = np.where(d > 0, ranks, 0.0).sum(axis=1) + half_zero
    below = np.where(d < 0, ranks, 0.0).sum(axis=1) + half_zero
    more, less, two_sided = (np.ones(len(d)) for _ in range(3))
    exact = ~has_ties & (n <= EXACT_DIFFERENCES)
    if exact.any():
        more[exact], less[exact] = _exact_tails(n, above[exact])
    enumerated = has_ties & (n <= _SIGNS_ENUMERATED)
    for k in np.flatnonzero(enumerated):
        sums = _all_signs(n) @ np.where(d[k] == 0, 0.0, ranks[k]) + half_zero[k]  # halves: exact
        more[k], less[k] = (sums >= above[k]).mean(), (sums <= above[k]).mean()
    two_sided = np.minimum(1.0, 2 * np.minimum(more, less))
    normal = ~exact & ~enumerated
    if normal.any():
        z = _normal_score(ranks[normal], size[normal], above[normal])
        more[normal], less[normal], two_sided[normal] = ndtr(-z), ndtr(z), 2 * ndtr(-np.abs(z))
    constant = ~d.any(axis=1)
    p = {"two-sided": two_sided, "greater": more, "less": less}[alternative]
    statistic = np.minimum(above, below) if alternative == "two-sided" else above
    return np.where(constant, n * (n + 1) / 4, statistic), np.where(constant, 1.0, p)


def _exact_tails(n: int, above: Array) -> tuple[Array, Array]:
    """Return P(T >= above) and P(T <= above) of the rank sum of n untied differences."""
    cumulative = rank_sum_cdf(n)
    index = np.rint(above).astype(int)  # untied ranks are integers
    # By symmetry, so that small tails are not differences from 1.
    return cumulative[cumulative.size - 1 - index], cumulative[index]


@cache
def rank_sum_cdf(n: int) -> Array:
    """Return the distribution function of the positive rank sum of n untied differences."""
    count = np.zeros(n * (n + 1) // 2 + 1, dtype=np.int64)  # at most 2^50: sums are exact
    count[0] = 1
    for rank in range(1, n + 1):
        count[rank:] = count[rank:] + count[:-rank]
    return np.asarray(np.cumsum(count) / 2.0**n)


def _normal_score(ranks: Array, size: Array, above: Array) -> Array:
    """Standardise positive rank sums [K], with the variance corrected for ties."""
    n = ranks.shape[1]
    last, first = (scipy.stats.rankdata(size, method=m, axis=1) for m in ("max", "min"))
    count = (last - first + 1).astype(np.float64)
    ties = (count**2 - 1).sum(axis=1)  # over values, equals the sum of t^3 - t over ties
    deviation = np.sqrt((n * (n + 1) * (2 * n + 1) - ties / 2) / 24)
    with np.errstate(invalid="ignore"):  # all zero; the caller sets p = 1
        return np.asarray((above - n * (n + 1) / 4) / deviation)


@cache
def _all_signs(n: int) -> Array:
    """Enumerate the positive differences among n in all 2^n ways, [2^n, n]."""
    return np.array(list(product((0.0, 1.0), repeat=n)))


# --------------------------------------------------------------------------------------------------
# Test of a share by exchange of the two filters in whole runs.
#
# If two filters are alike, the exchange of their labels in a run does not change the distribution of
# the results. All conditions of a run are exchanged together, because they share random numbers.
# McNemar's test over conditions ignores this and is too liberal.
#
# The distribution over all 2^N exchanges is computed exactly where the contributions are multiples of
# a common step. Otherwise labels are exchanged at random.
#
# References:
#     R. A. Fisher (1935), The design of experiments.

FLIPS = 9999  # random exchanges: the smallest p-value is 1e-4, as many pairs require
_LONGEST_SUM = 20_000  # steps up to which the distribution is exact
_TOLERANCE = 1e-9


def run_contributions(d: Array, weights: Array, shared_runs: bool = True) -> Array:
    """Compute the contribution of each run to a mean over worlds and conditions.

    Returns contributions, [..., N], or [..., W * N] for worlds with runs that are not shared.
    Shapes: d [..., W, C, N], weights [W, C].
    """
    runs = np.count_nonzero(~np.isnan(d), axis=-1)
    share = weights / np.maximum(runs, 1) / d.shape[-3]
    by_world = np.einsum("...wc,...wcn->...wn", share, np.nan_to_num(d))
    if shared_runs:
        return np.asarray(by_world.sum(axis=-2))
    return by_world.reshape(*by_world.shape[:-2], -1)


def flip_p_value(contributions: Array, seed: int = 0, key: str = "") -> float:
    """Test whether contributions are symmetric around zero, two-sided.

    Returns p-value; 1 if all contributions are 0. Shapes: contributions [N].
    """
    x = contributions[np.abs(contributions) > _TOLERANCE]
    if not x.size:
        return 1.0
    steps = _as_steps(x)
    if steps is not None:
        sizes, counts = np.unique(np.abs(steps), return_counts=True)
        sums = _positive_sum_distribution(tuple(map(int, sizes)), tuple(map(int, counts)))
        distance = np.abs(2 * np.arange(sums.size) - (sums.size - 1))
        return min(1.0, float(sums[distance >= abs(int(steps.sum()))].sum()))
    rng = np.random.default_rng([seed, zlib.crc32(key.encode())])
    signs = rng.integers(0, 2, (FLIPS, x.size)) * 2.0 - 1.0
    extreme = np.abs(signs @ x) >= abs(float(x.sum())) - _TOLERANCE
    return (1 + int(extreme.sum())) / (1 + FLIPS)


def _as_steps(x: Array) -> np.ndarray | None:
    """Express numbers as multiples of a common step; None without a step of useful size."""
    smallest = float(np.abs(x).min())
    denominator = 1
    for ratio in np.unique(np.round(np.abs(x) / smallest, 9)):
        fraction = Fraction(float(ratio)).limit_denominator(1000)
        if abs(float(fraction) - ratio) > 1e-6:
            return None
        denominator = math.lcm(denominator, fraction.denominator)
        if denominator > _LONGEST_SUM:
            return None
    steps = np.rint(x / smallest * denominator).astype(np.int64)
    return steps if np.abs(steps).sum() <= _LONGEST_SUM else None


@lru_cache(maxsize=4096)
def _positive_sum_distribution(sizes: tuple[int, ...], counts: tuple[int, ...]) -> Array:
    """Compute the distribution of the sum of sizes, each included with probability 1/2."""
    total = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        spaced = np.zeros(size * count + 1)
        k = np.arange(count + 1)
        spaced[::size] = np.exp(
            gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1) - count * math.log(2)
        )
        total = np.convolve(total, spaced)
    return total


# --------------------------------------------------------------------------------------------------
# Evidence that holds at any number of runs: e-values of the sign test and their interval.
#
# For users who add runs without a plan. The e-value is exact for the median of any distribution, with
# lost runs, at all numbers of runs together. It requires 15 to 24 % more runs than planned looks.
#
# References:
#     H. Robbins (1970), Statistical methods related to the law of the iterated logarithm.
#     S. R. Howard and A. Ramdas (2022), Sequential estimation of quantiles.
#     V. Vovk and R. Wang (2021), E-values: calibration, combination and applications.

_CONCENTRATION = 8.0  # of the symmetric beta mixture


def log_e_value(below: Array | int, runs: Array | int) -> Array:
    """Compute the logarithm of the e-value against equal shares on both sides.

    Returns logarithms, [...]. The hypothesis is rejected at level alpha at 1 / alpha. Shapes: below
    [...], runs [...].
    """
    a = _CONCENTRATION
    k, n = np.asarray(below, dtype=np.float64), np.asarray(runs, dtype=np.float64)
    return np.asarray(n * np.log(2.0) + betaln(k + a, n - k + a) - betaln(a, a))


def sign_log_e_value(d: Array) -> Array:
    """Compute the logarithm of the e-value of a median of 0.

    Shapes: d [..., n].
    """
    return log_e_value((d < 0).sum(axis=-1), (d != 0).sum(axis=-1))


def confidence_sequence(d: Array, alpha: float) -> tuple[Array, Array]:
    """Compute the interval of the median that holds at all numbers of runs together.

    Shapes: d [..., n].
    """
    n = d.shape[-1]
    k = least_count(n, alpha)
    if k < 1 or 2 * k > n + 1:
        shape = d.shape[:-1]
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    ordered = np.sort(d, axis=-1)
    return ordered[..., k - 1], ordered[..., n - k]


def least_count(runs: int, alpha: float) -> int:
    """Return the least number of runs below a value at which the value is not rejected."""
    plausible = log_e_value(np.arange(runs + 1, dtype=np.float64), runs) < np.log(1 / alpha)
    return int(np.argmax(plausible)) if plausible.any() else runs + 1


def combine_e_values(log_e: Array, comparisons: int, alpha: float = 0.05) -> bool:
    """Decide from e-values of independent samples, with Bonferroni's correction.

    Returns whether the product reaches comparisons / alpha. Shapes: log_e [W].
    """
    return bool(np.sum(log_e) >= np.log(comparisons / alpha))
