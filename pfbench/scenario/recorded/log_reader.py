"""Reader of recorded logs with checks of units, axes, times and gaps.

Files use the axes forward-right-down and North-East-Down, as public data sets do. The reader
converts them to right-forward-up and East-North-Up. A log consists of three tables with named
columns, each a Parquet or a CSV file:

| table | columns |
|---|---|
| imu | t [s], fx, fy, fz [m/s^2] (about -9.8 on z when level), wx, wy, wz [rad/s] |
| gnss | t, and lat_deg, lon_deg, h_m or pn, pe, pd [m] |
| gnss, optional | vn, ve, vd [m/s]; fix (1: use the fix, 0: missing; other codes by `fix_codes`) |
| reference | t, pn, pe, pd (or lat_deg, lon_deg, h_m), vn, ve, vd, roll, pitch, yaw [rad] |

A table can contain several flights and sensors. The columns `path` and `imu` identify them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pfbench.files.reader_notes import announce_notes
from pfbench.nav import attitude, earth
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.scenario.recorded.clock_offsets import find_fix_offset, find_imu_offset
from pfbench.scenario.recorded.fix_codes import FixCodes, check_fix_codes, select_usable
from pfbench.scenario.recorded.log_agreement import (
    compare_fixes,
    compare_inertial,
    compare_reference,
    compare_times,
)
from pfbench.scenario.recorded.log_checks import (
    STANDARD_GRAVITY,
    check_force,
    check_overlap,
    check_rotation,
)
from pfbench.scenario.recorded.log_tables import (
    Array,
    GnssLog,
    ImuLog,
    LogFiles,
    LogTable,
    NavigationLog,
    ReferenceLog,
    check_changes,
    check_increasing,
    check_seconds,
    parse_numbers,
    read_table,
    read_times,
    swap_frd_rfu,
)

_DEGREE = math.pi / 180.0
_GEODETIC, _LOCAL = ("lat_deg", "lon_deg", "h_m"), ("pn", "pe", "pd")
_VELOCITY, _DERIVED = ("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d")
_MAX_GAP = 0.1  # s; longest interval between samples


def read_log(
    folder: str | Path,
    files: LogFiles | None = None,
    path: int | None = None,
    imu: int | None = None,
    origin: Sequence[float] | None = None,
    limits: PlausibleLimits | None = None,
    fix_codes: FixCodes = None,
) -> NavigationLog:
    """Read and check the log in a folder.

    Args:
        folder: Folder of the three tables.
        files: Names of the tables.
        path: Number of the flight, for tables with a column `path`.
        imu: Number of the sensor, for tables with a column `imu`.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0. Required only if one table has lat_deg,
            another has pn, and the metadata of the files do not contain it.
        limits: Limits of the platform. None for the default limits.
        fix_codes: Meaning of the column `fix` of the fixes: the program that wrote it (nmea, rtklib,
            ublox), the codes of the fixes to use, or None for 1 (use) and 0.

    Returns:
        The log in right-forward-up and East-North-Up axes.

    Raises:
        ValueError: If a check fails. The message names file, column, row, value and remedy.
    """
    names, limits = files or LogFiles(), limits or PlausibleLimits()
    select = {"path": path, "imu": imu}
    inertial, gnss, truth = (
        read_table(Path(folder), name, select, limits)
        for name in (names.imu, names.gnss, names.reference)
    )
    sensors, notes = _samples(inertial)
    centre = _origin(origin, gnss, truth)
    check_fix_codes(fix_codes)
    usable, usable_notes = select_usable(gnss, fix_codes)
    fixes, reference = _fixes(gnss, centre, usable), _motion(truth, centre)
    check_overlap(inertial.name, sensors.time, gnss.name, fixes.time)
    check_overlap(inertial.name, sensors.time, truth.name, reference.time)
    check_force(sensors, reference, inertial.name)
    imu_offset = find_imu_offset(sensors, reference)
    late = imu_offset.describe(inertial.name, truth.name) if imu_offset else ""
    check_rotation(
        sensors,
        reference,
        (inertial.name, truth.name),
        lambda: _other_attitudes(truth, reference),
        late,
    )
    gravity, gravity_notes = _gravity(centre)
    notes += (*gravity_notes, *compare_reference(truth, reference))
    with _explain(late):
        notes += compare_inertial(truth, sensors, reference, gravity)
    fixes, fix_notes = _compare_fixes(gnss, fixes, (truth, reference), limits)
    tables = ((inertial.name, sensors.time), (gnss.name, fixes.time), (truth.name, reference.time))
    dropped = dict.fromkeys(note for table in (inertial, gnss, truth) for note in table.notes)
    offsets = (late,) if late else ()
    notes = (*dropped, *offsets, *usable_notes, *notes, *fix_notes, *compare_times(tables))
    announce_notes(folder, notes)
    return NavigationLog(sensors, fixes, reference, gravity, notes)


def _compare_fixes(
    table: LogTable,
    fixes: GnssLog,
    truth: tuple[LogTable, ReferenceLog],
    limits: PlausibleLimits,
) -> tuple[GnssLog, tuple[str, ...]]:
    """Compare fixes with the reference, and name the offset of a clock that is not its own."""
    reference_table, reference = truth
    is_own = table.name == reference_table.name
    offset = None if is_own else find_fix_offset(fixes, reference)
    late = offset.describe(table.name, reference_table.name) if offset else ""
    with _explain(late):
        fixes, notes = compare_fixes(table, fixes, reference, limits)
    return fixes, ((late, *notes) if late else notes)


def _gravity(centre: tuple[float, ...] | None) -> tuple[float, tuple[str, ...]]:
    """Return the gravity at the origin, m/s^2, and a note if the origin is not known."""
    if centre is None:
        text = f"gravity {STANDARD_GRAVITY} m/s^2: the log does not contain its location"
        return STANDARD_GRAVITY, (text,)
    latitude, height = torch.tensor([centre[0] * _DEGREE, centre[2]], dtype=torch.float64)
    return float(earth.gravity(latitude, height)), ()


@contextlib.contextmanager
def _explain(offset: str) -> Iterator[None]:
    """Add the offset of a clock to the error of a comparison, which it can cause."""
    try:
        yield
    except ValueError as error:
        if not offset:
            raise
        text = f"{error} First correct the clock: {offset}."
        raise ValueError(text) from None


def _samples(table: LogTable) -> tuple[ImuLog, tuple[str, ...]]:
    """Read and check the IMU samples."""
    time, notes = _imu_time(table)
    force, rate = (
        parse_numbers(table, ("fx", "fy", "fz")),
        parse_numbers(table, ("wx", "wy", "wz")),
    )
    check_changes(table, ("fx", "fy", "fz", "wx", "wy", "wz"), time, np.hstack([force, rate]))
    return ImuLog(time, swap_frd_rfu(force), swap_frd_rfu(rate)), notes


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
            f"{table.name} must not have gaps, got a gap of {step[i]:.3f} s after {table.row(i)} "
            f"(t = {time[i]}), with samples every {typical:.4f} s. "
            f"{_longest_part(table, time, step > max(_MAX_GAP, 3 * typical))}"
        )
    slow = np.flatnonzero(step > 3 * typical)
    if slow.size:
        notes += (
            f"{table.name}: {slow.size} intervals are longer than 3 samples, the longest with "
            f"{step[i]:.3f} s after {table.row(i)}. Samples were interpolated",
        )
    return time, notes


def _longest_part(table: LogTable, time: Array, is_gap: NDArray[np.bool_]) -> str:
    """Name the rows between two gaps that cover the longest time."""
    borders = np.concatenate([[0], np.flatnonzero(is_gap) + 1, [len(time)]])
    first, last = borders[:-1], borders[1:] - 1
    i = int(np.argmax(time[last] - time[first]))
    return (
        f"Keep the longest part without a gap, {table.row(int(first[i]))} to {table.row(int(last[i]))} "
        f"(t = {time[first[i]]:.3f} to {time[last[i]]:.3f})."
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
        f"{gnss.name} and {truth.name} must both have pn, pe, pd or both lat_deg, lon_deg, h_m, "
        "got one with each and no file with the origin pn = pe = pd = 0. "
        "Set scenario.origin=[lat_deg, lon_deg, h_m]."
    )


def _positions(table: LogTable, origin: tuple[float, ...] | None) -> Array:
    """Read positions in East, North, Up from the origin, m, [n, 3]."""
    if table.has(_LOCAL) or not table.has(_GEODETIC):
        return swap_frd_rfu(parse_numbers(table, _LOCAL))
    pos = parse_numbers(table, _GEODETIC)
    scale = np.array([_DEGREE, _DEGREE, 1.0])
    return earth.local_enu(
        torch.from_numpy(pos * scale), torch.from_numpy(np.array(origin) * scale)
    ).numpy()


def _fixes(table: LogTable, origin: tuple[float, ...] | None, usable: NDArray[np.bool_]) -> GnssLog:
    time, position = read_times(table, longest=100.0), _positions(table, origin)
    recorded = table.has(_VELOCITY)
    columns = _VELOCITY if recorded else _DERIVED
    velocity = np.full_like(position, np.nan)
    if recorded or table.has(_DERIVED):
        velocity = swap_frd_rfu(parse_numbers(table, columns))
    position[~usable], velocity[~usable] = np.nan, np.nan
    return GnssLog(time, position, velocity)


def _motion(table: LogTable, origin: tuple[float, ...] | None) -> ReferenceLog:
    time = read_times(table, longest=100.0)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    q = _quaternion(*parse_numbers(table, ("roll", "pitch", "yaw")).T)
    columns = _DERIVED if derived else _VELOCITY
    velocity = swap_frd_rfu(parse_numbers(table, columns))
    check_changes(table, columns, time, swap_frd_rfu(velocity))
    return ReferenceLog(
        time,
        q,
        velocity,
        _positions(table, origin),
    )


def _quaternion(roll: Array, pitch: Array, yaw: Array) -> Array:
    euler = torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1))
    return attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)).numpy()


def _other_attitudes(table: LogTable, reference: ReferenceLog) -> dict[str, ReferenceLog]:
    """Return the reference as other units and signs of its attitude would give it."""
    roll, pitch, yaw = parse_numbers(table, ("roll", "pitch", "yaw")).T
    angles = {
        f"yaw is in degrees: multiply it by {_DEGREE:.10f}.": (roll, pitch, _DEGREE * yaw),
        f"roll, pitch, yaw are in degrees: multiply them by {_DEGREE:.10f}.": (
            _DEGREE * roll,
            _DEGREE * pitch,
            _DEGREE * yaw,
        ),
        "yaw is counted anticlockwise: negate it.": (roll, pitch, -yaw),
    }
    return {
        f"{table.name}: {text}": reference._replace(attitude=_quaternion(*values))
        for text, values in angles.items()
    }
