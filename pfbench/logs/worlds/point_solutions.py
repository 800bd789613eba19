"""Position and velocity of each epoch from its ranges and rates alone, for a log without a reference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from pfbench.logs.sky.raw_gnss import RawGnssTuning
from pfbench.logs.worlds.log_tables import Array
from pfbench.logs.worlds.raw_gnss import RawGnssLog, list_other_system

_STEPS = 8  # of Gauss and Newton; the first start can be kilometres away
_LARGEST_SD = 100.0  # m; the satellites of an epoch beyond do not show a position


class PointSolutions(NamedTuple):
    """Solutions of epochs, East, North, Up; NaN where the satellites do not show a position.

    Attributes:
        position: Positions, m, [K, 3].
        position_sd: Their standard deviations, m, [K, 3].
        velocity: Velocities, m/s, [K, 3]; NaN without enough rates.
    """

    position: Array
    position_sd: Array
    velocity: Array


def solve_points(log: RawGnssLog, tuning: RawGnssTuning, start: Array) -> PointSolutions:
    """Solve each epoch by weighted least squares for position and clock, and then for velocity and drift.

    Args:
        log: Ranges and rates.
        tuning: Standard deviations of the measurements.
        start: Positions from which the search begins, m, [K, 3].

    Returns:
        Solutions.
    """
    sd = tuning.range.sd(torch.from_numpy(log.range_sd)).numpy()
    rate_sd = tuning.rate.sd(torch.from_numpy(log.rate_sd)).numpy()
    solutions = PointSolutions(*(np.full((len(log.range), 3), np.nan) for _ in range(3)))
    for k in range(len(log.range)):
        epoch = _solve_epoch(log, k, start[k], (sd[k], rate_sd[k]))
        if epoch is not None:
            for values, value in zip(solutions, epoch, strict=True):
                values[k] = value
    return solutions


def _solve_epoch(
    log: RawGnssLog, k: int, start: Array, sds: tuple[Array, Array]
) -> tuple[Array, Array, Array] | None:
    """Return position, its standard deviations and velocity of an epoch; None if the satellites do not show them.

    Shapes: start [3], sds [S] of ranges and of rates.
    """
    used = np.isfinite(log.range[k] + sds[0])
    is_second = list_other_system(log.names).astype(float)[used]
    columns = np.column_stack([np.ones(used.sum()), is_second])
    columns = columns if len(np.unique(is_second)) == 2 else columns[:, :1]
    if used.sum() < 3 + columns.shape[1]:
        return None
    at = start.copy()
    for _ in range(_STEPS):
        sight = log.satellite_position[k, used] - at
        reach = np.linalg.norm(sight, axis=1)
        line = sight / reach[:, None]
        step, variance = _solve(
            np.hstack([-line, columns]), log.range[k, used] - reach, sds[0][used]
        )
        at += step[:3]
    if not np.sqrt(variance[:3].sum()) < _LARGEST_SD:
        return None
    velocity = np.full(3, np.nan)
    approach = log.rate[k, used] - (line * log.velocity[k, used]).sum(1)
    fast = np.isfinite(approach + sds[1][used])
    if fast.sum() >= 4:
        design = np.hstack([-line, columns[:, :1]])[fast]
        velocity = _solve(design, approach[fast], sds[1][used][fast])[0][:3]
    return at, np.sqrt(variance[:3]), velocity


def _solve(design: Array, values: Array, sd: Array) -> tuple[Array, Array]:
    """Return the weighted solution and its variances; infinite ones if the design does not show it."""
    whitened = design / sd[:, None]
    normal = whitened.T @ whitened
    if np.linalg.cond(normal) > 1e14:
        return np.zeros(design.shape[1]), np.full(design.shape[1], np.inf)
    inverse = np.linalg.inv(normal)
    return inverse @ (whitened.T @ (values / sd)), np.diag(inverse)
