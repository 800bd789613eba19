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

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.checks import run_checks
from pfbench.logs.doctor.finding import REFUSE, Finding
from pfbench.logs.doctor.raw_log import RawLog, take_log
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.fix_codes import FixCodes, select_usable
from pfbench.logs.worlds.imu_gaps import GAP_SAMPLES, LONGEST_BRIDGE, bridge_gaps
from pfbench.logs.worlds.log_agreement import (
    compare_fixes,
    compare_inertial,
    compare_times,
    compare_velocities,
    drop_fixes,
)
from pfbench.logs.worlds.log_checks import check_overlap
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
    check_increasing,
    check_seconds,
    parse_numbers,
    read_table,
    read_times,
    swap_frd_rfu,
)

_OF_FIXES = ("lever arm", "fix shift")  # a reference that also gives the fixes has none
_VELOCITY, _DERIVED = ("vn", "ve", "vd"), ("vn_d", "ve_d", "vd_d")


def read_log(
    folder: str | Path,
    files: LogFiles | None = None,
    path: int | None = None,
    imu: int | None = None,
    origin: Sequence[float] | None = None,
    limits: PlausibleLimits | None = None,
    fix_codes: FixCodes = None,
    corrections: LogCorrections | None = None,
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
        corrections: Corrections that are applied before the checks. None for none.

    Returns:
        The log in right-forward-up and East-North-Up axes.

    Raises:
        ValueError: If a check or the diagnosis refuses the log. The message names file, column, row, value and remedy.
    """
    tables = read_tables(folder, files or LogFiles(), path, imu, limits)
    mending = corrections or LogCorrections()
    log = check_tables(*mending.correct_tables(*tables), mending, origin, limits, fix_codes)
    announce_notes(folder, log.notes)
    return log


def read_tables(
    folder: str | Path,
    files: LogFiles,
    path: int | None = None,
    imu: int | None = None,
    limits: PlausibleLimits | None = None,
) -> tuple[LogTable, LogTable, LogTable]:
    """Read the tables of IMU, fixes and reference without a check of their contents; the arguments are those of `read_log`.

    Returns the tables.
    """
    inertial, gnss, truth = (
        read_table(Path(folder), name, {"path": path, "imu": imu}, limits)
        for name in (files.imu, files.gnss, files.reference)
    )
    return inertial, gnss, truth


def check_tables(
    tables: tuple[LogTable, LogTable, LogTable],
    mended: tuple[str, ...],
    mending: LogCorrections,
    origin: Sequence[float] | None = None,
    limits: PlausibleLimits | None = None,
    fix_codes: FixCodes = None,
    diagnosis: Diagnosed | None = None,
) -> NavigationLog:
    """Check corrected tables, and correct their fixes; the other arguments are those of `read_log`.

    Returns the log. `mended` are the notes of the corrections, and `diagnosis` are findings of the same rows, which
    are then not looked for again.
    """
    inertial, gnss, truth = tables
    sensors, notes = read_samples(inertial)
    centre = find_origin(origin, gnss, truth)
    usable, usable_notes = select_usable(gnss, fix_codes)
    fixes, reference = read_fixes(gnss, centre, usable), _motion(truth, centre)
    fixes, mended_fixes = mending.correct_fixes(fixes, reference, gnss.name)
    for name, time in ((gnss.name, fixes.time), (truth.name, reference.time)):
        check_overlap(inertial.name, sensors.time, name, time)
    gravity, gravity_notes = gravity_at(centre)
    rows = compare_velocities(truth, reference)
    fixes, left_out = drop_fixes(gnss, fixes, reference, limits or PlausibleLimits())
    # faults of a whole table first: they spoil single rows, too
    raw = take_log((inertial, gnss, truth), sensors, fixes, reference, gravity)
    angles = parse_numbers(truth, ("roll", "pitch", "yaw"))  # not within a turn, as degrees are not
    raw = raw._replace(reference=raw.reference._replace(angles=angles))
    diagnosed = diagnose(raw, has_own_fixes=gnss.name != truth.name, diagnosis=diagnosis)
    rows += compare_inertial(truth, sensors, reference, gravity)
    rows += compare_fixes(gnss, fixes, reference, limits or PlausibleLimits())
    dropped = dict.fromkeys(note for table in (inertial, gnss, truth) for note in table.notes)
    notes = (*dropped, *mended, *mended_fixes, *usable_notes, *notes, *gravity_notes, *left_out)
    spans = ((inertial.name, sensors.time), (gnss.name, fixes.time), (truth.name, reference.time))
    notes = (*notes, *rows, *diagnosed, *compare_times(spans))
    return NavigationLog(sensors, fixes, reference, gravity, notes, centre)


class Diagnosed(NamedTuple):
    """A log and what its checks found."""

    log: RawLog
    findings: Sequence[Finding]

    def has_rows_of(self, log: RawLog) -> bool:
        """Return whether another reading of the tables has the same samples and fixes."""
        pairs = zip(self.log.imu[:3] + self.log.fixes[:2], log.imu[:3] + log.fixes[:2], strict=True)
        same = all(np.array_equal(a, b) for a, b in pairs)
        return same and np.array_equal(self.log.reference.time, log.reference.time)


def diagnose(
    log: RawLog, *, has_own_fixes: bool, diagnosis: Diagnosed | None = None
) -> tuple[str, ...]:
    """Return the findings of the quick checks as notes; raise those that refuse the log."""
    findings = (
        diagnosis.findings if diagnosis and diagnosis.has_rows_of(log) else run_checks(log)[0]
    )
    refused = [finding for finding in findings if finding.level == REFUSE]
    if refused:
        raise ValueError(
            f"the log must agree in itself, got: {refused[0].text} See all findings with pfbench inspect."
        )
    return tuple(
        f"{finding.check}: {finding.text}"
        for finding in findings
        if has_own_fixes or finding.check not in _OF_FIXES
    )


def read_samples(table: LogTable) -> tuple[ImuLog, tuple[str, ...]]:
    """Read and check the IMU samples."""
    time, notes = _imu_time(table)
    force, rate = (
        parse_numbers(table, ("fx", "fy", "fz")),
        parse_numbers(table, ("wx", "wy", "wz")),
    )
    check_changes(table, ("fx", "fy", "fz", "wx", "wy", "wz"), time, np.hstack([force, rate]))
    imu, (start, longest, count) = bridge_gaps(
        ImuLog(time, swap_frd_rfu(force), swap_frd_rfu(rate))
    )
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
    check_increasing(table, time)
    check_seconds(table, time, longest=0.5)
    step = np.diff(time)
    i = int(step.argmax())
    if step[i] > max(LONGEST_BRIDGE, GAP_SAMPLES * typical):
        raise ValueError(
            f"{table.name} must not have gaps, got a gap of {step[i]:.3f} s after {table.row(i)} "
            f"(t = {time[i]}), with samples every {typical:.4f} s. "
            f"{_longest_part(table, time, step > max(LONGEST_BRIDGE, GAP_SAMPLES * typical))}"
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


def _motion(table: LogTable, origin: tuple[float, ...] | None) -> ReferenceLog:
    time = read_times(table, longest=100.0)
    derived = "vn" not in table.rows and "vn_d" in table.rows
    q = quaternion_of_angles(*parse_numbers(table, ("roll", "pitch", "yaw")).T)
    columns = _DERIVED if derived else _VELOCITY
    velocity = swap_frd_rfu(parse_numbers(table, columns))
    check_changes(table, columns, time, swap_frd_rfu(velocity))
    return ReferenceLog(
        time,
        q,
        velocity,
        read_positions(table, origin),
    )
