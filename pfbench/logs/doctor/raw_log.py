"""Tables of a log as recorded, before any check refuses them: forward-right-down axes and North-East-Down frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pfbench.files.table_file import Array

Rows = NDArray[np.intp]
Table = TypeVar("Table", "RawImu", "RawFixes", "RawReference")


class RawImu(NamedTuple):
    """IMU samples: times, s, [n], specific force, m/s^2, and angular rate, rad/s, [n, 3]."""

    time: Array
    force: Array
    rate: Array
    rows: Rows


class RawFixes(NamedTuple):
    """Fixes: times, s, [m], and positions, m, [m, 3]."""

    time: Array
    position: Array
    rows: Rows


class RawReference(NamedTuple):
    """Reference: times, s, [k], roll, pitch, yaw, rad, velocities, m/s, and positions, m, [k, 3]."""

    time: Array
    angles: Array
    velocity: Array
    position: Array
    rows: Rows


class RawLog(NamedTuple):
    """Log before its checks.

    Attributes:
        imu: IMU samples.
        fixes: Fixes to use.
        reference: Reference motion.
        gravity: Gravity, m/s^2.
        names: Names of the three tables.
        describe_row: Position of a row in the file of each table.
        codes: Number of fixes by code, if the column `fix` is not stated by `fix_codes`.
    """

    imu: RawImu
    fixes: RawFixes
    reference: RawReference
    gravity: float
    names: tuple[str, str, str]
    describe_row: tuple[Callable[[int], str], ...]
    codes: Array | None = None

    def row(self, table: int, i: int) -> str:
        """Describe the position of row i of table 0 (imu), 1 (gnss) or 2 (reference)."""
        parts: tuple[RawImu | RawFixes | RawReference, ...] = (
            self.imu,
            self.fixes,
            self.reference,
        )
        return self.describe_row[table](int(parts[table].rows[i]))


def take_rows(table: Table, rows: Any) -> Table:
    """Return a table with some of its rows, in the given order.

    Args:
        table: IMU samples, fixes or reference.
        rows: Indices or a mask.

    Returns:
        The rows.
    """
    return type(table)(*(column[rows] for column in table))


_NO_ROWS = np.empty((0, 3))
NO_IMU = RawImu(np.empty(0), _NO_ROWS, _NO_ROWS, np.empty(0, np.intp))
NO_REFERENCE = RawReference(np.empty(0), _NO_ROWS, _NO_ROWS, _NO_ROWS, np.empty(0, np.intp))


def dcm_of(angles: Array) -> Array:
    """Return rotations from the body to the level frame, [k, 3, 3], of roll, pitch, yaw, rad, [k, 3]."""
    return Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()


def correlate_neighbours(residual: Array) -> float:
    """Return the mean correlation of neighbouring residuals, 0 to 0.98. Shapes: residual [n, k]."""
    deviation = residual - residual.mean(0)
    square = np.square(deviation).sum(0)
    pairs = (deviation[1:] * deviation[:-1]).sum(0) / np.maximum(square, 1e-300)
    return float(np.clip(pairs, 0.0, 0.98).mean())


def interpolate_columns(at: Array, time: Array, values: Array) -> Array:
    """Interpolate columns linearly, with the first and the last row outside of them.

    The rows are found once for all columns: `numpy.interp` copies each column, an hour of samples for a few nodes.

    Args:
        at: Times, [m].
        time: Times of the rows, [n].
        values: Rows, [n, k].

    Returns:
        Values, [m, k].
    """
    inside = (at >= time[0]) & (at < time[-1])
    out = np.where((at < time[0])[:, None], values[0], values[-1])
    out[np.isnan(at)] = np.nan
    row = np.searchsorted(time, at[inside], side="right") - 1
    slope = (values[row + 1] - values[row]) / (time[row + 1] - time[row])[:, None]
    out[inside] = slope * (at[inside] - time[row])[:, None] + values[row]
    return out
