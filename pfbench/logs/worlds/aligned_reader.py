"""Reader of own logs without a reference of the attitude: IMU and fixes, and positions of a reference if there are any."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.raw_log import take_log
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.fix_codes import FixCodes, select_usable
from pfbench.logs.worlds.log_checks import check_overlap
from pfbench.logs.worlds.log_frames import find_origin, gravity_at, read_positions
from pfbench.logs.worlds.log_reader import (
    Diagnosed,
    diagnose,
    read_fixes,
    read_samples,
)
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    LogFiles,
    LogTable,
    NavigationLog,
    ReferenceLog,
    parse_numbers,
    read_table,
    read_times,
    swap_frd_rfu,
)

_VELOCITY = ("vn", "ve", "vd")
_REMEDY = "Leave these out. A lever arm is a key of scenario.constraints, too."


def read_aligned_log(
    folder: Path,
    files: LogFiles,
    path: int | None = None,
    imu: int | None = None,
    origin: Sequence[float] | None = None,
    limits: PlausibleLimits | None = None,
    fix_codes: FixCodes = None,
    corrections: LogCorrections | None = None,
) -> NavigationLog:
    """Read and check a log without a reference of the attitude; the arguments are those of `read_log`.

    Returns the log. Its reference is without attitude, and without a reference it is the track of the fixes.
    """
    mending = corrections or LogCorrections()
    check_corrections(mending, files.reference is not None)
    select = {"path": path, "imu": imu}
    inertial, gnss = (read_table(folder, name, select, limits) for name in (files.imu, files.gnss))  # fmt: skip
    truth = read_table(folder, files.reference, select, limits) if files.reference else None
    (inertial, gnss, third), mended = mending.correct_tables(inertial, gnss, truth or gnss)
    tables = (inertial, gnss, third if truth else None)
    log = check_aligned_tables(tables, mended, mending, origin, fix_codes)
    announce_notes(folder, log.notes)
    return log


def check_aligned_tables(
    tables: tuple[LogTable, LogTable, LogTable | None],
    mended: tuple[str, ...],
    mending: LogCorrections,
    origin: Sequence[float] | None = None,
    fix_codes: FixCodes = None,
    diagnosis: Diagnosed | None = None,
) -> NavigationLog:
    """Check corrected tables of a log without a reference of the attitude; the arguments are those of `check_tables`.

    Returns the log.
    """
    inertial, gnss, truth = tables
    sensors, notes = read_samples(inertial)
    check_level(sensors.force, inertial.name)
    centre = find_origin(origin, gnss, truth or gnss)
    usable, usable_notes = select_usable(gnss, fix_codes)
    fixes = read_fixes(gnss, centre, usable)
    position = mending.offset_m
    if position is not None:
        fixes = fixes._replace(position=fixes.position - swap_frd_rfu(np.array(position, float)))  # fmt: skip
        mended = (*mended, f"{gnss.name}: {list(position)} m North, East, Down subtracted from the fixes")  # fmt: skip
    check_overlap(inertial.name, sensors.time, gnss.name, fixes.time)
    gravity, gravity_notes = gravity_at(centre)
    raw = take_log((inertial, gnss, gnss), sensors, fixes, None, gravity)
    diagnosed = diagnose(raw, has_own_fixes=True, diagnosis=diagnosis)
    dropped = dict.fromkeys(note for table in (inertial, gnss) for note in table.notes)
    notes = (*dropped, *mended, *usable_notes, *notes, *gravity_notes, *diagnosed)
    reference = read_track(truth, centre) if truth else _join_fixes(fixes)
    return NavigationLog(sensors, fixes, reference, gravity, notes, centre)


def check_level(force: Array, name: str) -> None:
    """Check that the specific force is upward for most of the time, which a course cannot show.

    Shapes: force [n, 3], right, forward, up.
    """
    typical, up = float(np.median(np.linalg.norm(force, axis=1))), float(np.median(force[:, 2]))
    must = "be about -9.8 on fz for most of the time, in axes forward, right, down"
    remedy = "Axes forward, left, up need +scenario.corrections.mounting.imu=[x,-y,-z]; see pfbench inspect."
    require(
        up > 0.5 * typical, f"{name}: the specific force", must, f"a median of {-up:.3g}", remedy
    )


def check_corrections(corrections: LogCorrections, has_positions: bool) -> None:
    """Check that no correction needs a reference that the log does not have."""
    tables = {
        key: getattr(corrections, key) or {}
        for key in ("times", "scale", "bias", "shift_s", "level_axes")
    }
    unusable = [
        f"{key}.{name}"
        for key, names in tables.items()
        for name in names
        if name.startswith("reference") and not has_positions
    ]
    unusable += [
        name for name in ("attitude", "lever_arm") if getattr(corrections, name) is not None
    ]
    unusable += [
        f"drop={name}" for name in corrections.drop or () if name in ("outliers", "frozen")
    ]
    require(not unusable, "scenario.corrections", "not need a reference that the log lacks", ", ".join(unusable), _REMEDY)  # fmt: skip


def _join_fixes(fixes: GnssLog) -> ReferenceLog:
    """Return the usable fixes as a track without attitude, for the map and the start of the steps."""
    usable = np.isfinite(fixes.position).all(1)
    time, position = fixes.time[usable], fixes.position[usable]
    require(len(time) > 1, "the log", "have at least 2 usable fixes", len(time), "Check the column fix.")  # fmt: skip
    return ReferenceLog(time, np.full((len(time), 4), np.nan), np.gradient(position, time, axis=0), position)  # fmt: skip


def read_track(table: LogTable, centre: tuple[float, ...] | None) -> ReferenceLog:
    """Read a reference of positions; its velocities are those of the table, or the change of the positions."""
    time, position = read_times(table, longest=100.0), read_positions(table, centre)
    velocity = swap_frd_rfu(parse_numbers(table, _VELOCITY)) if table.has(_VELOCITY) else np.gradient(position, time, axis=0)  # fmt: skip
    return ReferenceLog(time, np.full((len(time), 4), np.nan), velocity, position)
