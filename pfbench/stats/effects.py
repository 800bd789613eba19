"""Estimate with a Student distribution, and log ratios of losses that can be infinite."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # scipy.special is imported at its first use, which takes a tenth of the start of a job

from pfbench.stats.comparison import LOG_TOLERANCE
from pfbench.stats.error_measures import Array


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
