"""Quantiles of chi-square without scipy.special, whose import takes a tenth of the time of a first job."""

from __future__ import annotations

import math
from functools import cache


@cache
def chi_square_limit(dof: int, tail: float) -> float:
    """Return the limit that chi-square with `dof` degrees of freedom exceeds with probability `tail`.

    It is found by halving an interval that ends at the bound of Laurent and Massart (2000), lemma 1.
    """
    if tail <= 0.0:
        return math.inf
    limit, step = 0.0, dof + 2 * math.sqrt(-dof * math.log(tail)) - 2 * math.log(tail)
    while limit + step > limit:
        step /= 2
        limit += step * (_tail(dof, limit + step) > tail)
    return limit


def _tail(dof: int, value: float) -> float:
    """Return the probability that chi-square exceeds a positive value: the incomplete gamma function of half integers."""
    half, odd = value / 2, dof % 2
    terms = [math.exp((k - odd / 2) * math.log(half) - half - math.lgamma(k + 1 - odd / 2)) for k in range(odd, (dof + odd) // 2)]  # fmt: skip
    return sum(terms) + odd * math.erfc(math.sqrt(half))
