"""Consistency of a filter's distribution with the truth: NEES, whiteness, coverage, ranks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from pfbench.results.error_measures import Array, Flags, RunMean, count_runs, finite_mean


class NeesConsistency(NamedTuple):
    """NEES averaged over runs, and its interval for a consistent filter.

    Attributes:
        average: Mean over valid runs at each step, [T].
        low: Lower limit at each step, [T].
        high: Upper limit at each step, [T].
        runs_at: Number of runs at each step, [T].
        mean: Mean over runs and time; its expectation is dof.
        inside: Share of the steps at which the average lies inside the interval.
        runs: Number of runs included.
    """

    average: Array
    low: Array
    high: Array
    runs_at: NDArray[np.intp]
    mean: float
    inside: float
    runs: int


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


def nees_band(dof: int, runs: int | NDArray[np.intp], alpha: float = 0.05) -> tuple[Array, Array]:
    """Compute the two-sided interval of the NEES averaged over independent runs.

    Chi-square limits [Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2].

    Args:
        dof: Number of components of the group.
        runs: Number of runs, of any shape; 0 gives NaN.
        alpha: Probability outside the interval for a consistent filter.

    Returns:
        Lower and upper limit, in the shape of `runs`.
    """
    n = np.where(np.asarray(runs) > 0, runs, np.nan)
    low, high = (chdtri(dof * n, q) / n for q in (1 - alpha / 2, alpha / 2))
    return low, high


def compute_consistency(nees: Array, lost: Flags, dof: int, alpha: float = 0.05) -> NeesConsistency:
    """Compare the NEES averaged over runs with its chi-square interval.

    Args:
        nees: Normalised estimation error squared of one group, [R, T].
        lost: Lost runs, [R].
        dof: Number of components of the group.
        alpha: Probability outside the interval for a consistent filter.

    Returns:
        Averages and limits.
    """
    valid = np.asarray(nees, dtype=np.float64)[~lost]
    count = (~np.isnan(valid)).sum(axis=0)
    average = finite_mean(valid, axis=0)
    low, high = nees_band(dof, count, alpha)
    inside = ((average >= low) & (average <= high))[count > 0]
    share = float(inside.mean()) if inside.size else np.nan
    mean = float(finite_mean(valid.ravel(), axis=0))
    return NeesConsistency(average, low, high, count, mean, share, count_runs(valid))


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


def rank_histogram(pit: Array, lost: Flags, bins: int = 10) -> RunMean:
    """Compute the share of truths in each bin of probability; runs have equal weight.

    The shares are equal for a calibrated filter [Gneiting, Balabdaoui, Raftery 2007].

    Args:
        pit: Probability integral transform, [R, S, K]; NaN without truth.
        lost: Lost runs, [R].
        bins: Number of bins.

    Returns:
        Shares, value [bins].
    """
    valid = np.asarray(pit, dtype=np.float64)[~lost]
    valid = valid.reshape(len(valid), -1)
    has_truth = ~np.isnan(valid)
    index = np.clip(np.where(has_truth, valid, 0.0) * bins, 0, bins - 1).astype(int)
    shares = [finite_mean(np.where(has_truth, index == k, np.nan), axis=1) for k in range(bins)]
    mean = finite_mean(np.stack(shares, axis=1), axis=0)
    return RunMean(mean, int(has_truth.any(axis=1).sum()))
