"""Error measures of a filter on arrays with leading axes [R, T]: R runs, T time steps.

Errors are estimate minus truth, NaN without truth (runs of unequal length are padded with NaN). A
step at which any component is NaN is left out. The error of a lost run is infinite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array as Array

Flags = NDArray[np.bool_]


def rmse_per_run(error: Array, lost: Flags) -> Array:
    """Compute the root mean square over time of the norm of the error, for each run.

    Returns RMSE, [R]; infinite for a lost run, NaN for a run without truth. Shapes: error
    [R, T, K], lost [R].
    """
    return _set_lost(np.sqrt(finite_mean(_squared_norm(error), axis=1)), lost)


def max_error(error: Array, lost: Flags) -> Array:
    """Compute the maximum norm over time of each run [R], infinite if lost.

    Shapes: error [R, T, K], lost [R].
    """
    square = _squared_norm(error)
    largest = np.max(np.where(np.isnan(square), -np.inf, square), axis=1, initial=-np.inf)
    return _set_lost(np.sqrt(np.where(largest < 0, np.nan, largest)), lost)


def mean_per_run(trace: Array, lost: Flags) -> Array:
    """Average a trace, such as ESS or NEES, over time.

    Returns means, [R]; NaN for a lost run. Shapes: trace [R, T], lost [R].
    """
    return np.where(lost, np.nan, finite_mean(np.asarray(trace, dtype=np.float64), axis=1))


def mean_score_per_run(score: Array, lost: Flags) -> Array:
    """Average a negatively oriented score over steps and components, for each run.

    Returns mean score, [R]; infinite for a lost run, NaN for a run without truth. Shapes: score
    [R, S], lost [R].
    """
    values = np.asarray(score, dtype=np.float64)
    return _set_lost(finite_mean(values.reshape(len(values), -1), axis=1), lost)


def convergence_time(time: Array, error: Array, lost: Flags, bound: float) -> Array:
    """Find the first step from which on the norm of the error stays at or below a bound.

    Returns seconds, [R]; infinite if the last error exceeds the bound or the run was lost, NaN
    without truth. Shapes: time [T], error [R, T, K], lost [R].
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
    """Average the values that are not NaN; NaN without values, where nanmean would warn."""
    valid = ~np.isnan(values)
    count = valid.sum(axis=axis)
    total = np.where(valid, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _squared_norm(error: Array) -> Array:
    """Sum the squares of the components, in float64 since float32 overflows."""
    return np.sum(np.asarray(error, dtype=np.float64) ** 2, axis=-1)


def _set_lost(values: Array, lost: Flags) -> Array:
    """Set the value of lost runs to infinity."""
    return np.where(lost, np.inf, values)
