"""Reads a recorded log, IMU, fixes and a reference, and says in plain words what is wrong with it.

Files speak forward-right-down and North-East-Down, as the public data sets do; here, at the door, everything becomes
right-forward-up and East-North-Up. A log is three tables with named columns, each a Parquet or a CSV file:

    imu        t [s], fx, fy, fz [m/s^2] (about -9.8 on z when level), wx, wy, wz [rad/s]
    gnss       t, and lat_deg, lon_deg, h_m or pn, pe, pd [m]; optional vn, ve, vd [m/s]; optional fix (1: use, else unseen)
    reference  t, pn, pe, pd (or lat_deg, lon_deg, h_m), vn, ve, vd, roll, pitch, yaw [rad]

A table may hold several flights and sensors, told apart by the columns `path` and `imu`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pfbench.nav import attitude, earth
from pfbench.scenario.tables import Array, Table, check_increasing, check_seconds, numbers, read_table, times

STANDARD_GRAVITY = 9.80665
_DEGREE = math.pi / 180.0
_GEODETIC, _LOCAL = ("lat_deg", "lon_deg", "h_m"), ("pn", "pe", "pd")
_VELOCITY, _DERIVED = ("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d")
_MAX_RATE = 35.0  # rad/s: the range of the fastest common MEMS gyros, 2000 deg/s
_MAX_GAP = 0.1  # s without a sample over which increments are still believed


class Imu(NamedTuple):
    """time [n] s; force [n, 3] m/s^2 and rate [n, 3] rad/s in body axes right, forward, up."""

    time: Array
    force: Array
    rate: Array


class Fixes(NamedTuple):
    """time [m] s; position [m, 3] m and velocity [m, 3] m/s, East, North, Up; NaN where not seen, all NaN where not recorded."""

    time: Array
    position: Array
    velocity: Array


class Motion(NamedTuple):
    """The reference: time [k]; attitude, quaternions body to level [k, 4]; velocity and position [k, 3], East, North, Up."""

    time: Array
    attitude: Array
    velocity: Array
    position: Array


@dataclass(frozen=True)
class Log:
    """A checked log.

    Attributes:
        imu, fixes, reference: the three tables.
        gravity: normal gravity at the origin, m/s^2.
        notes: what was read in a particular way, for the report.
    """

    imu: Imu
    fixes: Fixes
    reference: Motion
    gravity: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Files:
    """Names of the three tables, without .parquet or .csv; fixes may be read from the reference."""

    imu: str = "imu"
    gnss: str = "gnss"
    reference: str = "reference"


def read_log(
    folder: str | Path,
    files: Files | None = None,
    path: int | None = None,
    imu: int | None = None,
    origin: Sequence[float] | None = None,
) -> Log:
    """Reads and checks the log in a folder.

    Args:
        folder: where the three tables lie.
        files: their names.
        path, imu: which flight and sensor, where the tables have columns of these names.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0; needed only where one table says lat_deg and another pn, and the
            files' metadata do not say it.

    Raises:
        ValueError: anything wrong with the log; the message names file, column, row, value and remedy.
    """
    names = files or Files()
    select = {"path": path, "imu": imu}
    inertial, gnss, truth = (read_table(Path(folder), name, select) for name in (names.imu, names.gnss, names.reference))
    time, notes = _imu_time(inertial)
    force, rate = numbers(inertial, ("fx", "fy", "fz")), numbers(inertial, ("wx", "wy", "wz"))
    _check_force(force, inertial.name)
    _check_rate(rate, inertial.name)
    centre = _origin(origin, gnss, truth)
    fixes, reference = _fixes(gnss, centre), _motion(truth, centre)
    _check_overlap(inertial.name, time, gnss.name, fixes.time)
    _check_overlap(inertial.name, time, truth.name, reference.time)
    sensors = Imu(time, frd(force), frd(rate))
    _check_turn(sensors, reference, inertial.name, truth.name)
    if centre is None:
        notes = (*notes, f"gravity {STANDARD_GRAVITY} m/s^2: the log states no place")
        return Log(sensors, fixes, reference, STANDARD_GRAVITY, notes)
    latitude, height = torch.tensor([centre[0] * _DEGREE, centre[2]], dtype=torch.float64)
    return Log(sensors, fixes, reference, float(earth.gravity(latitude, height)), notes)


def frd(a: Array) -> Array:
    """Forward-right-down to right-forward-up, and North-East-Down to East-North-Up [..., 3]; its own inverse."""
    return np.stack([a[..., 1], a[..., 0], -a[..., 2]], axis=-1)


def _imu_time(table: Table) -> tuple[Array, tuple[str, ...]]:
    """Times of the samples; one slipped tag (a repeat beside a double step) goes back to its place, and is told."""
    time = numbers(table, ("t",))[:, 0]
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
        notes += (f"{table.name}: {table.row(i)} repeats a time beside a double step; put midway",)
    check_increasing(table, time)
    check_seconds(table, time, longest=0.5)
    step = np.diff(time)
    i = int(step.argmax())
    if step[i] > max(_MAX_GAP, 3 * typical):
        raise ValueError(
            f"{table.name}: a gap of {step[i]:.3f} s after {table.row(i)} (t = {time[i]}), with samples every {typical:.4f} s; "
            "the motion in it is unknown: cut the log there and use the longer part"
        )
    return time, notes


def _check_force(force: Array, name: str) -> None:
    typical = float(np.median(np.linalg.norm(force, axis=1)))
    if 0.8 < typical < 1.25:
        raise ValueError(f"{name}: fx, fy, fz have a median norm of {typical:.3f}: in g; multiply by {STANDARD_GRAVITY}")
    if not 5.0 < typical < 20.0:
        raise ValueError(f"{name}: fx, fy, fz have a median norm of {typical:g}; gravity alone gives 9.8 m/s^2: check the unit")
    down = float(np.median(force[:, 2]))
    if down > 0.5 * typical:
        raise ValueError(
            f"{name}: fz has a median of {down:+.2f}, and forward-right-down axes show about -9.8 when level; "
            "from forward-left-up negate fy, fz, wy, wz"
        )


def _check_rate(rate: Array, name: str) -> None:
    largest = float(np.abs(rate).max())
    if largest > _MAX_RATE:
        raise ValueError(f"{name}: wx, wy, wz reach {largest:.1f}, implausible in rad/s; if in deg/s, multiply by {_DEGREE:.10f}")


def _check_overlap(name: str, time: Array, other: str, other_time: Array) -> None:
    if min(time[-1], other_time[-1]) <= max(time[0], other_time[0]):
        raise ValueError(
            f"{name} covers t = {time[0]:.3f} to {time[-1]:.3f} and {other} t = {other_time[0]:.3f} to {other_time[-1]:.3f}: "
            "no common time; give both the same clock (GPS seconds, or seconds from the same instant)"
        )


def _check_turn(imu: Imu, reference: Motion, name: str, other: str) -> None:
    """Gyros against the turns of the reference: slow vehicles in deg/s stay below every absolute bound."""
    every = max(1, round(0.25 / float(np.median(np.diff(reference.time)))))  # longer turns drown the reference's noise
    inside = (reference.time >= imu.time[0]) & (reference.time <= imu.time[-1])
    time, q = reference.time[inside][::every], torch.from_numpy(reference.attitude[inside][::every])
    if len(time) < 10:
        return
    inverse = q[:-1] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    true = attitude.rotation_vector_from_quaternion(attitude.quaternion_multiply(inverse, q[1:])).numpy()
    summed = np.cumsum(0.5 * np.diff(imu.time)[:, None] * (imu.rate[1:] + imu.rate[:-1]), axis=0)
    angle = np.vstack([np.zeros(3), summed])
    seen = np.diff(np.stack([np.interp(time, imu.time, column) for column in angle.T], axis=-1), axis=0)
    seen, true = (turn / np.diff(time)[:, None] for turn in (seen, true))
    seen, true = seen - seen.mean(axis=0), true - true.mean(axis=0)  # the gyros' bias
    if np.sqrt(np.mean(true**2)) < 0.02:
        return  # hardly turning: the comparison would be one of noise
    slope = float((seen * true).sum() / (true * true).sum())
    if slope > 20.0:
        raise ValueError(f"{name}: wx, wy, wz turn {slope:.0f} times as fast as {other}: in deg/s; multiply by {_DEGREE:.10f}")
    if slope < 0.05:
        raise ValueError(
            f"{name} and {other} do not turn together (slope {slope:.3f}): check that roll, pitch, yaw are in rad (0.017: in "
            "degrees), that axes are forward-right-down, yaw clockwise from North, and that both have the same clock"
        )


def _origin(given: Sequence[float] | None, gnss: Table, truth: Table) -> tuple[float, ...] | None:
    """lat_deg, lon_deg, h_m of the local frame; None where all positions are local and no table says where that is."""
    keys = [f"origin_{part}" for part in _GEODETIC]
    stated = [[float(table.stated[key]) for key in keys] for table in (truth, gnss) if all(key in table.stated for key in keys)]
    if given is not None or stated:
        centre = stated[0] if given is None else list(map(float, given))
        if len(centre) != 3 or not abs(centre[0]) <= 90.0:
            raise ValueError(f"origin={centre}: give lat_deg, lon_deg, h_m of the point pn = pe = pd = 0")
        return tuple(centre)
    for table in (gnss, truth):
        if not table.has(_LOCAL) and not table.has(_GEODETIC):
            numbers(table, _LOCAL)  # says which columns are missing
    local = [table.has(_LOCAL) for table in (gnss, truth)]
    if all(local):
        return None
    if not any(local):
        return tuple(numbers(truth, _GEODETIC)[0].tolist())
    raise ValueError(
        f"{gnss.name} and {truth.name}: one gives lat_deg, lon_deg, h_m, the other pn, pe, pd, and no file says where "
        "pn = pe = pd = 0 is; set origin=[lat_deg, lon_deg, h_m]"
    )


def _positions(table: Table, origin: tuple[float, ...] | None) -> Array:
    """East, North, Up from the origin [n, 3]."""
    if table.has(_LOCAL) or not table.has(_GEODETIC):
        return frd(numbers(table, _LOCAL))
    pos = numbers(table, _GEODETIC)
    wrong = np.flatnonzero(np.abs(pos[:, 0]) > 90.0)
    if wrong.size:
        where = table.row(int(wrong[0]))
        raise ValueError(f"{table.name}: column lat_deg, {where} is {pos[wrong[0], 0]}: latitudes lie in -90 to 90 degrees")
    scale = np.array([_DEGREE, _DEGREE, 1.0])
    return earth.local_enu(torch.from_numpy(pos * scale), torch.from_numpy(np.array(origin) * scale)).numpy()


def _fixes(table: Table, origin: tuple[float, ...] | None) -> Fixes:
    time, position = times(table, longest=100.0), _positions(table, origin)
    recorded = table.has(_VELOCITY)
    columns = _VELOCITY if recorded else _DERIVED
    velocity = np.full_like(position, np.nan)
    if recorded or table.has(_DERIVED):
        velocity = frd(numbers(table, columns))
    if "fix" in table.rows:
        unseen = numbers(table, ("fix",))[:, 0] != 1.0
        position[unseen], velocity[unseen] = np.nan, np.nan
    return Fixes(time, position, velocity)


def _motion(table: Table, origin: tuple[float, ...] | None) -> Motion:
    time = times(table, longest=100.0)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    roll, pitch, yaw = numbers(table, ("roll", "pitch", "yaw")).T
    steepest, widest = float(np.abs(pitch).max()), float(np.abs(roll).max())
    if steepest > 1.001 * math.pi / 2 or widest > 1.001 * math.pi:
        raise ValueError(
            f"{table.name}: pitch reaches {steepest:g} and roll {widest:g}, in rad more than 90 and 180 degrees; "
            f"if in degrees, multiply roll, pitch, yaw by {_DEGREE:.10f}"
        )
    euler = torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1))
    q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)).numpy()
    return Motion(time, q, frd(numbers(table, _DERIVED if derived else _VELOCITY)), _positions(table, origin))
