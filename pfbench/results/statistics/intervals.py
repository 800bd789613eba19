"""Interval of a median by order statistics, which decides claims: it holds for any distribution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from pfbench.results.error_measures import Array


class ConfidenceInterval(NamedTuple):
    """Interval and the method that produced it.

    Attributes:
        low: Lower end.
        high: Upper end.
        method: Name of the method, "none" if the sample is too small.
    """

    low: float
    high: float
    method: str


def order_statistic_interval(d: Array, level: float) -> ConfidenceInterval:
    """Compute the interval of a median between two order statistics, exact for any distribution.

    Args:
        d: Sample, [n].
        level: Least coverage.

    Returns:
        The interval, infinite and of method "none" if n is too small.
    """
    ordered, n = np.sort(d), d.size
    k = int(stats.binom.ppf((1 - level) / 2, n, 0.5)) if n else -1
    if n and stats.binom.cdf(k, n, 0.5) > (1 - level) / 2:
        k -= 1
    if k < 0:
        return ConfidenceInterval(-np.inf, np.inf, "none")
    return ConfidenceInterval(float(ordered[k]), float(ordered[n - 1 - k]), "order statistics")
