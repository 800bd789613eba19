"""Reader of recorded logs with checks of units, axes, times and gaps.

Files use the axes forward-right-down and North-East-Down, as public data sets do. The reader
converts them to right-forward-up and East-North-Up. A log consists of three tables with named
columns, each a Parquet or a CSV file:

    imu        t [s], fx, fy, fz [m/s^2] (about -9.8 on z when level), wx, wy, wz [rad/s]
    gnss       t, and lat_deg, lon_deg, h_m or pn, pe, pd [m]; optional vn, ve, vd [m/s];
               optional fix (1: use the fix, other values: missing)
    reference  t, pn, pe, pd (or lat_deg, lon_deg, h_m), vn, ve, vd, roll, pitch, yaw [rad]

A table can contain several flights and sensors. The columns `path` and `imu` identify them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pfbench.core import quaternion
from pfbench.nav import attitude, earth
from pfbench.scenario.recorded.log_tables import (
    Array,
    LogTable,
    check_increasing,
    check_seconds,
    parse_numbers,
    read_table,
    read_times,
)

STANDARD_GRAVITY = 9.80665
_DEGREE = math.pi / 180.0
_GEODETIC, _LOCAL = ("lat_deg", "lon_deg", "h_m"), ("pn", "pe", "pd")
_VELOCITY, _DERIVED = ("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d")
_MAX_RATE = 35.0  # rad/s: the range of the fastest common MEMS gyros, 2000 deg/s
_MAX_GAP = 0.1  # s; longest interval between samples


class ImuLog(NamedTuple):
    """IMU samples in body axes right, forward, up.

    Attributes:
        time: Times, s, [n].
        force: Specific force, m/s^2, [n, 3].
        rate: Angular rate, rad/s, [n, 3].
    """

    time: Array
    force: Array
    rate: Array


class GnssLog(NamedTuple):
    """Fixes in East, North, Up. Missing values are NaN.

    Attributes:
        time: Times, s, [m].
        position: Positions, m, [m, 3].
        velocity: Velocities, m/s, [m, 3]. All NaN if not recorded.
    """

    time: Array
    position: Array
    velocity: Array


class ReferenceLog(NamedTuple):
    """Reference motion in East, North, Up.

    Attributes:
        time: Times, s, [k].
        attitude: Quaternions from body to level axes, [k, 4].
        velocity: Velocities, m/s, [k, 3].
        position: Positions, m, [k, 3].
    """

    time: Array
    attitude: Array
    velocity: Array
    position: Array


@dataclass(frozen=True)
class NavigationLog:
    """Log that passed all checks.

    Attributes:
        imu: IMU samples.
        fixes: Fixes.
        reference: Reference motion.
        gravity: Normal gravity at the origin, m/s^2.
        notes: Corrections and assumptions of the reader, for the report.
    """

    imu: ImuLog
    fixes: GnssLog
    reference: ReferenceLog
    gravity: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LogFiles:
    """Names of the three tables, without .parquet or .csv.

    Attributes:
        imu: Name of the IMU table.
        gnss: Name of the table of fixes. It can be the reference.
        reference: Name of the reference table.
    """

    imu: str = "imu"
    gnss: str = "gnss"
    reference: str = "reference"


def read_log(
    folder: str | Path,
    files: LogFiles | None = None,
    path: int | None = None,
    imu: int | None = None,
    origin: Sequence[float] | None = None,
) -> NavigationLog:
    """Read and check the log in a folder.

    Args:
        folder: Folder of the three tables.
        files: Names of the tables.
        path: Number of the flight, for tables with a column `path`.
        imu: Number of the sensor, for tables with a column `imu`.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0. Required only if one table has lat_deg,
            another has pn, and the metadata of the files do not contain it.

    Returns:
        The log in right-forward-up and East-North-Up axes.

    Raises:
        ValueError: if a check fails. The message names file, column, row, value and remedy.
    """
    names = files or LogFiles()
    select = {"path": path, "imu": imu}
    inertial, gnss, truth = (
        read_table(Path(folder), name, select) for name in (names.imu, names.gnss, names.reference)
    )
    time, notes = _imu_time(inertial)
    force, rate = (
        parse_numbers(inertial, ("fx", "fy", "fz")),
        parse_numbers(inertial, ("wx", "wy", "wz")),
    )
    _check_force(force, inertial.name)
    _check_rate(rate, inertial.name)
    centre = _origin(origin, gnss, truth)
    fixes, reference = _fixes(gnss, centre), _motion(truth, centre)
    _check_overlap(inertial.name, time, gnss.name, fixes.time)
    _check_overlap(inertial.name, time, truth.name, reference.time)
    sensors = ImuLog(time, swap_frd_rfu(force), swap_frd_rfu(rate))
    _check_turn(sensors, reference, inertial.name, truth.name)
    if centre is None:
        notes = (*notes, f"gravity {STANDARD_GRAVITY} m/s^2: the log does not contain its location")
        return NavigationLog(sensors, fixes, reference, STANDARD_GRAVITY, notes)
    latitude, height = torch.tensor([centre[0] * _DEGREE, centre[2]], dtype=torch.float64)
    return NavigationLog(sensors, fixes, reference, float(earth.gravity(latitude, height)), notes)


def swap_frd_rfu(a: Array) -> Array:
    """Convert forward-right-down to right-forward-up vectors [..., 3].

    The function also converts North-East-Down to East-North-Up. It is its own inverse.
    """
    return np.stack([a[..., 1], a[..., 0], -a[..., 2]], axis=-1)


def _imu_time(table: LogTable) -> tuple[Array, tuple[str, ...]]:
    """Read the sample times, and correct a repeated time next to a double step."""
    time = parse_numbers(table, ("t",))[:, 0]
    step = np.diff(time)
    typical = float(np.median(step))
    notes: tuple[str, ...] = ()
    for i in np.flatnonzero(step == 0).tolist():  # tags i and i + 1 are equal
        if i > 0 and np.isclose(step[i - 1], 2 * typical, rtol=0.1):
            time[i] = 0.5 * (time[i - 1] + time[i + 1])
        elif i + 1 < len(step) and np.isclose(step[i + 1], 2 * typical, rtol=0.1):
            time[i + 1] = 0.5 * (time[i] + time[i + 2])
        else:
            continue
        notes += (
            f"{table.name}: {table.row(i)} repeats a time next to a double step. The time was set to the middle",
        )
    check_increasing(table, time)
    check_seconds(table, time, longest=0.5)
    step = np.diff(time)
    i = int(step.argmax())
    if step[i] > max(_MAX_GAP, 3 * typical):
        raise ValueError(
            f"{table.name}: a gap of {step[i]:.3f} s after {table.row(i)} (t = {time[i]}), with samples every {typical:.4f} s. "
            "The motion in the gap is not recorded. Cut the log there and use the longer part."
        )
    return time, notes


def _check_force(force: Array, name: str) -> None:
    typical = float(np.median(np.linalg.norm(force, axis=1)))
    if 0.8 < typical < 1.25:
        raise ValueError(
            f"{name}: fx, fy, fz have a median norm of {typical:.3f}: in g; multiply by {STANDARD_GRAVITY}"
        )
    if not 5.0 < typical < 20.0:
        raise ValueError(
            f"{name}: fx, fy, fz have a median norm of {typical:g}; gravity alone gives 9.8 m/s^2: check the unit"
        )
    down = float(np.median(force[:, 2]))
    if down > 0.5 * typical:
        raise ValueError(
            f"{name}: fz has a median of {down:+.2f}, and forward-right-down axes show about -9.8 when level; "
            "from forward-left-up negate fy, fz, wy, wz"
        )


def _check_rate(rate: Array, name: str) -> None:
    largest = float(np.abs(rate).max())
    if largest > _MAX_RATE:
        raise ValueError(
            f"{name}: wx, wy, wz reach {largest:.1f}, implausible in rad/s; if in deg/s, multiply by {_DEGREE:.10f}"
        )


def _check_overlap(name: str, time: Array, other_name: str, other_time: Array) -> None:
    if min(time[-1], other_time[-1]) <= max(time[0], other_time[0]):
        raise ValueError(
            f"{name} covers t = {time[0]:.3f} to {time[-1]:.3f} and {other_name} t = {other_time[0]:.3f} to {other_time[-1]:.3f}: "
            "no common time; give both the same clock (GPS seconds, or seconds from the same instant)"
        )


def _check_turn(imu: ImuLog, reference: ReferenceLog, name: str, other_name: str) -> None:
    """Compare angular rates with the reference.

    Rates of slow vehicles in deg/s pass all absolute limits.
    """
    # longer intervals reduce the effect of the reference noise
    stride = max(1, round(0.25 / float(np.median(np.diff(reference.time)))))
    inside = (reference.time >= imu.time[0]) & (reference.time <= imu.time[-1])
    time, q = (
        reference.time[inside][::stride],
        torch.from_numpy(reference.attitude[inside][::stride]),
    )
    if len(time) < 10:
        return
    inverse = q[:-1] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    true = quaternion.rotation_vector_from_quaternion(
        quaternion.quaternion_multiply(inverse, q[1:])
    ).numpy()
    summed = np.cumsum(0.5 * np.diff(imu.time)[:, None] * (imu.rate[1:] + imu.rate[:-1]), axis=0)
    angle = np.vstack([np.zeros(3), summed])
    measured = np.diff(
        np.stack([np.interp(time, imu.time, column) for column in angle.T], axis=-1), axis=0
    )
    measured, true = (turn / np.diff(time)[:, None] for turn in (measured, true))
    # the mean contains the gyro bias
    measured, true = measured - measured.mean(axis=0), true - true.mean(axis=0)
    if np.sqrt(np.mean(true**2)) < 0.02:
        return  # at low angular rates the comparison contains mostly noise
    slope = float((measured * true).sum() / (true * true).sum())
    if slope > 20.0:
        raise ValueError(
            f"{name}: wx, wy, wz turn {slope:.0f} times as fast as {other_name}: in deg/s; multiply by {_DEGREE:.10f}"
        )
    if slope < 0.05:
        raise ValueError(
            f"{name} and {other_name} do not turn together (slope {slope:.3f}): check that roll, pitch, yaw are in rad (0.017: in "
            "degrees), that axes are forward-right-down, yaw clockwise from North, and that both have the same clock"
        )


def _origin(
    origin: Sequence[float] | None, gnss: LogTable, truth: LogTable
) -> tuple[float, ...] | None:
    """Return lat_deg, lon_deg, h_m of the local frame, or None for local positions only."""
    keys = [f"origin_{name}" for name in _GEODETIC]
    stated = [
        [float(table.stated[key]) for key in keys]
        for table in (truth, gnss)
        if all(key in table.stated for key in keys)
    ]
    if origin is not None or stated:
        centre = stated[0] if origin is None else list(map(float, origin))
        if len(centre) != 3 or not abs(centre[0]) <= 90.0:
            raise ValueError(
                f"scenario.origin must be lat_deg (-90 to 90), lon_deg, h_m, got {centre}. "
                "Set the point pn = pe = pd = 0."
            )
        return tuple(centre)
    for table in (gnss, truth):
        if not table.has(_LOCAL) and not table.has(_GEODETIC):
            parse_numbers(table, _LOCAL)  # raises with the names of the missing columns
    local = [table.has(_LOCAL) for table in (gnss, truth)]
    if all(local):
        return None
    if not any(local):
        return tuple(parse_numbers(truth, _GEODETIC)[0].tolist())
    raise ValueError(
        f"{gnss.name} and {truth.name}: one has lat_deg, lon_deg, h_m, the other pn, pe, pd, and no "
        "file contains the origin pn = pe = pd = 0. Set scenario.origin=[lat_deg, lon_deg, h_m]."
    )


def _positions(table: LogTable, origin: tuple[float, ...] | None) -> Array:
    """Read positions in East, North, Up from the origin, m, [n, 3]."""
    if table.has(_LOCAL) or not table.has(_GEODETIC):
        return swap_frd_rfu(parse_numbers(table, _LOCAL))
    pos = parse_numbers(table, _GEODETIC)
    invalid = np.flatnonzero(np.abs(pos[:, 0]) > 90.0)
    if invalid.size:
        position = table.row(int(invalid[0]))
        raise ValueError(
            f"{table.name}: column lat_deg, {position} is {pos[invalid[0], 0]}. Latitudes must be between -90 and 90 degrees."
        )
    scale = np.array([_DEGREE, _DEGREE, 1.0])
    return earth.local_enu(
        torch.from_numpy(pos * scale), torch.from_numpy(np.array(origin) * scale)
    ).numpy()


def _fixes(table: LogTable, origin: tuple[float, ...] | None) -> GnssLog:
    time, position = read_times(table, longest=100.0), _positions(table, origin)
    recorded = table.has(_VELOCITY)
    columns = _VELOCITY if recorded else _DERIVED
    velocity = np.full_like(position, np.nan)
    if recorded or table.has(_DERIVED):
        velocity = swap_frd_rfu(parse_numbers(table, columns))
    if "fix" in table.rows:
        missing_mask = parse_numbers(table, ("fix",))[:, 0] != 1.0
        position[missing_mask], velocity[missing_mask] = np.nan, np.nan
    return GnssLog(time, position, velocity)


def _motion(table: LogTable, origin: tuple[float, ...] | None) -> ReferenceLog:
    time = read_times(table, longest=100.0)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    roll, pitch, yaw = parse_numbers(table, ("roll", "pitch", "yaw")).T
    max_pitch, max_roll = float(np.abs(pitch).max()), float(np.abs(roll).max())
    if max_pitch > 1.001 * math.pi / 2 or max_roll > 1.001 * math.pi:
        raise ValueError(
            f"{table.name}: pitch reaches {max_pitch:g} and roll {max_roll:g}, above 90 and 180 degrees in rad; "
            f"if in degrees, multiply roll, pitch, yaw by {_DEGREE:.10f}"
        )
    euler = torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1))
    q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)).numpy()
    return ReferenceLog(
        time,
        q,
        swap_frd_rfu(parse_numbers(table, _DERIVED if derived else _VELOCITY)),
        _positions(table, origin),
    )
