"""Quantiles of the chi-square distribution, without a library whose import takes a tenth of the start of a job."""

from __future__ import annotations

import math
from functools import cache


@cache
def chi_square_limit(dof: int, p: float) -> float:
    """Return the value that a chi-square variable of `dof` degrees of freedom exceeds with probability p."""
    x = dof + 3.0 * math.sqrt(2.0 * dof)
    for _ in range(100):  # Newton's method on the log of the tail, which is concave
        tail = _exceedance(dof, x)
        step = math.log(tail / p) * tail / _density(dof, x)
        x = max(x + step, x / 2)
        if abs(step) <= 1e-15 * x:
            break
    return x


def _exceedance(dof: int, x: float) -> float:
    """Return the probability that a chi-square variable of whole `dof` exceeds x: a finite sum."""
    start = dof % 2
    tail = math.erfc(math.sqrt(x / 2)) if start else 0.0
    return tail + sum(2 * _density(k + 2, x) for k in range(start, dof, 2))


def _density(dof: int, x: float) -> float:
    """Return the density of a chi-square variable."""
    return math.exp((dof / 2 - 1) * math.log(x / 2) - x / 2 - math.lgamma(dof / 2)) / 2
