"""Wilcoxon's signed-rank test, its posterior, and Holm's correction."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from typing import Literal

import numpy as np
import scipy  # scipy.stats is imported at its first use, which takes longer than a small report

from pfbench.stats.error_measures import Array

_SIGNS_ENUMERATED = 13  # tied differences up to which all signs are enumerated, as in scipy
EXACT_DIFFERENCES = 50  # untied differences up to which the distribution is exact, as in scipy
_POSTERIOR_DRAWS = 2000
Alternative = Literal["two-sided", "greater", "less"]


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


def wilcoxon_signed_rank(d: Array, alternative: Alternative = "two-sided") -> tuple[float, float]:
    """Test whether paired differences are centred at zero; return statistic and p-value.

    Args:
        d: Differences, [n].
        alternative: As in `wilcoxon_signed_rank_rows`.
    """
    statistic, p = wilcoxon_signed_rank_rows(np.asarray(d, dtype=np.float64)[None], alternative)
    return float(statistic[0]), float(p[0])


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
    last, first = (scipy.stats.rankdata(size, method=m, axis=1) for m in ("max", "min"))
    ranks = (first + last) / 2  # the mean rank of those that are tied
    has_ties = (first != last).any(axis=1) | (d == 0).any(axis=1)
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
        z = _normal_score((last - first + 1.0)[normal], above[normal])
        more[normal], less[normal], two_sided[normal] = (
            scipy.special.ndtr(-z),
            scipy.special.ndtr(z),
            2 * scipy.special.ndtr(-np.abs(z)),
        )
    constant = ~d.any(axis=1)
    p = {"two-sided": two_sided, "greater": more, "less": less}[alternative]
    statistic = np.minimum(above, below) if alternative == "two-sided" else above
    return np.where(constant, n * (n + 1) / 4, statistic), np.where(constant, 1.0, p)


def weigh_regions(d: Array, margin: float) -> tuple[float, float, float]:
    """Return the probabilities that the median of the means of two differences is below -margin, between, and above margin.

    The posterior of the signed-rank test with a Dirichlet process as prior, which has the weight of half a run at 0
    [Benavoli et al. 2014]: the differences get random weights, 2000 times. The seed is fixed; the standard error is 0.01.
    Shapes: d [n]; n of at least 1.
    """
    atoms = np.append(d, 0.0)
    mass = np.append(np.ones(len(d)), 0.5)
    weights = np.random.default_rng(0).dirichlet(mass, _POSTERIOR_DRAWS)
    means = np.add.outer(atoms, atoms) / 2
    below, above = (
        float(((weights @ flags * weights).sum(axis=1) > 0.5).mean())
        for flags in (means < -margin, means > margin)
    )
    return below, 1.0 - below - above, above


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


def _normal_score(count: Array, above: Array) -> Array:
    """Standardise positive rank sums [K], with the variance corrected for ties: how many have each value, [K, n]."""
    n = count.shape[1]
    ties = (count**2 - 1).sum(axis=1)  # over values, equals the sum of t^3 - t over ties
    deviation = np.sqrt((n * (n + 1) * (2 * n + 1) - ties / 2) / 24)
    with np.errstate(invalid="ignore"):  # all zero; the caller sets p = 1
        return np.asarray((above - n * (n + 1) / 4) / deviation)


@cache
def _all_signs(n: int) -> Array:
    """Enumerate the positive differences among n in all 2^n ways, [2^n, n]."""
    return np.array(list(product((0.0, 1.0), repeat=n)))
