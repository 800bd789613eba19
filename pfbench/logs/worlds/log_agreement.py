"""Agreement of IMU, fixes, wheels, satellites and reference of a log.

A difference that no sensor can explain is an error. A smaller one, which can be a measurement error,
stays in the data, and a note names its largest row. The file is long since all pairs of tables share
one rule for notes and errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    LogTable,
    ReferenceLog,
)
from pfbench.logs.worlds.time_grid import interpolate

_FIX_LIMITS = (2e3, 5e3, 1e4, 2e4, 5e4, 1e5)  # m; offered limits of the error of a fix
_STEADY = 2.0  # m/s; least speed at which the track turns as the car
_BRAKING, _SLOW = 10.0, 1.0  # m/s^2, hard braking on a road; m/s, noise of the wheels about zero
_LONGEST = 5.0  # s between compared epochs of satellites
_STRAIGHT = 1.5  # s; longest interval over which the velocity is taken as linear


class Agreement(NamedTuple):
    """Limits of a difference.

    Attributes:
        quantity: Name, with the compared tables.
        unit: Unit.
        noted: Difference beyond which a note names the row.
        largest: Difference beyond which the log is rejected.
        remedy: What to do then.
    """

    quantity: str
    unit: str
    noted: float
    largest: float
    remedy: str = "Correct this row, or check units, axes and clocks."


MOTION = Agreement("position change and integrated velocity of the reference", "m", 2.0, 200.0)
FIX_VELOCITY = Agreement("velocity of a fix and of the reference", "m/s", 5.0, math.inf)
WHEELS = Agreement("wheel speed and speed of the reference", "m/s", 3.0, 50.0)
YAW_RATE = Agreement("yaw rate and turn of the track", "rad/s", 1.0, 10.0)
_ROW = "Correct or remove this row."
LEAST_RADIUS, LARGEST_RADIUS = 2.2e7, 4.6e7  # m; perigee of E14 23.3e6, geostationary 42.2e6
_HALF = 0.5 * (LARGEST_RADIUS - LEAST_RADIUS)
ORBIT_RADIUS = Agreement(
    f"distance of sx, sy, sz from the centre of the Earth and {LEAST_RADIUS + _HALF:g} m",
    "m",
    _HALF,
    _HALF,
    _ROW,
)
ORBIT_STEP = Agreement(
    "position of a satellite and those of the neighbouring epochs", "m", 20.0, 20.0, _ROW
)
ORBIT_VELOCITY = Agreement(
    "velocity of a satellite and change of its position", "m/s", 20.0, 20.0, _ROW
)
RANGE = Agreement(
    "pseudorange and distance, without the common clock,",
    "m",
    200.0,
    math.inf,
    f"{_ROW[:-1]}, or set scenario.limits.fix_error_m.",
)
RATE = Agreement("range rate and motion, without the common clock,", "m/s", 20.0, 200.0, _ROW)
DIRECTION = Agreement("az, el and the direction of the satellite", "degrees", 1.0, math.inf)
COMMON_TIME = 2.0  # s at an end of a table that other tables do not cover, without a note


def compare_velocities(table: LogTable, reference: ReferenceLog) -> tuple[str, ...]:
    """Compare the changes of position between rows with the velocities; return notes."""
    dt = np.diff(reference.time)
    expected = 0.5 * dt[:, None] * (reference.velocity[1:] + reference.velocity[:-1])
    displacement = np.diff(reference.position, axis=0)
    # the error of the straight line grows with the square of the interval
    slack = np.maximum(1.0, dt / _STRAIGHT) ** 2
    difference = np.linalg.norm(displacement - expected, axis=1) / slack
    return _judge_rows(MOTION, difference, table, np.arange(1, len(reference.time)))


def find_far_fixes(
    fixes: GnssLog, reference: ReferenceLog, limits: PlausibleLimits, largest: float = 0.0
) -> NDArray[np.bool_]:
    """Find the fixes that are off by more than a distance, m, or than that of the limits, [m].

    Outside of the reference the change from the fix before is compared.
    """
    largest = largest or limits.fix_error_m
    error = np.linalg.norm(fixes.position - interpolate(reference, fixes.time)[:, 7:], axis=1)
    step = np.linalg.norm(np.diff(fixes.position, axis=0), axis=1)
    reach = limits.speed_m_s * np.diff(fixes.time) + 2.0 * largest
    # a jump after a wrong fix is not an error of the next one, which the reference confirms
    return (error > largest) | np.concatenate([[False], step > reach]) & np.isnan(error)


def drop_fixes(
    table: LogTable, fixes: GnssLog, reference: ReferenceLog, limits: PlausibleLimits
) -> tuple[GnssLog, tuple[str, ...]]:
    """Leave out wrong fixes if `limits.drop_fixes` says so and others remain.

    Returns the fixes, and notes.
    """
    wrong = find_far_fixes(fixes, reference, limits)
    if not (limits.drop_fixes and wrong.any() and np.isfinite(fixes.position[~wrong, 0]).any()):
        return fixes, ()
    position, velocity = (np.where(wrong[:, None], np.nan, column) for column in fixes[1:])
    text = f"{table.name}: {int(wrong.sum())} fixes dropped, the first off by {_describe_first(table, fixes, reference, wrong)}"
    return GnssLog(fixes.time, position, velocity), (text,)


def compare_fixes(
    table: LogTable, fixes: GnssLog, reference: ReferenceLog, limits: PlausibleLimits
) -> tuple[str, ...]:
    """Compare fixes with the reference, and outside of it with the previous fix; return notes."""
    wrong = find_far_fixes(fixes, reference, limits)
    remedy = "Check the origin, axes and clock of the fixes, which are wrong in most rows."
    if int(np.isfinite(fixes.position[~wrong, 0]).sum()) > int(wrong.sum()):
        remedy = "Correct or remove these rows, or set scenario.limits.drop_fixes=true."
    accepted = (f"{d:g}" for d in _FIX_LIMITS if not find_far_fixes(fixes, reference, limits, d).any())  # fmt: skip
    wider = next(accepted, "") if wrong.any() else ""
    require(
        not wrong.any(),
        f"{table.name}: fixes",
        f"be at most {limits.fix_error_m:g} m from the reference and from neighbouring fixes at {limits.speed_m_s:g} m/s",
        f"{_describe_first(table, fixes, reference, wrong)} ({int(wrong.sum())} such rows)",
        remedy + (f" If fixes can be so wrong, set scenario.limits.fix_error_m={wider}." if wider else ""),
    )  # fmt: skip
    true, rows = interpolate(reference, fixes.time), np.arange(len(fixes.time))
    off = np.nan_to_num(np.linalg.norm(fixes.velocity - true[:, 4:7], axis=1))
    return _judge_rows(FIX_VELOCITY, off, table, rows)


def _describe_first(
    table: LogTable, fixes: GnssLog, reference: ReferenceLog, wrong: NDArray[np.bool_]
) -> str:
    """Return error, or change outside of the reference, and row of the first wrong fix."""
    i = int(np.argmax(wrong))
    error = fixes.position[i] - interpolate(reference, fixes.time[i : i + 1])[0, 7:]
    change = error if np.isfinite(error).all() else fixes.position[i] - fixes.position[i - 1]
    return f"{np.linalg.norm(change):.0f} m in {table.row(i)}"


def compare_wheels(
    table: LogTable, speed: Array, yaw_rate: Array, reference: ReferenceLog
) -> tuple[str, ...]:
    """Compare wheel speed and yaw rate with the reference.

    Returns notes. Shapes: speed [T], yaw_rate [T].
    """
    east, north = reference.velocity[:, :2].T
    true_speed = np.hypot(east, north)
    rows, dt = np.arange(len(speed)), np.diff(reference.time)
    # the track changes with the heading while the car moves
    turn = np.angle(np.exp(1j * np.diff(np.arctan2(east, north)))) / dt
    steady = np.minimum(true_speed[1:], true_speed[:-1]) > _STEADY
    off = np.where(steady, np.abs(turn - 0.5 * (yaw_rate[1:] + yaw_rate[:-1])), 0.0)
    return (
        *_judge_rows(WHEELS, np.abs(np.abs(speed) - true_speed), table, rows),
        *_judge_rows(YAW_RATE, off, table, rows[1:]),
    )


def describe_missing_times(name: str, time: Array, steps: Array) -> tuple[str, ...]:
    """Name a table that does not cover the steps of a filter, or has a hole between them.

    A clock that jumps forward leaves a hole. The rows after it still agree with each other.

    Returns notes. Shapes: time [n], steps [T].
    """
    missing, interval = max(time[0] - steps[0], steps[-1] - time[-1]), np.diff(time)
    longest = COMMON_TIME + 2 * np.median(interval) if len(interval) else 0.0
    notes = []
    if missing > longest:
        notes.append(
            f"{name} covers t = {time[0]:.3f} to {time[-1]:.3f} s of steps from {steps[0]:.3f} to "
            f"{steps[-1]:.3f} s. Check the clock of t"
        )
    inside = (time[1:] > steps[0]) & (time[:-1] < steps[-1]) & (interval > longest)
    if inside.any():
        i, count = int(np.argmax(np.where(inside, interval, 0.0))), int(inside.sum())
        notes.append(
            f"{name} has {count} hole{'' if count == 1 else 's'} of more than {longest:.3g} s between steps, the longest "
            f"from t = {time[i]:.3f} to {time[i + 1]:.3f} s. Check the clock of t"
        )
    return tuple(notes)


def check_wheel_direction(table: LogTable, time: Array, speed: Array) -> tuple[str, ...]:
    """Check that the wheels stop before they reverse.

    The reference velocity of a road vehicle does not show whether it moves backwards.

    Returns a note if most of the drive is backwards. Shapes: time [T], speed [T].
    """
    change, largest = np.abs(np.diff(speed)), 2.0 * _SLOW + _BRAKING * np.diff(time)
    wrong = (speed[1:] * speed[:-1] < 0.0) & (change > largest)
    i = int(wrong.argmax())
    column, remedy = f"{table.name}: column v_fwd", "Correct the sign or remove this row."
    require(
        not wrong[i],
        column,
        "change its sign near zero",
        f"{speed[i + 1]:g} m/s after {speed[i]:g} m/s in {table.row(i + 1)} ({wrong.sum()} such rows)",
        remedy,
    )
    moving, backwards = int((np.abs(speed) > _SLOW).sum()), int((speed < -_SLOW).sum())
    if 2 * backwards <= moving:
        return ()
    return (
        f"{table.name}: the wheels turn backwards in {backwards} of {moving} moving rows. Check the sign of v_fwd",
    )


# --------------------------------------------------------------------------------------------------
# Agreement of recorded satellites, pseudoranges and range rates.
#
# A range can be off by a reflection, so it stays in the data up to the limit of a fix. A satellite
# moves smoothly, so its positions must agree.


def check_orbits(
    name: str, names: tuple[str, ...], time: Array, position: Array, velocity: Array | None = None
) -> None:
    """Check radius, smoothness and velocity of satellites.

    Shapes: time [K], position [K, S, 3], velocity [K, S, 3].
    """
    for s, satellite in enumerate(names):
        rows = np.flatnonzero(np.isfinite(position[:, s, 0]))
        p, t = position[rows, s], time[rows]
        radius = np.linalg.norm(p, axis=1)
        off = np.abs(radius - 0.5 * (LEAST_RADIUS + LARGEST_RADIUS))
        _judge(ORBIT_RADIUS, off, name, _sighting((satellite,), t))
        dt = np.diff(t)
        speed = np.diff(p, axis=0) / dt[:, None]
        # accelerations are below 1 m/s^2
        bend = np.linalg.norm(np.diff(speed, axis=0), axis=1) * np.minimum(dt[1:], dt[:-1])
        near = (dt[1:] <= _LONGEST) & (dt[:-1] <= _LONGEST)
        _judge(ORBIT_STEP, bend[near], name, _sighting((satellite,), t[1:-1][near]))
        if velocity is not None and len(t) > 1:
            mean = 0.5 * (velocity[rows, s][1:] + velocity[rows, s][:-1])
            off, near = np.linalg.norm(mean - speed, axis=1), dt <= _LONGEST
            _judge(ORBIT_VELOCITY, off[near], name, _sighting((satellite,), t[1:][near]))


def compare_ranges(
    name: str, names: tuple[str, ...], time: Array, residual: Array, limits: PlausibleLimits
) -> tuple[str, ...]:
    """Compare range residuals with the median of each epoch and system.

    Returns notes. Shapes: time [K], residual [K, S].
    """
    agreement = RANGE._replace(largest=limits.fix_error_m)
    return _judge(agreement, _without_clocks(names, residual), name, _sighting(names, time))


def compare_rates(
    name: str, names: tuple[str, ...], time: Array, residual: Array
) -> tuple[str, ...]:
    """Compare residuals of range rates with the median of each epoch and system.

    Returns notes. Shapes: time [K], residual [K, S].
    """
    return _judge(RATE, _without_clocks(names, residual), name, _sighting(names, time))


def compare_directions(
    name: str, names: tuple[str, ...], time: Array, azimuth: Array, elevation: Array
) -> tuple[str, ...]:
    """Compare recorded directions with those from the reference.

    Returns notes. Shapes: time [K], differences of azimuth and elevation [K, S].
    """
    # near the zenith the azimuth is free, and angles wrap
    off = np.nan_to_num(np.maximum(np.abs(np.sin(0.5 * azimuth)) * 2.0, np.abs(elevation)))
    return _judge(DIRECTION, np.degrees(off).ravel(), name, _sighting(names, time))


def _sighting(names: Sequence[str], time: Array) -> Callable[[int], str]:
    """Return a function that describes an entry of a flat array of epochs and satellites, [K * S]."""
    return lambda i: f"{names[i % len(names)]} at t = {time[i // len(names)]:.3f}"


def _without_clocks(names: Sequence[str], residual: Array) -> Array:
    """Return the sizes of residuals [K, S] without the median of each epoch and system, [K * S]; 0 where there is none."""
    off = np.zeros_like(residual)
    for system in sorted({satellite[0] for satellite in names}):
        columns = [i for i, satellite in enumerate(names) if satellite[0] == system]
        group = residual[:, columns]
        # the common clock of one satellite alone is not confirmed
        some = np.flatnonzero(np.isfinite(group).any(1))
        clock = np.nanmedian(group[some], axis=1)[:, None]
        off[some[:, None], columns] = np.nan_to_num(np.abs(group[some] - clock))
    return off.ravel()


def _judge_rows(agreement: Agreement, difference: Array, table: LogTable, rows: NDArray[np.intp]) -> tuple[str, ...]:  # fmt: skip
    """Reject, note or accept differences [n] at rows [n] of a table."""
    return _judge(agreement, difference, table.name, lambda i: table.row(int(rows[i])))


def _judge(agreement: Agreement, difference: Array, name: str, describe: Callable[[int], str]) -> tuple[str, ...]:  # fmt: skip
    """Reject, note or accept differences [n] of a table, whose places a function describes."""
    if not len(difference):
        return ()
    i, quantity, unit = int(np.argmax(difference)), agreement.quantity, agreement.unit
    value = f"{difference[i]:.3g} {unit} at {describe(i)}"
    require(
        difference[i] <= agreement.largest,
        f"{name}: {quantity}",
        f"agree to {agreement.largest:g} {unit}",
        value,
        agreement.remedy,
    )
    count = int((difference > agreement.noted).sum())
    if not count:
        return ()
    return (
        f"{name}: {quantity} differ by more than {agreement.noted:g} {unit} in {count} of {len(difference)} rows, "
        f"at most {value}",
    )
