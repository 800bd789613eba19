"""All checks of a log in their order: clocks, samples, units, alignment, force, reference, fixes."""

from __future__ import annotations

from typing import Any

import numpy as np

from pfbench.logs.doctor.alignment import align_clocks
from pfbench.logs.doctor.bad_samples import check_samples
from pfbench.logs.doctor.clock_checks import check_clocks, sort_tables
from pfbench.logs.doctor.course_checks import check_course
from pfbench.logs.doctor.finding import REFUSE, Finding, Picture, thin_curve
from pfbench.logs.doctor.fix_checks import check_codes, check_fixes
from pfbench.logs.doctor.raw_log import RawLog
from pfbench.logs.doctor.reference_checks import check_reference
from pfbench.logs.doctor.specific_force import check_force_and_rate
from pfbench.logs.doctor.thresholds import limit_of

_GRAVITY = 9.80665
_UNITS = {"in g": _GRAVITY, "in mg": 1e-3 * _GRAVITY, "in cm/s^2": 0.01}
_UNIT_ERROR = 0.25  # relative
FEWEST_ROWS = 10  # of a table
# checks that need no reference; the others compare IMU or fixes with it
WITHOUT_REFERENCE = (
    "time order", "repeated times", "imu gap", "imu jitter", "imu rate", "fix hole", "absurd samples", "stuck samples",
    "spikes", "unit of force", "fix codes", "turn of the course",
)  # fmt: skip


def run_checks(log: RawLog) -> tuple[list[Finding], dict[str, Any], RawLog]:
    """Run all checks of a log with times in any order; without a reference those of `WITHOUT_REFERENCE`.

    Returns findings, facts and the log with what the checks mended for each other.
    """
    facts: dict[str, Any] = {}
    findings = list(check_clocks(log, facts))
    log = sort_tables(log)
    if len(log.imu.time) < FEWEST_ROWS or 0 < len(log.reference.time) < FEWEST_ROWS:
        return findings, facts, log
    log, more = check_samples(log, facts)
    findings += more
    log, more = _check_force_unit(log, facts)
    findings += more
    if not len(log.reference.time):
        return [*findings, *check_codes(log), *check_course(log, facts)], facts, log
    aligned, more = align_clocks(log, facts)
    findings += more
    log = aligned.log if aligned else log
    log, more = check_reference(log, facts)
    findings += more
    if aligned:
        log, more = check_force_and_rate(aligned.over(log), facts)
        findings += more
    findings += check_fixes(log, facts)
    return findings, facts, log


def _check_force_unit(log: RawLog, facts: dict[str, Any]) -> tuple[RawLog, list[Finding]]:
    """Check the unit of the force by its median norm."""
    norm = float(np.median(np.linalg.norm(log.imu.force, axis=1)))
    facts["median force [m/s^2]"] = round(norm, 4)
    largest = limit_of("unit of force")
    if log.gravity / largest < norm < log.gravity * largest or norm == 0.0:
        return log, []
    unit = next((u for u, f in _UNITS.items() if abs(f * norm / log.gravity - 1.0) < _UNIT_ERROR), "in another unit")  # fmt: skip
    factor = _UNITS.get(unit, log.gravity / norm)
    size = np.linalg.norm(log.imu.force, axis=1)
    finding = Finding(
        "unit of force", REFUSE, norm / log.gravity, largest, "times gravity",
        f"{log.names[0]}: fx, fy, fz have a median norm of {norm:.3g}: they are {unit}",
        f"Multiply by {factor:.7g}, or set scenario.corrections.scale",
        {"corrections": {"scale": {"imu": dict.fromkeys(("fx", "fy", "fz"), factor)}}},
        ("another unit", "a linear acceleration without gravity"),
        Picture("t [s]", "norm of fx, fy, fz", (thin_curve(log.names[0], log.imu.time, size),)),
    )  # fmt: skip
    return log._replace(imu=log.imu._replace(force=log.imu.force * factor)), [finding]
