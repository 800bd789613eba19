"""Scale of one table against another. A wrong unit changes all rows alike, so that single rows look right."""

from __future__ import annotations

import math

import numpy as np

from pfbench.scenario.plausibility.log_table import LogTable
from pfbench.scenario.recorded.log_tables import Array

WINDOW = 1.0  # s; tables are compared over windows of about this length
MIN_RMS_SPEED = 1.0  # m/s; smallest RMS velocity at which position and velocity have a common scale
MIN_RMS_TURN = 0.03  # rad; smallest RMS rotation in a window, about its mean, that shows a scale
FEWEST_WINDOWS = 5  # for a scale
CORRELATED = 0.95  # least correlation of a slow axis, whose slope noise reduces to 0.9 at most
SCALES = (0.7, 1.4)  # least and largest scale of one table against another


def check_position_scale(table: LogTable, time: Array, expected: Array, displacement: Array) -> None:  # fmt: skip
    """Check that displacements have the scale of the integrated velocities.

    A slow axis is judged only if both are correlated, since noise of the velocity reduces the slope.

    Args:
        table: Table of the reference, for messages.
        time: Times of the rows, s, [n + 1].
        expected: Integrated velocities, m, [n, 3].
        displacement: Changes of position, m, [n, 3].

    Raises:
        ValueError: If an axis has another scale.
    """
    window = ((time[1:] - time[0]) / WINDOW - 1e-9).astype(int)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    speeds = np.sqrt(np.square(expected / np.diff(time)[:, None]).mean(0))
    for axis, name in enumerate(("East", "North", "Up")):
        x, y = expected[:, axis], displacement[:, axis]
        if speeds[axis] < MIN_RMS_SPEED:
            x, y = np.add.reduceat(x, starts), np.add.reduceat(y, starts)
            if len(x) < FEWEST_WINDOWS or not _is_correlated(x, y):
                continue
        slope = float((x * y).sum() / (x * x).sum())
        if not SCALES[0] < slope < SCALES[1]:
            raise ValueError(
                f"{table.name}: the {name} position must change with the velocity, got {slope:.3g} "
                "times the change. Check units (m, m/s, deg), signs and order of the columns."
            )


def _is_correlated(x: Array, y: Array) -> bool:
    square = float((x * x).sum()) * float((y * y).sum())
    return abs(float((x * y).sum())) > CORRELATED * math.sqrt(square)


def check_turn_scale(table: LogTable, x: Array, y: Array, window: float) -> None:
    """Check that rotations of the reference have the scale of those of the IMU.

    Args:
        table: Table of the reference, for messages.
        x: Rotations of the IMU in each window, rad, [n, 3].
        y: Rotations of the reference, rad, [n, 3].
        window: Typical length of the windows, s.

    Raises:
        ValueError: If an axis has another scale.
    """
    if len(x) < FEWEST_WINDOWS or window < 0.5 * WINDOW:
        return  # between neighbouring rows, noise has a larger part
    x, y = x - x.mean(0), y - y.mean(0)  # without the bias of the gyroscope
    for axis, name in enumerate(("x", "y", "z")):
        square = float((x[:, axis] ** 2).sum())
        if np.sqrt(square / len(x)) < MIN_RMS_TURN:
            continue
        slope = float((x[:, axis] * y[:, axis]).sum()) / square
        if not SCALES[0] < slope < SCALES[1]:
            raise ValueError(
                f"{table.name}: the attitude must turn with the angular rate about {name}, got "
                f"{slope:.3g} times the rotation. Check units (rad, rad/s), signs and axes."
            )
