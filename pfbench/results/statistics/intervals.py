"""Intervals of medians and proportions.

Two intervals of a median exist and differ. The bootstrap interval is shown for the ratio of two
filters. The interval of order statistics decides claims: it holds for any distribution and small
samples, and is wider.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.special import ndtr, ndtri, stdtrit

from pfbench.results.error_measures import Array

_RESAMPLES = 9999


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


def bootstrap_median_interval(d: Array, level: float, seed: int = 0) -> ConfidenceInterval:
    """Compute a bootstrap interval of a median: BCa [Efron 1987] if it exists, else percentile.

    Args:
        d: Sample, [n] with n >= 2.
        level: Coverage.
        seed: Seed of the resampling.

    Returns:
        The interval; `method` is "BCa" or "percentile".
    """
    ordered = np.sort(d)
    medians = _bootstrap_medians(ordered, seed)
    median = np.median(d)
    alpha = (1 - level) / 2
    z = np.array([ndtri(alpha), -ndtri(alpha)])
    with np.errstate(all="ignore"):  # NaN for a constant sample
        count = np.count_nonzero(medians < median) + np.count_nonzero(medians <= median)
        bias = ndtri(count / (2 * medians.size))
        levels = ndtr(bias + (bias + z) / (1 - _acceleration(ordered) * (bias + z)))
    method = "BCa" if np.isfinite(levels).all() else "percentile"
    low, high = np.quantile(medians, levels if method == "BCa" else [alpha, 1 - alpha])
    return ConfidenceInterval(float(low), float(high), method)


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


def proportion_interval(
    proportion: float, variance: float, runs: int, level: float
) -> ConfidenceInterval:
    """Compute the interval of a probability, normal on the log odds.

    A probability of 0 or 1 has the exact interval of as many trials as runs.

    Args:
        proportion: Estimate, 0 to 1.
        variance: Variance of the estimate.
        runs: Number of runs behind it.
        level: Coverage.

    Returns:
        The interval; `method` is "odds", "exact" or "none".
    """
    if runs < 2:
        return ConfidenceInterval(0.0, 1.0, "none")
    if not 0 < proportion < 1:
        edge = float(((1 - level) / 2) ** (1 / runs))
        low, high = (edge, 1.0) if proportion >= 1 else (0.0, 1 - edge)
        return ConfidenceInterval(low, high, "exact")
    log_odds = np.log(proportion / (1 - proportion))
    quantile = -stdtrit(runs - 1, (1 - level) / 2)
    half = quantile * np.sqrt(variance) / (proportion * (1 - proportion))
    low, high = 1 / (1 + np.exp(-(log_odds + np.clip(np.array([-half, half]), -500, 500))))
    return ConfidenceInterval(float(low), float(high), "odds")


def binomial_interval(proportion: float, runs: int, alpha: float = 0.05) -> tuple[float, float]:
    """Compute the two-sided band of an observed share of independent runs.

    Args:
        proportion: Probability of each run.
        runs: Number of runs; 0 gives NaN.
        alpha: Probability outside the band.

    Returns:
        Lower and upper end of the share.
    """
    if runs < 1:
        return np.nan, np.nan
    tails = (alpha / 2, 1 - alpha / 2)
    low, high = (float(stats.binom.ppf(q, runs, proportion)) / runs for q in tails)
    return low, high


def _acceleration(ordered: Array) -> float:
    """Compute the BCa acceleration of the median of sorted numbers [n]; NaN if constant."""
    n = ordered.size
    h = n // 2
    if n % 2:
        below, above = (ordered[h] + ordered[h + 1]) / 2, (ordered[h - 1] + ordered[h]) / 2
        without = (ordered[h - 1] + ordered[h + 1]) / 2
        jackknife = np.repeat([below, above, without], [h, h, 1])
    else:
        jackknife = np.repeat([ordered[h], ordered[h - 1]], [h, h])
    u = (jackknife.mean() - jackknife) * (n - 1) / n
    return float((u**3).sum() / (u**2).sum() ** 1.5 / 6)


def _bootstrap_medians(ordered: Array, seed: int) -> Array:
    """Draw medians of samples taken from sorted numbers [n] with replacement."""
    low, high = _middle_indices(ordered.size, seed)
    return np.asarray((ordered[low] + ordered[high]) / 2)


@cache
def _middle_indices(n: int, seed: int) -> tuple[Array, Array]:
    """Draw the indices of the middle of n sorted numbers resampled with replacement.

    Drawn from the distribution of the middle of n uniform numbers, without the n draws, and shared
    by all samples of a size. Both took most of the time of a report.
    """
    rng = np.random.default_rng([n, seed])
    m = (n + 1) // 2
    first = rng.beta(m, n - m + 1, _RESAMPLES)
    # For even n, the next of the n - m numbers above the first.
    second = first if n % 2 else 1 - (1 - first) * rng.random(_RESAMPLES) ** (1 / (n - m))
    low, high = ((n * u).astype(int).clip(max=n - 1) for u in (first, second))
    return low, high
