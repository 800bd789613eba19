"""Intervals of a median by order statistics, which decide claims, and of a mean over two crossed samples."""

from __future__ import annotations

import math
from typing import NamedTuple

from scipy import stats

from pfbench.stats.error_measures import Array


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


def crossed_mean_interval(values: Array, level: float = 0.95) -> tuple[float, float]:
    """Compute the interval of a mean over two crossed samples, such as trainings and test runs.

    Args:
        values: One value for each pair, [A, B]. A sample of one counts as fixed.
        level: Probability of the interval.

    Returns:
        Mean, and half of the length of Student's interval.

    References:
        F. E. Satterthwaite (1946), An approximate distribution of estimates of variance components.
    """
    variances = [
        (values.mean(axis).var(ddof=1), n)
        for axis, n in ((0, values.shape[1]), (1, values.shape[0]))
        if n > 1
    ]
    variance = sum(spread / n for spread, n in variances)
    if not variance:
        return float(values.mean()), 0.0
    freedom = variance**2 / sum((spread / n) ** 2 / (n - 1) for spread, n in variances)
    quantile = float(stats.t.ppf(0.5 + level / 2, freedom))
    return float(values.mean()), quantile * math.sqrt(variance)
