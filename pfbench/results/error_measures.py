"""Error measures of a filter on arrays with leading axes [R, T]: R runs, T time steps.

Three quantities are called RMSE in the literature, and each has its own name here. Errors are
estimate minus truth, NaN without truth (runs of unequal length are padded with NaN). A
step at which any component is NaN is left out. Averages exclude lost runs and state how many runs
they include. The error of a lost run is infinite.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class RunMean(NamedTuple):
    """Average over runs.

    Attributes:
        value: Average, or one per component [K]; NaN without runs.
        runs: Number of runs included. The others are lost or without truth.
    """

    value: Array
    runs: int


def rmse_per_run(error: Array, lost: Flags) -> Array:
    """Compute the root mean square over time of the norm of the error, for each run.

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].

    Returns:
        RMSE, [R]; infinite for a lost run, NaN for a run without truth.
    """
    return _set_lost(np.sqrt(finite_mean(_squared_norm(error), axis=1)), lost)


def rmse_run_mean(error: Array, lost: Flags) -> RunMean:
    """Average the RMSE of each run over runs.

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
    """
    by_run = rmse_per_run(error, lost)
    used = ~np.isnan(by_run) & ~np.asarray(lost, dtype=bool)
    return RunMean(finite_mean(by_run[used], axis=0), int(used.sum()))


def rmse_norm(error: Array, lost: Flags) -> RunMean:
    """Compute the root mean square over runs and time of the norm.

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
    """
    square = _squared_norm(error)[~lost]
    return RunMean(np.sqrt(finite_mean(square.ravel(), axis=0)), count_runs(square))


def rmse_component(error: Array, lost: Flags) -> RunMean:
    """Compute the root mean square over runs and time of each component, value [K].

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
    """
    valid = np.asarray(error, dtype=np.float64)[~lost]
    square = np.where(np.isnan(_squared_norm(valid))[..., None], np.nan, valid**2)
    mean = finite_mean(square.reshape(-1, valid.shape[-1]), axis=0)
    return RunMean(np.sqrt(mean), count_runs(square[..., 0]))


def max_error(error: Array, lost: Flags) -> Array:
    """Compute the maximum norm over time of each run [R], infinite if lost.

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
    """
    square = _squared_norm(error)
    largest = np.max(np.where(np.isnan(square), -np.inf, square), axis=1, initial=-np.inf)
    return _set_lost(np.sqrt(np.where(largest < 0, np.nan, largest)), lost)


def mean_per_run(trace: Array, lost: Flags) -> Array:
    """Average a trace, such as ESS or NEES, over time.

    Args:
        trace: Values, [R, T].
        lost: Lost runs, [R].

    Returns:
        Means, [R]; NaN for a lost run.
    """
    return np.where(lost, np.nan, finite_mean(np.asarray(trace, dtype=np.float64), axis=1))


def mean_score_per_run(score: Array, lost: Flags) -> Array:
    """Average a negatively oriented score over steps and components, for each run.

    Args:
        score: Scores, [R, S] or [R, S, K].
        lost: Lost runs, [R].

    Returns:
        Mean score, [R]; infinite for a lost run, NaN for a run without truth.
    """
    values = np.asarray(score, dtype=np.float64)
    return _set_lost(finite_mean(values.reshape(len(values), -1), axis=1), lost)


def rmse_to_pcrb(error: Array, lost: Flags, bound: Array) -> float:
    """Compute the ratio of the RMSE of the norm to the posterior Cramér-Rao bound.

    Args:
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
        bound: Standard deviations of the bound, [T, K], equal for all runs.

    Returns:
        1 for a filter that attains the bound, NaN without runs.
    """
    square = _squared_norm(error)[~lost]
    bound_square = np.where(np.isnan(square), np.nan, _squared_norm(bound))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = finite_mean(square.ravel(), axis=0) / finite_mean(bound_square.ravel(), axis=0)
        return float(np.sqrt(ratio))


def relative_error(error: Array, lost: Flags, distance: Array, last: int | None = None) -> RunMean:
    """Average the norm of the error, divided by a distance, over runs and time.

    Args:
        error: Horizontal components of a location, [R, T, K].
        lost: Lost runs, [R].
        distance: Distance from the observer to the target, [T].
        last: Number of final steps included; None for all.

    Returns:
        Mean relative error.
    """
    norm = np.sqrt(_squared_norm(error)[~lost]) / np.asarray(distance, dtype=np.float64)
    used = norm if last is None else norm[:, -last:]
    return RunMean(finite_mean(used.ravel(), axis=0), count_runs(used))


def convergence_time(time: Array, error: Array, lost: Flags, bound: float) -> Array:
    """Find the first step from which on the norm of the error stays at or below a bound.

    Args:
        time: Time of the steps, [T], in seconds.
        error: Components of one group, [R, T, K].
        lost: Lost runs, [R].
        bound: Bound in the unit of the error.

    Returns:
        Seconds, [R]; infinite if the last error exceeds the bound or the run was lost, NaN
        without truth.
    """
    norm = np.sqrt(_squared_norm(error))
    has_truth = ~np.isnan(norm)
    # The last violation counts backwards from the end; the answer is the first step after it.
    violated = np.logical_or.accumulate((norm > bound)[:, ::-1], axis=1)[:, ::-1]
    settled = ~violated & has_truth
    when = np.asarray(time, dtype=np.float64)[settled.argmax(axis=1)]
    first = np.where(settled.any(axis=1), when, np.inf)
    return _set_lost(np.where(has_truth.any(axis=1), first, np.nan), lost)


def finite_mean(values: Array, axis: int) -> Array:
    """Average the values that are not NaN; NaN without values, where nanmean would warn.

    Args:
        values: Values of any shape.
        axis: Axis of the average.
    """
    valid = ~np.isnan(values)
    count = valid.sum(axis=axis)
    total = np.where(valid, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def count_runs(values: Array) -> int:
    """Count the runs of an array [R, T] that have any value."""
    return int((~np.isnan(values)).any(axis=1).sum())


def _squared_norm(error: Array) -> Array:
    """Sum the squares of the components, in float64 since float32 overflows."""
    return np.sum(np.asarray(error, dtype=np.float64) ** 2, axis=-1)


def _set_lost(values: Array, lost: Flags) -> Array:
    """Set the value of lost runs to infinity."""
    return np.where(lost, np.inf, values)
