"""Offset of the clock of a table against the reference: the lag at which both show the same motion.

A lag is named only if it explains the data much better than no lag. Motion that a lag does not
change, such as a straight drive at constant speed, shows none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pfbench.core import chart
from pfbench.files.table_file import Array
from pfbench.logs.worlds.log_tables import GnssLog, ImuLog, ReferenceLog
from pfbench.nav import attitude

LARGEST_LAG = 25.0  # s; more than the leap seconds
LEAST_IMU_LAG, LEAST_FIX_LAG = 0.05, 0.15  # s; clean logs: at most 0.011 and 0.09
EVIDENCE = 25.0  # log-likelihood ratio of a lag against none, five standard errors squared [ours]
_LEAST_CORRELATION = 0.8  # of the turns at the lag
LEAP_SECONDS = 18.0  # s; GPS time minus UTC since 2017
_WINDOW = 0.5  # s; turns are compared over windows of this length
_FEWEST, _LEAST_SHARE = 12, 0.4  # compared rows
_MOST = 500  # compared fixes, about evenly chosen from a longer log
_GRID = np.unique(
    np.round(np.r_[np.arange(-LARGEST_LAG, LARGEST_LAG, 0.25), np.arange(-1.5, 1.5, 0.05)], 3)
)


class ClockOffset(NamedTuple):
    """Offset of a clock.

    Attributes:
        late_s: Delay of t against the reference, s.
        agreement: What agrees better with the offset than without.
    """

    late_s: float
    agreement: str

    def describe(self, name: str, reference: str) -> str:
        """Return a note with the change that removes the offset."""
        size, is_late = abs(self.late_s), self.late_s > 0.0
        is_leap = abs(size - LEAP_SECONDS) < 0.1
        size = LEAP_SECONDS if is_leap else size
        change = f"Subtract {size:.2f} from" if is_late else f"Add {size:.2f} to"
        leap = " (leap seconds between UTC and GPS time)" if is_leap else ""
        return (
            f"{name}: t is {size:.2f} s {'late' if is_late else 'early'} against {reference}{leap}: "
            f"{self.agreement}. {change} t of {name} if the tables should have one clock"
        )


def find_imu_offset(imu: ImuLog, reference: ReferenceLog) -> ClockOffset | None:
    """Find the lag at which the integrated angular rate turns as the reference."""
    time, true = _reference_turns(reference)
    step = np.diff(time)
    short = step < max(1.6 * _WINDOW, 2.5 * float(np.median(step))) if len(step) else step > 0.0
    summed = np.cumsum(0.5 * np.diff(imu.time)[:, None] * (imu.rate[1:] + imu.rate[:-1]), axis=0)
    columns = np.ascontiguousarray(np.vstack([np.zeros(3), summed]).T)  # numpy.interp copies others

    def unexplained(lag: float) -> tuple[float, int]:
        at = time + lag
        used = short & (at[:-1] >= imu.time[0]) & (at[1:] <= imu.time[-1])
        if used.sum() < max(_FEWEST, _LEAST_SHARE * short.sum()):
            return 1.0, 0
        turned = np.diff(np.stack([np.interp(at, imu.time, a) for a in columns], -1), axis=0)
        x, y = true[used] - true[used].mean(0), turned[used] - turned[used].mean(0)
        square = float((x * x).sum() * (y * y).sum())
        if not square > 0.0:
            return 1.0, 0
        correlation = float((x * y).sum()) / math.sqrt(square)
        return max(0.0, 1.0 - max(correlation, 0.0) ** 2), int(used.sum())

    lag = _best_lag(unexplained)
    best, count = unexplained(lag)
    plain = unexplained(0.0)[0]
    evidence = count * math.log(max(plain, 1e-12) / max(best, 1e-12))
    if abs(lag) < LEAST_IMU_LAG or best > 1.0 - _LEAST_CORRELATION**2 or evidence < EVIDENCE:
        return None
    correlations = (math.sqrt(1.0 - value) for value in (best, plain))
    return ClockOffset(
        lag, "turns then correlate to {:.3f} instead of {:.3f}".format(*correlations)
    )


def _reference_turns(reference: ReferenceLog) -> tuple[Array, Array]:
    """Return times about a window apart, s, [n + 1], and the rotation vectors between them, rad, [n, 3]."""
    nodes = _thin(reference.time, _WINDOW)
    q = torch.from_numpy(reference.attitude[nodes])
    inverse = q[:-1] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    turn = chart.quaternion_multiply(inverse, q[1:])
    return reference.time[nodes], chart.rotation_vector_from_quaternion(turn).numpy()


def find_fix_offset(fixes: GnssLog, reference: ReferenceLog) -> ClockOffset | None:
    """Find the lag at which the fixes move as the reference, up to a constant and a lever arm."""
    rows = np.flatnonzero(np.isfinite(fixes.position[:, 0]))
    rows = rows[:: max(1, len(rows) // _MOST)]
    time, position = fixes.time[rows], fixes.position[rows]

    def difference(lag: float) -> tuple[Array, NDArray[np.bool_]]:
        at = time - lag
        inside = (at >= reference.time[0]) & (at <= reference.time[-1])
        true = np.stack([np.interp(at, reference.time, a) for a in reference.position.T], -1)
        return position - true, inside

    def spread(lag: float) -> tuple[float, int]:
        error, inside = difference(lag)
        if inside.sum() < max(_FEWEST, _LEAST_SHARE * len(time)):
            return math.inf, 0
        level = error[inside, :2]
        return float(np.median(np.linalg.norm(level - np.median(level, 0), axis=1))), int(
            inside.sum()
        )

    coarse = _best_lag(spread)
    is_found = math.isfinite(spread(coarse)[0])
    fit = _fit_lag(time - coarse, *difference(coarse), reference) if is_found else None
    if fit is None:
        return None
    lag = coarse + fit[0]
    after, before = spread(lag)[0], spread(0.0)[0]
    if abs(lag) < max(LEAST_FIX_LAG, math.sqrt(EVIDENCE) * fit[1]) or not after < before:
        return None
    instead = f" instead of {before:.3g} m" if math.isfinite(before) else ""
    return ClockOffset(lag, f"positions then agree to {after:.3g} m{instead}")


def _fit_lag(
    at: Array, error: Array, inside: NDArray[np.bool_], reference: ReferenceLog
) -> tuple[float, float] | None:
    """Fit lag, lever arm and constant offset to differences [n, 3]; return the lag and its standard error, s."""
    at, error = at[inside], error[inside]
    off = np.linalg.norm(error - np.median(error, 0), axis=1)
    usual = off <= 5.0 * np.median(off) + 0.5  # m; without reflections
    at, error = at[usual], error[usual]
    if len(at) < _FEWEST:
        return None
    velocity = np.stack([np.interp(at, reference.time, a) for a in reference.velocity.T], -1)
    near = np.searchsorted(reference.time, at).clip(max=len(reference.time) - 1)
    axes = attitude.dcm_from_quaternion(torch.from_numpy(reference.attitude[near])).numpy()
    unit = np.broadcast_to(np.eye(3), axes.shape)
    others = np.concatenate([axes, unit], -1).reshape(-1, 6)
    # what only a lag explains, of the motion and of the differences
    motion, rest = (
        a - others @ np.linalg.lstsq(others, a, rcond=1e-9)[0]
        for a in (-velocity.reshape(-1), error.reshape(-1))
    )
    square = float(motion @ motion)
    if square < 1e-12 * float((velocity * velocity).sum()):
        return None
    lag = float(motion @ rest) / square
    rest = (rest - lag * motion).reshape(-1, 3)
    neighbours = float((rest[1:] * rest[:-1]).sum() / max((rest * rest).sum(), 1e-12))
    memory = min(max(neighbours, 0.0), 0.99)  # errors of receivers last longer than a fix
    variance = float((rest * rest).sum()) / max(3 * len(at) - 7, 1)
    return lag, math.sqrt(variance / square * (1.0 + memory) / (1.0 - memory))


def _best_lag(misfit: Callable[[float], tuple[float, int]]) -> float:
    """Return the lag of the least misfit, and of the shortest lag if periodic motion has several."""
    values = np.array([misfit(float(lag))[0] for lag in _GRID])
    least = float(values.min())
    if not math.isfinite(least):
        return 0.0
    inner = np.r_[
        values[:1], np.minimum(values[1:-1], np.minimum(values[:-2], values[2:])), values[-1:]
    ]
    is_minimum = (values <= inner) & (values <= 1.2 * least + 1e-6)
    start = float(min(_GRID[is_minimum], key=abs))
    fine = start + np.arange(-0.3, 0.301, 0.02)
    near = np.array([misfit(float(lag))[0] for lag in fine])
    i = int(np.clip(near.argmin(), 1, len(near) - 2))
    bend = near[i - 1] - 2.0 * near[i] + near[i + 1]
    if not (math.isfinite(bend) and bend > 0.0):
        return float(fine[i])
    return float(fine[i] + 0.01 * (near[i - 1] - near[i + 1]) / bend)


def _thin(time: Array, interval: float) -> NDArray[np.intp]:
    """Return rows that are about an interval apart or more."""
    window = np.floor((time - time[0]) / interval + 1e-9)
    return np.flatnonzero(np.diff(window, prepend=-1.0) > 0.0)
