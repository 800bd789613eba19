"""Errors of a program in the epochs that it leaves out although another program has them.

The error in a hole is the largest one of any program in the sequence, so that a program which leaves out
its bad epochs gains nothing [ours].
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pfbench.results.error_measures import Array
from pfbench.results.store import JobResult

_GAP_STEPS = 1.5


def is_in_hole(time: Array, grid: Array) -> np.ndarray:
    """Return the epochs of a grid that lie in a hole of a trajectory, before it or after it.

    A gap of more than 1.5 steps between two rows is a hole. Half of it, 0.75 steps, counts before the
    first row and after the last one, where the next row may still be due.

    Args:
        time: Times of the trajectory, [K], s.
        grid: Epochs, [T], s.

    Returns:
        Mask, [T].
    """
    if len(time) < 2:
        return np.zeros(len(grid), dtype=bool)
    limit = _GAP_STEPS * float(np.median(np.diff(time)))
    right = np.searchsorted(time, grid)
    inner = np.clip(right, 1, len(time) - 1)
    is_outside = (grid < time[0] - limit / 2) | (grid > time[-1] + limit / 2)
    is_between = (right > 0) & (right < len(time))
    return np.asarray(is_outside | (is_between & (time[inner] - time[inner - 1] > limit)))


def fill_holes(results: Mapping[str, JobResult], holes: Mapping[str, np.ndarray]) -> None:
    """Set the errors in holes to the largest error of any program, in place.

    Args:
        results: Results by program, see `SequenceResults`. The CRPS in a hole is that of an estimate
            without spread, and NEES and PIT are NaN.
        holes: Holes of the runs by program, [R, T].
    """
    groups = {name for result in results.values() for name in result.meta["state"]["groups"]}
    for group in groups:
        norms = {
            program: np.where(holes[program], np.nan, _norm(result, group))
            for program, result in results.items()
            if group in result.meta["state"]["groups"]
        }
        finite = np.concatenate([norm[np.isfinite(norm)] for norm in norms.values()])
        largest = float(finite.max()) if finite.size else math.nan
        for program in norms:
            _fill_group(results[program], holes[program], group, largest)


def _norm(result: JobResult, group: str) -> Array:
    """Return the norm of the error of a group, [R, T]."""
    indices = list(result.meta["state"]["groups"][group])
    return np.asarray(np.linalg.norm(result.data["error"][..., indices], axis=-1))


def _fill_group(result: JobResult, holes: np.ndarray, group: str, norm: float) -> None:
    """Set the error of a group in holes to a norm, with equal components."""
    runs, times = np.nonzero(holes)
    names = list(result.meta["state"]["groups"])
    indices = result.meta["state"]["groups"][group]
    component = norm / math.sqrt(len(indices))
    result.data["nees"][runs, times, names.index(group)] = np.nan
    for index in indices:
        result.data["error"][runs, times, index] = component
        if "crps" in result.data:
            result.data["crps"][runs, times, index] = component
            result.data["pit"][runs, times, index] = np.nan
