"""Consistency of a filter's distribution with the truth: NEES, whiteness, coverage, ranks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.error_measures import Array, Flags, finite_mean


class WhitenessResult(NamedTuple):
    """Moments of normalised residuals, with 95 % limits for white standard normal numbers.

    Attributes:
        mean: Mean.
        mean_band: Limit of the absolute mean.
        variance: Mean square.
        variance_band: Limit of the absolute difference of the mean square from 1.
        lag: Autocorrelation at lag 1.
        lag_band: Limit of the absolute autocorrelation.
        outside_share: Share beyond three standard deviations; 0.0027 for a normal distribution.
        numbers: Sample size.
    """

    mean: float
    mean_band: float
    variance: float
    variance_band: float
    lag: float
    lag_band: float
    outside_share: float
    numbers: int


def compute_whiteness(z: Array) -> WhitenessResult:
    """Compare normalised residuals with white standard normal numbers.

    Method of Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2. Steps without a measurement in any
    run are left out, so that the autocorrelation is between successive measurements.

    Args:
        z: Normalised residuals, [R, T, K]; NaN without a measurement.

    Returns:
        Moments and their 95 % limits.
    """
    z = np.asarray(z, dtype=np.float64)
    values = z[~np.isnan(z)]
    measured = z[:, ~np.isnan(z).all(axis=(0, 2))]
    products = measured[:, 1:] * measured[:, :-1]
    pairs = int((~np.isnan(products)).sum())
    square = float(finite_mean(values**2, axis=0))
    covariance = float(finite_mean(products.ravel(), axis=0))
    root = 1.96 / np.sqrt(max(values.size, 1))
    return WhitenessResult(
        mean=float(finite_mean(values, axis=0)),
        mean_band=float(root),
        variance=square,
        variance_band=float(np.sqrt(2) * root),
        lag=covariance / square if pairs and square > 0 else np.nan,
        lag_band=float(1.96 / np.sqrt(pairs)) if pairs else np.nan,
        outside_share=float(finite_mean((np.abs(values) > 3).astype(np.float64), axis=0)),
        numbers=values.size,
    )


def coverage_per_run(pit: Array, lost: Flags, level: float) -> Array:
    """Compute the share of truths in the central interval of each run.

    Args:
        pit: Probability integral transform, [R, S, K]; NaN without truth.
        lost: Lost runs, [R].
        level: Probability of the interval, 0 to 1.

    Returns:
        Share, [R]; NaN for a lost run.
    """
    pit = np.asarray(pit, dtype=np.float64)
    # Stored in single precision: a truth on the limit counts as inside.
    inside = np.where(np.isnan(pit), np.nan, np.abs(pit - 0.5) <= level / 2 + 1e-6)
    return np.where(lost, np.nan, finite_mean(inside.reshape(len(inside), -1), axis=1))
