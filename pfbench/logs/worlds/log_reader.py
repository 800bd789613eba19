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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.checks import run_checks
from pfbench.logs.doctor.finding import REFUSE, Finding
from pfbench.logs.doctor.raw_log import (
    NO_REFERENCE,
    RawFixes,
    RawImu,
    RawLog,
    RawReference,
    take_rows,
)
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.corrections import LogCorrections, LogTables
from pfbench.logs.worlds.fix_codes import FixCodes, select_usable
from pfbench.logs.worlds.imu_gaps import GAP_SAMPLES, bridge_gaps
from pfbench.logs.worlds.log_agreement import (
    compare_fixes,
    compare_velocities,
    drop_fixes,
)
from pfbench.logs.worlds.log_frames import (
    find_origin,
    gravity_at,
    quaternion_of_angles,
    read_positions,
)
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    ImuLog,
    LogFiles,
    LogTable,
    NavigationLog,
    ReferenceLog,
    check_changes,
    check_seconds,
    convert_column,
    convert_columns,
    parse_numbers,
    read_table,
    read_times,
    swap_frd_rfu,
)
from pfbench.logs.worlds.time_order import check_overlap, check_time_order

_OF_FIXES = ("lever arm", "fix shift")
_FORCE, _RATE, _ANGLES = ("fx", "fy", "fz"), ("wx", "wy", "wz"), ("roll", "pitch", "yaw")
_VELOCITY, _DERIVED = ("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d")
_REMEDY = "Leave these out. A lever arm is a key of scenario.constraints, too."


@dataclass(frozen=True)
class LogSource:
    """Place of a log, and how it is read.

    Attributes:
        folder: Folder of the tables.
        files: Names of the tables; the reference can be missing.
        path: Number of the flight, for tables with a column `path`.
        imu: Number of the sensor, for tables with a column `imu`.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0. Required only if one table has lat_deg,
            another has pn, and the metadata of the files do not contain it.
        limits: Limits of the platform. None for the default limits.
        fix_codes: Meaning of the column `fix` of the fixes. It is the program that wrote it (nmea, rtklib,
            mavlink, ublox), or the codes of the fixes to use. None for 1 (use) and 0.
        corrections: Corrections that are applied before the checks. None for none.
        has_attitude: Whether the reference has an attitude. Without one it gives positions at most.
    """

    folder: Path
    files: LogFiles = field(default_factory=LogFiles)
    path: int | None = None
    imu: int | None = None
    origin: Sequence[float] | None = None
    limits: PlausibleLimits | None = None
    fix_codes: FixCodes = None
    corrections: LogCorrections | None = None
    has_attitude: bool = True

    @property
    def mending(self) -> LogCorrections:
        """Corrections; none by default."""
        return self.corrections or LogCorrections()

    def with_settings(self, settings: Mapping[str, Any]) -> LogSource:
        """Return the source with settings of a finding."""
        corrections = replace(self.mending, **settings.get("corrections", {}))
        return replace(self, fix_codes=settings.get("fix_codes", self.fix_codes), corrections=corrections)  # fmt: skip

    def read_tables(self) -> LogTables:
        """Read the tables, without a check of their contents."""
        names, select = self.files, {"path": self.path, "imu": self.imu}
        names_read = [names.imu, names.gnss, names.reference]
        if names.reference is None and not self.has_attitude:
            names_read.pop()
        inertial, gnss, *truth = (
            read_table(self.folder, n, select, self.limits) for n in names_read
        )
        return inertial, gnss, truth[0] if truth else None

    def read(self) -> NavigationLog:
        """Read and check the log, and announce its notes."""
        log = self.check(*self.mending.correct_tables(*self.read_tables()))
        announce_notes(self.folder, log.notes)
        return log

    def take(self, tables: LogTables) -> RawLog:
        """Convert corrected tables without checks of their contents."""
        inertial, gnss, truth = tables
        centre = find_origin(self.origin, gnss, truth or gnss)
        samples = convert_columns(inertial, ("t", *_FORCE, *_RATE))
        imu = RawImu(samples[:, 0], samples[:, 1:4], samples[:, 4:], np.arange(len(samples)))
        time, codes = convert_columns(gnss, ("t",))[:, 0], None
        position = swap_frd_rfu(read_positions(gnss, centre, convert_columns))
        if "fix" in gnss.rows and self.fix_codes is None:
            codes = convert_column(gnss, "fix")
        elif "fix" in gnss.rows:
            position[~select_usable(gnss, self.fix_codes)[0]] = np.nan
        reference = NO_REFERENCE
        if truth and self.has_attitude:
            columns = _VELOCITY if "vn" in truth.rows else _DERIVED
            track = swap_frd_rfu(read_positions(truth, centre, convert_columns))
            values = np.hstack([convert_columns(truth, ("t", *_ANGLES, *columns)), track])
            rows = np.flatnonzero(np.isfinite(values).all(1))
            t, angles, velocity, track = np.split(values[rows], [1, 4, 7], axis=1)
            reference = RawReference(t[:, 0], angles, velocity, track, rows)
        if len(reference.time) > 1:
            motion = ReferenceLog(reference.time, quaternion_of_angles(*angles.T), swap_frd_rfu(velocity), swap_frd_rfu(track))  # fmt: skip
            fixes = GnssLog(time, swap_frd_rfu(position), np.full_like(position, np.nan))
            position = swap_frd_rfu(self.mending.correct_fixes(fixes, motion, gnss.name)[0].position)  # fmt: skip
        usable = np.flatnonzero(np.isfinite(position).all(1))
        return RawLog(
            take_rows(imu, np.isfinite(imu.time)), RawFixes(time[usable], position[usable], usable), reference,
            gravity_at(centre)[0], (inertial.name, gnss.name, (truth or gnss).name),
            (inertial.row, gnss.row, (truth or gnss).row), codes,
        )  # fmt: skip

    def check(
        self,
        tables: LogTables,
        mended: tuple[str, ...],
        findings: Sequence[Finding] | None = None,
    ) -> NavigationLog:
        """Check corrected tables, and correct their fixes.

        Returns the log. `mended` are the notes of the corrections, and `findings` those of the same tables, which are
        then not looked for again.
        """
        inertial, gnss, truth = tables
        sensors, notes = read_samples(inertial)
        if not self.has_attitude:
            check_corrections(self.mending, truth is not None)
            check_level(sensors.force, inertial.name)
        centre = find_origin(self.origin, gnss, truth or gnss)
        usable, usable_notes = select_usable(gnss, self.fix_codes)
        fixes = read_fixes(gnss, centre, usable)
        motion = read_motion_log(truth, centre) if truth and self.has_attitude else None
        fixes, mended_fixes = self.mending.correct_fixes(fixes, motion, gnss.name)
        spans = [(inertial.name, sensors.time), (gnss.name, fixes.time)]
        spans += [(truth.name, motion.time)] if truth and motion else []
        for name, time in spans[1:]:
            check_overlap(inertial.name, sensors.time, name, time)
        gravity, gravity_notes = gravity_at(centre)
        fixes, rows = self._compare_tables(tables, fixes, motion, findings)
        if "frozen" in (self.mending.drop or ()):  # steps end on fixes that are there
            is_fix = np.isfinite(fixes.position).all(1)
            fixes = GnssLog(*(column[is_fix] for column in fixes))
        dropped = dict.fromkeys(note for table in tables if table for note in table.notes)
        notes = (*dropped, *mended, *mended_fixes, *usable_notes, *notes, *gravity_notes, *rows)
        reference = motion or (read_track(truth, centre) if truth else _join_fixes(fixes))
        return NavigationLog(sensors, fixes, reference, gravity, notes, centre)

    def _compare_tables(
        self,
        tables: LogTables,
        fixes: GnssLog,
        motion: ReferenceLog | None,
        findings: Sequence[Finding] | None,
    ) -> tuple[GnssLog, tuple[str, ...]]:
        """Return the fixes to use, and notes of what disagrees: in a whole table first, since it spoils single rows, too."""
        _, gnss, truth = tables
        limits = self.limits or PlausibleLimits()
        rows: tuple[str, ...] = ()
        left_out: tuple[str, ...] = ()
        if truth and motion:
            rows = compare_velocities(truth, motion)
            fixes, left_out = drop_fixes(gnss, fixes, motion, limits)
        if findings is None or left_out:
            raw = self.take(tables)
            keep = np.isfinite(fixes.position[raw.fixes.rows, 0])
            findings, _, _ = run_checks(raw._replace(fixes=take_rows(raw.fixes, keep)))
        refused = next((finding.text for finding in findings if finding.level == REFUSE), "")
        remedy = "See all findings with pfbench inspect."
        require(not refused, "the log", "agree in itself", refused.removesuffix("."), remedy)
        # fixes of the reference do not have a lever arm or a shift, and the reader notes the gaps that it bridges
        silent = {"imu gap", *(_OF_FIXES if truth and gnss.name == truth.name else ())}
        diagnosed = (f"{f.check}: {f.text}" for f in findings if f.check not in silent)
        if truth and motion:
            rows += compare_fixes(gnss, fixes, motion, limits)
        return fixes, (*left_out, *rows, *diagnosed)


def read_log(folder: str | Path, files: LogFiles | None = None, **options: Any) -> NavigationLog:
    """Read and check the log in a folder.

    Args:
        folder: Folder of the three tables.
        files: Names of the tables.
        **options: Other attributes of a source: path, imu, origin, limits, fix_codes, corrections, has_attitude.

    Returns:
        The log in right-forward-up and East-North-Up axes. Without an attitude its reference has none, and without a
        reference it is the track of the fixes.

    Raises:
        ValueError: If a check or the diagnosis refuses the log. The message names file, column, row, value and remedy.
    """
    return LogSource(Path(folder), files or LogFiles(), **options).read()


def read_samples(table: LogTable) -> tuple[ImuLog, tuple[str, ...]]:
    """Read and check the IMU samples."""
    time, notes = _imu_time(table)
    samples = parse_numbers(table, (*_FORCE, *_RATE))
    check_changes(table, (*_FORCE, *_RATE), time, samples)
    force, rate = (swap_frd_rfu(columns) for columns in np.hsplit(samples, 2))
    imu, (start, longest, count) = bridge_gaps(ImuLog(time, force, rate))
    if count:
        notes += (
            f"{table.name}: {count} intervals are longer than {GAP_SAMPLES:g} samples, the longest with {longest:.3f} s "
            f"after t = {start:.3f}. They were filled with a line and noise of the samples before",
        )
    return imu, notes


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
    check_time_order(table.name, time, table.row)
    check_seconds(table, time, longest=0.5)
    return time, notes


def read_fixes(
    table: LogTable, origin: tuple[float, ...] | None, usable: NDArray[np.bool_]
) -> GnssLog:
    """Read fixes in East, North, Up from the origin; NaN where they are not usable."""
    time, position = read_times(table, longest=100.0), read_positions(table, origin)
    recorded = table.has(_VELOCITY)
    columns = _VELOCITY if recorded else _DERIVED
    velocity = np.full_like(position, np.nan)
    if recorded or table.has(_DERIVED):
        velocity = swap_frd_rfu(parse_numbers(table, columns))
    position[~usable], velocity[~usable] = np.nan, np.nan
    return GnssLog(time, position, velocity)


def read_motion_log(
    table: LogTable, origin: tuple[float, ...] | None, longest: float = 100.0
) -> ReferenceLog:
    """Read a reference with attitude in East, North, Up from the origin; longest is of the median interval, s."""
    time = read_times(table, longest)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    q = quaternion_of_angles(*parse_numbers(table, _ANGLES).T)
    columns = _DERIVED if derived else _VELOCITY
    velocity = swap_frd_rfu(parse_numbers(table, columns))
    check_changes(table, columns, time, swap_frd_rfu(velocity))
    return ReferenceLog(time, q, velocity, read_positions(table, origin))


# --------------------------------------------------------------------------------------------------
# Logs without an attitude of the reference.


def check_level(force: Array, name: str) -> None:
    """Check that the specific force is upward for most of the time, which a course cannot show.

    Shapes: force [n, 3], right, forward, up.
    """
    middle, names = swap_frd_rfu(np.median(force, axis=0)), "xyz"
    axis, typical = int(np.abs(middle).argmax()), float(np.median(np.linalg.norm(force, axis=1)))
    down = f"{'-' * bool(middle[axis] > 0.0)}{names[axis]}"
    remedy = f"Gravity lies on f{names[axis]}: set +scenario.corrections.mounting.imu with {down} as its third axis, which is down."
    if down == "-z":
        remedy = "Axes forward, left, up need +scenario.corrections.mounting.imu=[x,-y,-z]; see pfbench inspect."
    require(
        middle[2] < -0.5 * typical,
        f"{name}: the specific force",
        "be about -9.8 on fz for most of the time, in axes forward, right, down",
        f"a median of {middle[2]:.3g}",
        remedy,
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
