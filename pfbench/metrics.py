"""Measures of a filter on arrays with leading axes [R, T]: R Monte Carlo runs, T instants.

Three figures go by the name of RMSE in the literature; here each has its own name. Errors are estimate minus truth, NaN
where there is no truth (flights of unequal length are padded so); an instant at which any component is NaN is left out.
A lost run never enters an average, and never leaves without a trace: its own loss is infinite and every average says
how many runs it is over.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class Average(NamedTuple):
    """An average over runs.

    Attributes:
        value: a number, or one per component [K]; NaN when no run entered.
        runs: how many runs entered; the others were lost or had no truth.
    """

    value: Array
    runs: int


class Consistency(NamedTuple):
    """The average NEES over runs and the band in which it lies for a consistent filter.

    Attributes:
        average: over the runs at hand, at each instant [T]; chi-square with dof * runs_at degrees, divided
            by runs_at.
        low, high: two-sided band at each instant [T].
        runs_at: runs at each instant [T].
        mean: over runs and time; dof for a consistent filter.
        inside: share of the instants at which the average lies in the band.
        runs: runs that entered.
    """

    average: Array
    low: Array
    high: Array
    runs_at: NDArray[np.intp]
    mean: float
    inside: float
    runs: int


class Whiteness(NamedTuple):
    """Normalised residuals against the white standard normal law, and 95 % bands of what is estimated under it.

    Attributes:
        mean, mean_band: 0 within the band.
        variance, variance_band: mean square, about 0; 1 within the band.
        lag, lag_band: autocorrelation of neighbours in time; 0 within the band.
        beyond: share of the numbers beyond three standard deviations; 0.0027 of a normal law.
        numbers: how many there are.
    """

    mean: float
    mean_band: float
    variance: float
    variance_band: float
    lag: float
    lag_band: float
    beyond: float
    numbers: int


def rmse_per_run(error: Array, lost: Flags) -> Array:
    """Root of the mean over time of the squared norm, for each run [R].

    Args:
        error: [R, T, K], the components of one group.
        lost: [R].

    Returns:
        [R]; infinite for a lost run (what it did before it was lost is no measure of it), NaN for a run without truth.
    """
    return _with_lost(np.sqrt(_mean(_square(error), axis=1)), lost)


def rmse_run_mean(error: Array, lost: Flags) -> Average:
    """Mean over runs of the RMSE of each run. Arguments as `rmse_per_run`."""
    each = rmse_per_run(error, lost)
    used = ~np.isnan(each) & ~np.asarray(lost, dtype=bool)
    return Average(_mean(each[used], axis=0), int(used.sum()))


def rmse_norm(error: Array, lost: Flags) -> Average:
    """Root of the mean over runs and time of the squared norm. Arguments as `rmse_per_run`."""
    square = _square(error)[~lost]
    return Average(np.sqrt(_mean(square.ravel(), axis=0)), _seen(square))


def rmse_component(error: Array, lost: Flags) -> Average:
    """Root of the mean square over runs and time of each component, value [K]. Arguments as `rmse_per_run`."""
    kept = np.asarray(error, dtype=np.float64)[~lost]
    square = np.where(np.isnan(_square(kept))[..., None], np.nan, kept**2)
    return Average(np.sqrt(_mean(square.reshape(-1, kept.shape[-1]), axis=0)), _seen(square[..., 0]))


def max_error(error: Array, lost: Flags) -> Array:
    """Largest norm of the error over time, for each run [R]; infinite when lost. Arguments as `rmse_per_run`."""
    square = _square(error)
    largest = np.max(np.where(np.isnan(square), -np.inf, square), axis=1, initial=-np.inf)
    return _with_lost(np.sqrt(np.where(largest < 0, np.nan, largest)), lost)


def mean_per_run(trace: Array, lost: Flags) -> Array:
    """Mean over time of a trace [R, T] (ESS, NEES), for each run [R]; NaN for a lost run."""
    each = _mean(np.asarray(trace, dtype=np.float64), axis=1)
    return np.where(lost, np.nan, each)


def score_per_run(score: Array, lost: Flags) -> Array:
    """Mean over instants of a score [R, S] or [R, S, K] that is small when good, over components too, for each run [R].

    Infinite for a lost run, NaN for a run without truth.
    """
    each = np.asarray(score, dtype=np.float64)
    return _with_lost(_mean(each.reshape(len(each), -1), axis=1), lost)


def nees_band(dof: int, runs: int | NDArray[np.intp], alpha: float = 0.05) -> tuple[Array, Array]:
    """Two-sided band of the NEES averaged over independent runs [Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2].

    Args:
        dof: components of the group.
        runs: number of runs averaged; any shape; 0 gives NaN.
        alpha: probability outside the band for a consistent filter.
    """
    n = np.where(np.asarray(runs) > 0, runs, np.nan)
    low, high = (stats.chi2.ppf(q, dof * n) / n for q in (alpha / 2, 1 - alpha / 2))
    return low, high


def consistency(nees: Array, lost: Flags, dof: int, alpha: float = 0.05) -> Consistency:
    """Whether the errors are as large as the filter says.

    Args:
        nees: normalised squared error of one group [R, T].
        lost: [R].
        dof: components of the group.
        alpha: probability outside the band for a consistent filter.
    """
    kept = np.asarray(nees, dtype=np.float64)[~lost]
    count = (~np.isnan(kept)).sum(axis=0)
    average = _mean(kept, axis=0)
    low, high = nees_band(dof, count, alpha)
    known = count > 0
    inside = ((average >= low) & (average <= high))[known]
    share = float(inside.mean()) if inside.size else np.nan
    return Consistency(average, low, high, count, float(_mean(kept.ravel(), axis=0)), share, _seen(kept))


def whiteness(z: Array) -> Whiteness:
    """Whether normalised residuals are white and of variance 1 [Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2].

    Args:
        z: [R, T, K], NaN where nothing was measured. Instants at which nothing was measured in any run are left out, so that
            neighbours are the next ones that were; a pair counts where both of its numbers are known.
    """
    z = np.asarray(z, dtype=np.float64)
    known = z[~np.isnan(z)]
    kept = z[:, ~np.isnan(z).all(axis=(0, 2))]
    products = kept[:, 1:] * kept[:, :-1]
    pairs = int((~np.isnan(products)).sum())
    square = float(_mean(known**2, axis=0))
    lag = float(_mean(products.ravel(), axis=0)) / square if pairs and square > 0 else np.nan
    root = 1.96 / np.sqrt(max(known.size, 1))
    beyond = float(_mean((np.abs(known) > 3).astype(np.float64), axis=0))
    band = 1.96 / np.sqrt(pairs) if pairs else np.nan
    return Whiteness(
        float(_mean(known, axis=0)), float(root), square, float(np.sqrt(2) * root), lag, float(band), beyond, known.size
    )


def over_bound(error: Array, lost: Flags, bound: Array) -> float:
    """Root of the ratio of the mean squared norm of the error to that of the bound, over the same runs and instants.

    Args:
        error: [R, T, K].
        lost: [R].
        bound: standard deviations [T, K] of the Cramer-Rao bound, which all runs share.

    Returns:
        1 for a filter that reaches the bound; NaN when no run entered.
    """
    square = _square(error)[~lost]
    floor = np.where(np.isnan(square), np.nan, _square(bound))
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt(_mean(square.ravel(), axis=0) / _mean(floor.ravel(), axis=0)))


def relative_error(error: Array, lost: Flags, distance: Array, last: int | None = None) -> Average:
    """Mean over runs and time of the norm of the error as a share of a distance.

    Args:
        error: [R, T, K]; horizontal, for a location on the ground.
        lost: [R].
        distance: [T], from the observer to the target.
        last: steps at the end that count; None is all.
    """
    norm = np.sqrt(_square(error)[~lost]) / np.asarray(distance, dtype=np.float64)
    kept = norm if last is None else norm[:, -last:]
    return Average(_mean(kept.ravel(), axis=0), _seen(kept))


def coverage_per_run(pit: Array, lost: Flags, level: float) -> Array:
    """Share of the truths in the central region of probability `level`, for each run [R]; NaN for a lost run.

    Args:
        pit: probability that the filter gives to values below the truth [R, S, K], NaN where there is no truth.
        lost: [R].
        level: 0 to 1.
    """
    pit = np.asarray(pit, dtype=np.float64)
    # Of single precision, as it is stored: a truth on the edge is inside.
    inside = np.where(np.isnan(pit), np.nan, np.abs(pit - 0.5) <= level / 2 + 1e-6)
    return np.where(lost, np.nan, _mean(inside.reshape(len(inside), -1), axis=1))


def rank_histogram(pit: Array, lost: Flags, bins: int = 10) -> Average:
    """Share of the truths in each of `bins` equal parts of probability, value [bins], each run of the same weight; flat for a
    filter that knows what it knows [Gneiting, Balabdaoui, Raftery 2007]. Other arguments as `coverage_per_run`."""
    kept = np.asarray(pit, dtype=np.float64)[~lost]
    kept = kept.reshape(len(kept), -1)
    known = ~np.isnan(kept)
    place = np.clip(np.where(known, kept, 0.0) * bins, 0, bins - 1).astype(int)
    each = np.stack([_mean(np.where(known, place == k, np.nan), axis=1) for k in range(bins)], axis=1)
    return Average(_mean(each, axis=0), int(known.any(axis=1).sum()))


def share_band(share: float, runs: int, alpha: float = 0.05) -> tuple[float, float]:
    """Two-sided binomial band of the share of `runs` independent cases that have probability `share`; NaN of none."""
    if runs < 1:
        return np.nan, np.nan
    low, high = (float(stats.binom.ppf(q, runs, share)) / runs for q in (alpha / 2, 1 - alpha / 2))
    return low, high


def lost_share(lost: Flags) -> Average:
    """Share of the runs that were lost."""
    return Average(_mean(np.asarray(lost, dtype=np.float64), axis=0), int(np.size(lost)))


def diverged(nees: Array, dofs: Sequence[int], lost: Flags, factor: float = 100.0) -> NDArray[np.bool_]:
    """Runs that were not lost but whose filter no longer knows where it is [R].

    A run has diverged when the mean over time of the normalised squared error of some group exceeds `factor` times its degrees
    of freedom: an error of ten of the filter's own standard deviations, on the average of the whole run [ours].

    Args:
        nees: [R, T, G].
        dofs: degrees of freedom of each group [G].
        lost: [R].
    """
    with np.errstate(over="ignore"):
        mean = _mean(np.asarray(nees, dtype=np.float64), axis=1)
    return (mean > factor * np.asarray(dofs, dtype=np.float64)).any(axis=-1) & ~np.asarray(lost, dtype=bool)


def convergence_time(time: Array, error: Array, lost: Flags, bound: float) -> Array:
    """First instant from which on the norm of the error stays at or below `bound`, for each run [R].

    Args:
        time: seconds [T].
        error: [R, T, K].
        lost: [R].
        bound: in the unit of the error.

    Returns:
        Seconds [R]; infinite when the last known error is above the bound or the run was lost, NaN without truth.
    """
    norm = np.sqrt(_square(error))
    known = ~np.isnan(norm)
    # The last violation counts backwards from the end; the answer is the first known instant after it.
    after = ~np.logical_or.accumulate((norm > bound)[:, ::-1], axis=1)[:, ::-1] & known
    first = np.where(after.any(axis=1), np.asarray(time, dtype=np.float64)[after.argmax(axis=1)], np.inf)
    return _with_lost(np.where(known.any(axis=1), first, np.nan), lost)


def _square(error: Array) -> Array:
    # In double precision: float32 overflows where a diverged filter is squared.
    return np.sum(np.asarray(error, dtype=np.float64) ** 2, axis=-1)


def _mean(values: Array, axis: int) -> Array:
    """Mean of what is not NaN, NaN where there is nothing; numpy's nanmean warns there."""
    known = ~np.isnan(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _seen(values: Array) -> int:
    return int((~np.isnan(values)).any(axis=1).sum())


def _with_lost(each: Array, lost: Flags) -> Array:
    return np.where(lost, np.inf, each)
