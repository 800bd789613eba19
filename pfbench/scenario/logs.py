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
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.nav import attitude, earth

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
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


class Table(NamedTuple):
    """A file's rows, its name for messages, whether it has lines, and the origin that it states (lat_deg, lon_deg, h_m)."""

    rows: pd.DataFrame
    name: str
    lines: bool
    origin: tuple[float, ...] | None


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
    inertial, gnss, truth = (_table(Path(folder), name, select) for name in (names.imu, names.gnss, names.reference))
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
        return Log(sensors, fixes, reference, STANDARD_GRAVITY, (*notes, f"gravity {STANDARD_GRAVITY} m/s^2: the log states no place"))
    g = earth.gravity(torch.tensor(math.radians(centre[0]), dtype=torch.float64), torch.tensor(centre[2], dtype=torch.float64))
    return Log(sensors, fixes, reference, float(g), notes)


def frd(a: Array) -> Array:
    """Forward-right-down to right-forward-up, and North-East-Down to East-North-Up [..., 3]; its own inverse."""
    return np.stack([a[..., 1], a[..., 0], -a[..., 2]], axis=-1)


def numbers(table: Table, columns: Sequence[str], finite: bool = True) -> Array:
    """Columns as numbers [n, k].

    Raises:
        ValueError: a column that is missing, holds text, or (where `finite`) NaN or infinity; names file, column and row.
    """
    missing = [column for column in columns if column not in table.rows]
    if missing:
        raise ValueError(
            f"{table.name}: no column {', '.join(missing)}; it has {', '.join(map(str, table.rows.columns))}. Rename or add "
            f"{'it' if len(missing) == 1 else 'them'} (units: s, m, m/s, m/s^2, rad, rad/s)"
        )
    out = np.empty((len(table.rows), len(columns)))
    for i, column in enumerate(columns):
        values = pd.to_numeric(table.rows[column], errors="coerce").to_numpy(dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(values))
        if finite and bad.size:
            raise ValueError(
                f"{table.name}: column {column}, {_row(table, bad[0])} is {table.rows[column].iloc[bad[0]]!r} "
                f"({bad.size} such); give numbers, and leave out rows without data"
            )
        out[:, i] = values
    return out


def _table(folder: Path, name: str, select: dict[str, int | None]) -> Table:
    found = [file for suffix in (".parquet", ".csv") if (file := folder / f"{name}{suffix}").is_file()]
    if not found:
        raise ValueError(f"{folder}: no {name}.parquet and no {name}.csv; a log is a folder with imu, gnss and reference")
    if len(found) > 1:
        raise ValueError(f"{folder}: both {name}.parquet and {name}.csv; delete one of them, or name the files otherwise")
    file = found[0]
    if file.suffix == ".csv":
        table = Table(pd.read_csv(file, skip_blank_lines=False, skipinitialspace=True), file.name, True, None)
    else:
        table = _parquet(file)
    for column, value in select.items():
        if column in table.rows:
            table = _selected(table, column, value)
    if len(table.rows) < 2:
        raise ValueError(f"{file.name}: {len(table.rows)} rows; give at least 2")
    return table


def _parquet(file: Path) -> Table:
    try:
        from pyarrow import parquet  # only logs in Parquet need it
    except ImportError as error:
        raise ValueError(f"{file.name} needs pyarrow: pip install 'pfbench[data]', or store the log as CSV") from error
    table = parquet.read_table(file)
    stated = {key.decode(): value for key, value in (table.schema.metadata or {}).items()}
    keys = [f"origin_{part}" for part in _GEODETIC]
    origin = tuple(float(stated[key]) for key in keys) if all(key in stated for key in keys) else None
    return Table(table.to_pandas(), file.name, False, origin)


def _selected(table: Table, column: str, value: int | None) -> Table:
    there = sorted(set(table.rows[column].tolist()))
    if value is None and len(there) > 1:
        raise ValueError(f"{table.name}: column {column} tells {there} apart; choose one of them with {column}=...")
    if value is not None and value not in there:
        raise ValueError(f"{table.name}: {column}={value} is not in the file; it has {there}")
    chosen = there[0] if value is None else value
    return table._replace(rows=table.rows[table.rows[column] == chosen].reset_index(drop=True), name=f"{table.name} ({column} {chosen})")


def _row(table: Table, i: int) -> str:
    return f"line {i + 2}" if table.lines else f"row {i} (from 0)"


def _times(table: Table, longest: float) -> Array:
    """Increasing times; `longest` is the median interval above which they cannot be seconds."""
    time = numbers(table, ("t",))[:, 0]
    _check_increasing(table, time)
    _check_seconds(table, time, longest)
    return time


def _check_increasing(table: Table, time: Array) -> None:
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = int(back[0]) + 1
        what = "repeats the time before" if time[i] == time[i - 1] else "goes back in time"
        raise ValueError(
            f"{table.name}: column t, {_row(table, i)} is {time[i]!r} after {time[i - 1]!r}: it {what} ({back.size} such); "
            "sort the rows by t and keep one row for each time"
        )


def _check_seconds(table: Table, time: Array, longest: float) -> None:
    typical = float(np.median(np.diff(time)))
    if typical <= longest:
        return
    unit, scale = next((u, s) for u, s in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if typical * s <= longest or u == "ns")
    raise ValueError(
        f"{table.name}: column t has a median interval of {typical:g}, too long for seconds; if it is in {unit}, multiply by {scale:g}"
    )


def _imu_time(table: Table) -> tuple[Array, tuple[str, ...]]:
    """Times of the samples; one slipped tag (a repeat beside a double step) goes back to its place, and is told."""
    time = numbers(table, ("t",))[:, 0]
    step = np.diff(time)
    typical = float(np.median(step))
    notes: tuple[str, ...] = ()
    for i in np.flatnonzero(step == 0):  # tags i and i + 1 are equal
        if i > 0 and np.isclose(step[i - 1], 2 * typical, rtol=0.1):
            time[i] = 0.5 * (time[i - 1] + time[i + 1])
        elif i + 1 < len(step) and np.isclose(step[i + 1], 2 * typical, rtol=0.1):
            time[i + 1] = 0.5 * (time[i] + time[i + 2])
        else:
            continue
        notes += (f"{table.name}: {_row(table, int(i))} repeats a time beside a double step; put midway",)
    _check_increasing(table, time)
    _check_seconds(table, time, longest=0.5)
    step = np.diff(time)
    if step.max() > max(_MAX_GAP, 3 * typical):
        i = int(step.argmax())
        raise ValueError(
            f"{table.name}: a gap of {step[i]:.3f} s after {_row(table, i)} (t = {time[i]!r}), where samples come every {typical:.4f} s; "
            "the motion in it is unknown: cut the log there and use the longer part"
        )
    return time, notes


def _check_force(force: Array, name: str) -> None:
    typical = float(np.median(np.linalg.norm(force, axis=1)))
    if 0.8 < typical < 1.25:
        raise ValueError(f"{name}: fx, fy, fz have a median norm of {typical:.3f}: in g; multiply by {STANDARD_GRAVITY}")
    if not 5.0 < typical < 20.0:
        raise ValueError(f"{name}: fx, fy, fz have a median norm of {typical:g}, and specific force is near 9.8 m/s^2: check the unit")
    down = float(np.median(force[:, 2]))
    if down > 0.5 * typical:
        raise ValueError(
            f"{name}: fz has a median of {down:+.2f}, and forward-right-down axes show about -9.8 when level; "
            "from forward-left-up negate fy, fz, wy, wz"
        )


def _check_rate(rate: Array, name: str) -> None:
    largest = float(np.abs(rate).max())
    if largest > _MAX_RATE:
        raise ValueError(f"{name}: wx, wy, wz reach {largest:.1f}, implausible in rad/s; if in deg/s, multiply by {math.pi / 180:.10f}")


def _check_overlap(name: str, time: Array, other: str, other_time: Array) -> None:
    if min(time[-1], other_time[-1]) <= max(time[0], other_time[0]):
        raise ValueError(
            f"{name} covers t = {time[0]:.3f} to {time[-1]:.3f} and {other} t = {other_time[0]:.3f} to {other_time[-1]:.3f}: "
            "no common time; give both the same clock (GPS seconds, or seconds from the same instant)"
        )


def _check_turn(imu: Imu, reference: Motion, name: str, other: str) -> None:
    """Gyros against the turns of the reference: slow vehicles in deg/s stay below every absolute bound."""
    q = torch.from_numpy(reference.attitude)
    turn = attitude.rotation_vector_from_quaternion(attitude.quaternion_multiply(q[:-1] * q.new_tensor([1, -1, -1, -1]), q[1:])).numpy()
    inside = (reference.time[:-1] >= imu.time[0]) & (reference.time[1:] <= imu.time[-1])
    step = np.diff(imu.time)[:, None]
    angle = np.vstack([np.zeros(3), np.cumsum(0.5 * step * (imu.rate[1:] + imu.rate[:-1]), axis=0)])
    at = np.stack([np.interp(reference.time, imu.time, angle[:, k]) for k in range(3)], axis=-1)
    span = np.diff(reference.time)[inside, None]
    seen, true = np.diff(at, axis=0)[inside], turn[inside]
    if inside.sum() < 10 or np.sqrt(np.mean((true / span) ** 2)) < 0.02:
        return  # hardly turning: the comparison would be one of noise
    seen = seen - span * np.median(seen / span, axis=0)  # the bias
    slope = float((seen * true).sum() / (true * true).sum())
    if slope > 20.0:
        raise ValueError(f"{name}: wx, wy, wz turn {slope:.0f} times as fast as {other}: in deg/s; multiply by {math.pi / 180:.10f}")
    if slope < 0.05:
        raise ValueError(
            f"{name} and {other} do not turn together (slope {slope:.3f}): check that roll, pitch, yaw are in rad (0.017: in "
            "degrees), that axes are forward-right-down, yaw clockwise from North, and that both have the same clock"
        )


def _origin(given: Sequence[float] | None, gnss: Table, truth: Table) -> tuple[float, ...] | None:
    """lat_deg, lon_deg, h_m of the local frame; None where all positions are local and no table says where that is."""
    stated = tuple(map(float, given)) if given is not None else truth.origin or gnss.origin
    if stated is not None:
        if len(stated) != 3 or not abs(stated[0]) <= 90.0:
            raise ValueError(f"origin={list(stated)}: give lat_deg, lon_deg, h_m of the point pn = pe = pd = 0")
        return stated
    local = [all(column in table.rows for column in _LOCAL) for table in (gnss, truth)]
    if all(local):
        return None
    if not any(local):
        return tuple(numbers(truth, _GEODETIC)[0])
    raise ValueError(
        f"{gnss.name} and {truth.name}: one gives lat_deg, lon_deg, h_m, the other pn, pe, pd, and no file says where "
        "pn = pe = pd = 0 is; set origin=[lat_deg, lon_deg, h_m]"
    )


def _positions(table: Table, origin: tuple[float, ...] | None) -> Array:
    """East, North, Up from the origin [n, 3]."""
    if all(column in table.rows for column in _LOCAL) or not any(column in table.rows for column in _GEODETIC):
        return frd(numbers(table, _LOCAL))
    pos = numbers(table, _GEODETIC)
    wrong = np.flatnonzero(np.abs(pos[:, 0]) > 90.0)
    if wrong.size:
        raise ValueError(f"{table.name}: column lat_deg, {_row(table, wrong[0])} is {pos[wrong[0], 0]}: latitudes lie in -90 to 90 degrees")
    scale = np.array([math.pi / 180.0, math.pi / 180.0, 1.0])
    return earth.local_enu(torch.from_numpy(pos * scale), torch.from_numpy(np.array(origin) * scale)).numpy()


def _fixes(table: Table, origin: tuple[float, ...] | None) -> Fixes:
    time, position = _times(table, longest=100.0), _positions(table, origin)
    recorded = all(column in table.rows for column in _VELOCITY)
    columns = _VELOCITY if recorded else _DERIVED
    velocity = np.full_like(position, np.nan)
    if recorded or all(column in table.rows for column in _DERIVED):
        velocity = frd(numbers(table, columns))
    if "fix" in table.rows:
        unseen = numbers(table, ("fix",))[:, 0] != 1.0
        position[unseen], velocity[unseen] = np.nan, np.nan
    return Fixes(time, position, velocity)


def _motion(table: Table, origin: tuple[float, ...] | None) -> Motion:
    time = _times(table, longest=100.0)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    roll, pitch, yaw = numbers(table, ("roll", "pitch", "yaw")).T
    largest = max(float(np.abs(pitch).max()) / (math.pi / 2), float(np.abs(roll).max()) / math.pi)
    if largest > 1.001:
        raise ValueError(
            f"{table.name}: pitch reaches {np.abs(pitch).max():g} and roll {np.abs(roll).max():g}, more than 90 and 180 degrees in rad; "
            f"if in degrees, multiply roll, pitch, yaw by {math.pi / 180:.10f}"
        )
    euler = torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1))
    q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)).numpy()
    return Motion(time, q, frd(numbers(table, _DERIVED if derived else _VELOCITY)), _positions(table, origin))
