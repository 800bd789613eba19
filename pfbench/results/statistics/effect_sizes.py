"""Log ratios of the losses of two filters on the same runs."""

from __future__ import annotations

import numpy as np

from pfbench.results.error_measures import Array

# Errors are stored in single precision: smaller differences of a logarithm are rounding. Without
# the tolerance, EKF and UKF of a linear model would differ by how they round.
LOG_TOLERANCE = 1e-6


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
