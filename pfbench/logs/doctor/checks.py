"""All checks of a log in their order: clocks, samples, units, alignment, force, reference, fixes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from pfbench.logs.doctor.alignment import align_clocks
from pfbench.logs.doctor.bad_samples import check_repeated_columns, check_samples
from pfbench.logs.doctor.clock_checks import check_clocks, sort_tables
from pfbench.logs.doctor.course_checks import check_course
from pfbench.logs.doctor.finding import Finding
from pfbench.logs.doctor.fix_checks import check_codes, check_fixes
from pfbench.logs.doctor.force_unit import check_force_unit
from pfbench.logs.doctor.force_windows import integrate_force
from pfbench.logs.doctor.raw_log import RawLog, dcm_of
from pfbench.logs.doctor.reference_checks import check_reference, check_rows
from pfbench.logs.doctor.specific_force import check_force_and_rate

FEWEST_ROWS = 10  # of a table
# checks that need no reference; the others compare IMU or fixes with it
WITHOUT_REFERENCE = (
    "time order", "repeated times", "repeated column", "imu gap", "imu jitter", "imu rate", "fix hole", "absurd samples", "stuck samples",
    "dead axis", "saturated axis", "spikes", "unit of force", "fix codes", "turn of the course",
)  # fmt: skip


def run_checks(log: RawLog) -> tuple[list[Finding], dict[str, Any], RawLog]:
    """Run all checks of a log with times in any order; without a reference those of `WITHOUT_REFERENCE`.

    Returns findings, facts and the log with what the checks mended for each other.
    """
    facts: dict[str, Any] = {}
    findings = [*check_clocks(log, facts), *check_repeated_columns(log)]
    log = sort_tables(log)
    reference, more = check_rows(log.names[2], log.reference, log.describe_row[2])
    log, findings = log._replace(reference=reference), [*findings, *more]
    if len(log.imu.time) < FEWEST_ROWS or 0 < len(log.reference.time) < FEWEST_ROWS:
        return findings, facts, log
    log, more = check_samples(log, facts)
    findings += more
    if not len(log.reference.time):
        log, more = check_force_unit(log, None, facts)
        return [*findings, *more, *check_codes(log), *check_course(log, facts)], facts, log
    aligned, more = align_clocks(log, facts)
    findings += more
    log = aligned.log if aligned else log
    reference, more = check_reference(log.names[2], log.reference, facts)
    log, findings = log._replace(reference=reference), [*findings, *more]
    windows = integrate_force(log, dcm_of(log.reference.angles), aligned.offset if aligned else 0.0)
    log, more = check_force_unit(log, windows, facts)
    findings += more
    if aligned:
        log, more = check_force_and_rate(replace(aligned, log=log), facts)
        findings += more
    findings += check_fixes(log, facts)
    return findings, facts, log
