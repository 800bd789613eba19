"""Effect sizes of two filters on the same runs: log ratios, rank-biserial correlation, improvement."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.error_measures import Array

# Errors are stored in single precision: smaller differences of a logarithm are rounding. Without
# the tolerance, EKF and UKF of a linear model would differ by how they round.
LOG_TOLERANCE = 1e-6


class ProportionEstimate(NamedTuple):
    """Probability estimated from n runs.

    Attributes:
        value: Estimate, 0 to 1.
        parts: Contribution of each run, [n]. Their mean is the value, and their variance divided
            by n is the variance of the value.
    """

    value: float
    parts: Array

    @property
    def variance(self) -> float:
        """Variance of the value over runs; NaN of one run."""
        size = self.parts.size
        return float(np.var(self.parts, ddof=1)) / size if size > 1 else np.nan


def log_ratio(a: Array, b: Array) -> Array:
    """Compute finite log ratios of the losses of two filters.

    Where one of the two is lost, the result lies beyond all others. Where both are lost, or the
    ratio differs from 1 by less than the stored precision, it is 0.

    Args:
        a: Losses of the first filter, [n], non-negative, infinite where lost.
        b: Losses of the second filter, [n].

    Returns:
        log(a / b), [n].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a) - np.log(b)
    d = np.where((a == b) | (np.abs(d) <= LOG_TOLERANCE), 0.0, d)
    return np.where(np.isfinite(d), d, np.sign(d) * beyond_finite(d))


def beyond_finite(d: Array) -> float:
    """Return a number so large that its mean with any finite difference exceeds them all."""
    return 4 * float(np.abs(d[np.isfinite(d)]).max(initial=0.0)) + 1


def rank_with_ties(values: Array) -> tuple[Array, Array]:
    """Return ranks of values [n] from 1, ties averaged, and the number of values in each tie."""
    _, index, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[index], count.astype(np.float64)


def rank_biserial(d: Array) -> float:
    """Compute the matched-pairs rank-biserial correlation [Kerby 2014] of d = log(a / b).

    Positive if a has the smaller losses, 1 if it always has.
    """
    rank, _ = rank_with_ties(np.abs(d))
    return float((rank[d < 0].sum() - rank[d > 0].sum()) / rank.sum())


def rank_biserial_proportion(d: Array) -> ProportionEstimate:
    """Express the rank-biserial correlation r of differences as the probability (1 + r) / 2.

    It is the probability that the mean of two differences is below zero.
    """
    value = (1 + rank_biserial(d)) / 2
    return ProportionEstimate(value, 1 - np.sign(d[:, None] + d).mean(1) - value)


def probability_of_improvement(a: Array, b: Array) -> ProportionEstimate:
    """Estimate the probability that a run of a has a smaller loss than a run of b.

    All pairs of runs count, ties half [Vargha, Delaney 2000].

    Args:
        a: Losses of the first filter, [n], infinite where lost.
        b: Losses of the second filter in the same runs, [n].

    Returns:
        The probability and the contribution of each run.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a)[:, None] - np.log(b)
    is_tie = np.isnan(d) | (np.abs(d) <= LOG_TOLERANCE)
    won = (1 - np.where(is_tie, 0.0, np.sign(d))) / 2
    value = float(won.mean())
    return ProportionEstimate(value, won.mean(1) + won.mean(0) - value)
