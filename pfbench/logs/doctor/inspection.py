"""Inspection of a folder: all checks, the noise of the sensors, and settings that mend what was named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.checks import WITHOUT_REFERENCE, run_checks
from pfbench.logs.doctor.finding import REFUSE, Finding, LogDiagnosis, merge_settings
from pfbench.logs.doctor.raw_log import RawImu, RawLog, take_log, take_rows
from pfbench.logs.doctor.sensor_grade import measure_noise
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.aligned_reader import check_aligned_tables, check_corrections
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.fix_codes import FixCodes, select_usable
from pfbench.logs.worlds.log_frames import (
    DEGREE,
    GEODETIC_COLUMNS,
    LOCAL_COLUMNS,
    find_origin,
    gravity_at,
    quaternion_of_angles,
)
from pfbench.logs.worlds.log_reader import Diagnosed, check_tables
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    ImuLog,
    LogFiles,
    LogTable,
    ReferenceLog,
    convert_column,
    list_tables,
    read_table,
    swap_frd_rfu,
)
from pfbench.nav import earth

_FORCE, _RATE, _ANGLES = ("fx", "fy", "fz"), ("wx", "wy", "wz"), ("roll", "pitch", "yaw")
_ROUNDS = 3  # of checks with the settings found so far
READER_CHECK = "reading"  # check of what the reader refuses itself
LogTables = tuple[LogTable, LogTable, LogTable | None]  # IMU, fixes and, if there is one, reference


@dataclass(frozen=True)
class LogSource:
    """Place of a log, and how it is read.

    Attributes:
        folder: Folder of the three tables.
        files: Names of the tables.
        path: Number of the flight, for tables with a column `path`.
        imu: Number of the sensor, for tables with a column `imu`.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0.
        limits: Limits of the platform.
        fix_codes: Meaning of the column `fix`, see `read_log`.
        corrections: Corrections before the checks.
    """

    folder: Path
    files: LogFiles = field(default_factory=LogFiles)
    path: int | None = None
    imu: int | None = None
    origin: Sequence[float] | None = None
    limits: PlausibleLimits | None = None
    fix_codes: FixCodes = None
    corrections: LogCorrections = field(default_factory=LogCorrections)

    def read_tables(self) -> LogTables:
        """Read the tables, without a check of their contents."""
        names, select = self.files, {"path": self.path, "imu": self.imu}
        inertial, gnss, *truth = (
            read_table(self.folder, name, select, self.limits)
            for name in (names.imu, names.gnss, names.reference)
            if name is not None
        )
        return inertial, gnss, truth[0] if truth else None

    def correct(self, tables: LogTables) -> tuple[LogTables, tuple[str, ...]]:
        """Return the tables with the corrections, without a check of their contents, and notes."""
        inertial, gnss, truth = tables
        (inertial, gnss, third), notes = self.corrections.correct_tables(inertial, gnss, truth or gnss)  # fmt: skip
        return (inertial, gnss, third if truth else None), notes

    def check_reading(
        self, tables: LogTables, mended: tuple[str, ...], diagnosis: Diagnosed
    ) -> str:
        """Check corrected tables as a run does; return the message if they are refused."""
        inertial, gnss, truth = tables
        try:
            if truth:
                log = check_tables((inertial, gnss, truth), mended, self.corrections, self.origin, self.limits, self.fix_codes, diagnosis)  # fmt: skip
            else:
                check_corrections(self.corrections, has_positions=False)
                log = check_aligned_tables(tables, mended, self.corrections, self.origin, self.fix_codes, diagnosis)  # fmt: skip
        except ValueError as error:
            return str(error)
        announce_notes(self.folder, log.notes)
        return ""

    def with_settings(self, settings: Mapping[str, Any]) -> LogSource:
        """Return the source with settings of a finding."""
        return replace(
            self,
            fix_codes=settings.get("fix_codes", self.fix_codes),
            corrections=replace(self.corrections, **settings.get("corrections", {})),
        )


def inspect_log(
    folder: str | Path,
    files: LogFiles | None = None,
    limits: PlausibleLimits | None = None,
    **options: Any,
) -> LogDiagnosis:
    """Inspect a log and name its faults.

    Args:
        folder: Folder of the tables.
        files: Names of the tables. None for the usual ones; the reference can be missing.
        limits: Limits of the platform. None for the default limits.
        **options: Other attributes of a source: path, imu, origin, fix_codes, corrections.

    Returns:
        Findings with evidence and remedy, facts, and the settings that mend the log.

    Raises:
        ValueError: If a table cannot be read at all.
    """
    usual = LogFiles()
    if not list_tables(str(folder), "", (usual.reference,)):
        usual = LogFiles(reference=None)
    source = LogSource(Path(folder), files or usual, limits=limits, **options)
    tables = source.read_tables()
    findings, facts = _inspect(source, tables)
    settings = merge_settings(finding.settings for finding in findings)
    checks = [finding.check for finding in findings if not finding.settings]
    for _ in range(_ROUNDS if settings else 0):
        remaining, _ = _inspect(source.with_settings(settings), tables)
        checks = [finding.check for finding in remaining]
        more = merge_settings([settings, *(finding.settings for finding in remaining)])
        if more == settings:
            break
        settings = more
    return LogDiagnosis(tuple(findings), facts, settings, tuple(checks))


def _inspect(source: LogSource, tables: LogTables) -> tuple[list[Finding], dict[str, Any]]:
    """Run all checks, and those of a run's reading."""
    tables, mended_notes = source.correct(tables)
    log = take_tables(tables, source)
    findings, facts, mended = run_checks(log)
    if len(log.reference.time):
        measure_noise(mended, facts)
    else:
        facts["checks without a reference"] = list(WITHOUT_REFERENCE)
    if not any(finding.level == REFUSE for finding in findings):
        message = source.check_reading(tables, mended_notes, Diagnosed(log, tuple(findings)))
        if message:
            findings.append(
                Finding(READER_CHECK, REFUSE, 1.0, 0.0, "refusals", message.rstrip("."))
            )
    return findings, facts


def take_tables(tables: tuple[LogTable, LogTable, LogTable | None], source: LogSource) -> RawLog:
    """Convert corrected tables without checks of their contents.

    Args:
        tables: Tables of IMU, fixes and reference, None for a log without one.
        source: How the log is read.

    Returns:
        The log.
    """
    inertial, gnss, truth = tables
    centre = find_origin(source.origin, gnss, truth or gnss)
    gravity, _ = gravity_at(centre)
    imu = ImuLog(_time(inertial), _vectors(inertial, _FORCE), _vectors(inertial, _RATE))
    position = _positions(gnss, centre)
    fixes = GnssLog(_time(gnss), position, np.full_like(position, np.nan))
    codes = None
    if "fix" in gnss.rows and source.fix_codes is None:
        codes = convert_column(gnss, "fix")
    elif "fix" in gnss.rows:
        usable, _ = select_usable(gnss, source.fix_codes)
        position[~usable] = np.nan
    if truth is None:
        log = take_log((inertial, gnss, gnss), imu, fixes, None, gravity)
        return log._replace(codes=codes, imu=RawImu(*take_rows(log.imu, np.isfinite(imu.time))))
    angles = _columns(truth, _ANGLES)
    velocity = _vectors(truth, ("vn", "ve", "vd") if "vn" in truth.rows else ("vn_d", "ve_d", "vd_d"))  # fmt: skip
    track = _positions(truth, centre)
    keep = np.isfinite(np.hstack([angles, velocity, track, _time(truth)[:, None]])).all(1)
    reference = ReferenceLog(
        _time(truth)[keep], quaternion_of_angles(*angles[keep].T), velocity[keep], track[keep]
    )
    if len(reference.time) > 1:
        fixes, _ = source.corrections.correct_fixes(fixes, reference, gnss.name)
    log = take_log((inertial, gnss, truth), imu, fixes, reference, gravity)
    return log._replace(
        reference=log.reference._replace(angles=angles[keep], rows=np.flatnonzero(keep)),
        codes=codes,
        imu=RawImu(*take_rows(log.imu, np.isfinite(imu.time))),
    )


def _time(table: LogTable) -> Array:
    return _columns(table, ("t",))[:, 0]


def _columns(table: LogTable, columns: Sequence[str]) -> Array:
    """Convert columns to numbers, [n, k], NaN where there is none."""
    missing = [column for column in columns if column not in table.rows]
    if missing:
        raise ValueError(
            f"{table.name} must have a column {', '.join(missing)}, got "
            f"{', '.join(map(str, table.rows.columns))}. Rename the columns, or map them with pfbench import."
        )
    return np.stack([convert_column(table, column) for column in columns], -1)


def _vectors(table: LogTable, columns: Sequence[str]) -> Array:
    return swap_frd_rfu(_columns(table, columns))


def _positions(table: LogTable, centre: tuple[float, ...] | None) -> Array:
    """Convert positions to East, North, Up, m, [n, 3]."""
    if table.has(LOCAL_COLUMNS) or not table.has(GEODETIC_COLUMNS):
        return _vectors(table, LOCAL_COLUMNS)
    scale = np.array([DEGREE, DEGREE, 1.0])
    at = torch.from_numpy(_columns(table, GEODETIC_COLUMNS) * scale)
    return earth.local_enu(at, torch.from_numpy(np.array(centre) * scale)).numpy()
