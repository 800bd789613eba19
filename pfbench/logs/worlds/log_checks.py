"""Checks of the times of two tables, of positions that are given twice, and of wheels."""

from __future__ import annotations

import numpy as np
import torch

from pfbench.logs.worlds.log_tables import Array, LogTable, parse_numbers
from pfbench.logs.worlds.time_order import find_overlap_remedy
from pfbench.nav import earth

STANDARD_GRAVITY = 9.80665


def check_overlap(imu_name: str, imu_time: Array, name: str, time: Array) -> None:
    """Check that two tables have a common time.

    Shapes: imu_time [n], time [m].
    """
    if min(imu_time[-1], time[-1]) <= max(imu_time[0], time[0]):
        raise ValueError(
            f"{imu_name} and {name} must overlap in time, got t = {imu_time[0]:.3f} to "
            f"{imu_time[-1]:.3f} and t = {time[0]:.3f} to {time[-1]:.3f}. "
            f"{find_overlap_remedy(time, imu_time, name)}"
        )


_GEOCENTRIC, _GEODETIC = ("x", "y", "z"), ("lat_deg", "lon_deg", "h_m")
SAME_POSITION = 1.0  # m; difference of two forms of one position, for rounded degrees
_BRAKING, _SLOW = 10.0, 1.0  # m/s^2, hard braking on a road; m/s, noise of the wheels about zero


def check_geocentric(table: LogTable) -> None:
    """Check that Earth-fixed and geodetic positions are the same, if a table has both."""
    if not table.has(_GEOCENTRIC):
        return
    geodetic = parse_numbers(table, _GEODETIC) * [np.pi / 180, np.pi / 180, 1.0]
    expected = earth.ecef(torch.from_numpy(geodetic)).numpy()
    difference = np.linalg.norm(parse_numbers(table, _GEOCENTRIC) - expected, axis=1)
    i = int(np.argmax(difference))
    if difference[i] > SAME_POSITION:
        raise ValueError(
            f"{table.name}: x, y, z and lat_deg, lon_deg, h_m must be the same position within "
            f"{SAME_POSITION:g} m, got {difference[i]:.3g} m in {table.row(i)}. "
            "Correct the wrong columns, or remove x, y, z."
        )


def check_wheel_direction(table: LogTable, time: Array, speed: Array) -> tuple[str, ...]:
    """Check that the wheels stop before they reverse.

    The reference velocity of a road vehicle does not show whether it moves backwards.

    Returns a note if most of the drive is backwards. Shapes: time [T], speed [T].
    """
    change, largest = np.abs(np.diff(speed)), 2.0 * _SLOW + _BRAKING * np.diff(time)
    wrong = np.flatnonzero((speed[1:] * speed[:-1] < 0.0) & (change > largest))
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(
            f"{table.name}: column v_fwd must change its sign near zero, got {speed[i + 1]:g} m/s "
            f"after {speed[i]:g} m/s in {table.row(i + 1)} ({wrong.size} such rows). "
            "Correct the sign or remove this row."
        )
    moving = np.abs(speed) > _SLOW
    backwards = int((speed < -_SLOW).sum())
    if 2 * backwards <= int(moving.sum()):
        return ()
    return (
        f"{table.name}: the wheels turn backwards in {backwards} of {int(moving.sum())} moving rows. "
        "Check the sign of v_fwd",
    )
