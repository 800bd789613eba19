"""Inspection of a folder: all checks, the noise of the sensors, and settings that mend what was named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.checks import WITHOUT_REFERENCE, run_checks
from pfbench.logs.doctor.finding import REFUSE, TELL, Finding, LogDiagnosis, merge_settings
from pfbench.logs.doctor.thresholds import limit_of
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.corrections import LogTables
from pfbench.logs.worlds.log_reader import LogSource
from pfbench.logs.worlds.log_tables import LogFiles, list_tables
from pfbench.logs.worlds.standing import measure_noise

_ROUNDS = 3  # of checks with the settings found so far
_SPOILS = {"slow errors", "heading", "repeated column", "dead axis", "saturated axis", "gyro bias drift", "accelerometer bias drift", "attitude jump"}  # fmt: skip  # what no setting mends, and what others are measured with
_RESTS = ("rest of the force", "rest of the rate")  # what a mended log may leave
READER_CHECK = "reading"  # check of what the reader refuses itself


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
    files = files or usual
    source = LogSource(Path(folder), files, limits=limits, has_attitude=files.reference is not None, **options)  # fmt: skip
    tables = source.read_tables()
    findings, facts = _inspect(source, tables)
    settings = merge_settings(finding.settings for finding in findings)
    checks = [finding.check for finding in findings if not finding.settings]
    for _ in range(_ROUNDS if settings else 0):
        remaining, rests = _inspect(source.with_settings(settings), tables)
        checks = [finding.check for finding in remaining]
        more = merge_settings([settings, *(finding.settings for finding in remaining)])
        if more == settings:
            break
        settings = more
    if settings and not _is_mended(findings, remaining, rests):
        withheld = "Nothing that was tried explains the log as a whole; tried: {}"
        findings = [f._replace(settings={}, remedy=withheld.format(dict(f.settings))) if f.settings else f for f in findings]  # fmt: skip
        settings = {}
    return LogDiagnosis(tuple(findings), facts, settings, tuple(checks))


def _is_mended(
    findings: Sequence[Finding], remaining: Sequence[Finding], rests: Mapping[str, Any]
) -> bool:
    """Return whether a log with all settings is refused no more, and is as good as a clean one."""
    if any(rests.get(name, 0.0) > limit_of(name) for name in _RESTS):
        return False
    unmended = {finding.check for finding in findings if not finding.settings} - _SPOILS
    return all(f.level == TELL or (f.level != REFUSE and f.check in unmended) for f in remaining)


def _inspect(source: LogSource, tables: LogTables) -> tuple[list[Finding], dict[str, Any]]:
    """Run all checks, and those of a run's reading."""
    tables, mended_notes = source.mending.correct_tables(*tables)
    log = source.take(tables)
    findings, facts, mended = run_checks(log)
    if len(log.reference.time):
        measure_noise(mended, facts)
    else:
        facts["checks without a reference"] = list(WITHOUT_REFERENCE)
    if not any(finding.level == REFUSE for finding in findings):
        try:
            announce_notes(source.folder, source.check(tables, mended_notes, findings).notes)
        except ValueError as error:
            text = str(error).rstrip(".")
            findings.append(Finding(READER_CHECK, REFUSE, 1.0, 0.0, "refusals", text))
    return findings, facts
