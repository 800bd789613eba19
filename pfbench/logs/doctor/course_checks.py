"""Check of the gyro against the course of the fixes, which needs no reference."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.finding import WARN, Finding, Picture, thin_curve
from pfbench.logs.doctor.raw_log import RawLog, interpolate_columns
from pfbench.logs.doctor.thresholds import STANDARD_ERRORS, limit_of
from pfbench.logs.doctor.turn_search import integrate

_LEG, _LONGEST = 10.0, 15.0  # m between fixes that give a course, and s at most
_FEWEST, _LEAST_TURN = 8, 0.15  # pairs of legs, and rad RMS between them
_DEGREES = 57.3


def check_course(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check that the course turns as the gyro about the downward axis, for a vehicle that drives forward."""
    legs = _list_legs(log)
    if len(legs) < 2:
        return
    middle, course = legs.T
    angle = integrate(log.imu.time, log.imu.rate[:, 2:])
    turned = np.diff(interpolate_columns(middle, log.imu.time, angle)[:, 0])
    changed = (np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi
    near = np.diff(middle) <= _LONGEST
    turned, changed = turned[near], changed[near]
    square = float(np.square(turned).sum())
    if len(turned) < _FEWEST or square < len(turned) * _LEAST_TURN**2:
        return
    slope = float(turned @ changed) / square
    error = float(np.sqrt(np.square(turned * (changed - slope * turned)).sum())) / square
    facts["turn of the course over that of the gyro"] = round(slope, 3)
    if abs(slope - 1.0) <= max(limit_of("turn of the course"), STANDARD_ERRORS * error):
        return
    is_degrees = abs(slope * _DEGREES - 1.0) < limit_of("turn of the course")
    at = middle[1:][near]
    yield Finding(
        "turn of the course", WARN, abs(slope - 1.0), limit_of("turn of the course"), "1",
        f"{log.names[1]}: the course of the fixes turns {slope:.3f} times (standard error {error:.3f}) as much as the "
        f"rate wz of {log.names[0]}",
        "Multiply by 0.0174532925, or set scenario.corrections.scale" if is_degrees else "",
        {"corrections": {"scale": {"imu": dict.fromkeys(("wx", "wy", "wz"), np.pi / 180.0)}}} if is_degrees else {},
        ("wx, wy, wz in deg/s",) if is_degrees else (
            "another sign or axis of the rate", "clocks that differ", "a vehicle that does not drive along its forward axis",
        ),
        Picture("t [s]", "turn [rad]", (thin_curve("gyro", at, turned), thin_curve("course", at, changed))),
    )  # fmt: skip


def _list_legs(log: RawLog) -> Array:
    """Return middle time, s, and course, rad, of the legs between fixes that are far enough apart, [n, 2]."""
    time, position = log.fixes.time, log.fixes.position[:, :2]
    inside = (time >= log.imu.time[0]) & (time <= log.imu.time[-1])
    time, position = time[inside], position[inside]
    legs, last = [], 0
    for i in range(1, len(time)):
        step = position[i] - position[last]
        if np.hypot(*step) < _LEG and time[i] - time[last] <= _LONGEST:
            continue
        if time[i] - time[last] <= _LONGEST:
            legs.append((0.5 * (time[i] + time[last]), np.arctan2(step[1], step[0])))
        last = i
    return np.array(legs).reshape(-1, 2)
