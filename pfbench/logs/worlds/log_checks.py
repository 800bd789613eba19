"""Checks of units, axes and times of a navigation log."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch

from pfbench.core import chart
from pfbench.logs.worlds.dead_reckoning import integrate_windows
from pfbench.logs.worlds.log_tables import (
    Array,
    ImuLog,
    LogTable,
    ReferenceLog,
    parse_numbers,
)
from pfbench.logs.worlds.time_order import find_overlap_remedy
from pfbench.nav import earth
from pfbench.nav.strapdown import rotate

STANDARD_GRAVITY = 9.80665
_AGREEING_TURN = 0.3  # part of the rates of the reference that noise may leave [ours]
_DEGREE = math.pi / 180.0
_AGREEING_FORCE = 0.5  # part of the force that biases and vibration may hide [ours]
_LEAST_FORCE = 1.0  # m/s^2; a force that biases do not hide [ours]


def check_force(imu: ImuLog, reference: ReferenceLog, name: str) -> None:
    """Check unit, gravity and axes of the specific force."""
    typical = float(np.median(np.linalg.norm(imu.force, axis=1)))
    up = float(np.median(imu.force[:, 2]))
    has_gravity = 5.0 < typical < 20.0
    if has_gravity and up >= 0.5 * typical:
        return
    if has_gravity and _force_error(imu, reference) <= _AGREEING_FORCE:
        return  # not level for most of the time
    remedy = _find_force_remedy(imu, reference)
    if has_gravity and up >= -0.5 * typical and not remedy:
        return  # nothing is known to be wrong
    remedy = remedy or (
        "No other unit, sign or axes of fx, fy, fz agree with the reference. Check this table."
    )
    got = f"got a median norm of {typical:.3g} and a median fz of {-up:+.3g}"
    raise ValueError(
        f"{name}: fx, fy, fz must be the specific force in m/s^2, about 9.8 in size, and -9.8 on fz when "
        f"level (forward-right-down axes), {got}. {remedy}"
    )


_FORCE_REMEDIES: dict[str, tuple[Sequence[float], Sequence[float], float]] = {
    # signs of force and rate on right, forward, up, and the factor of the force
    f"They are in g: multiply by {STANDARD_GRAVITY}.": ((1, 1, 1), (1, 1, 1), STANDARD_GRAVITY),
    "The axes are forward-left-up: negate fy, fz, wy, wz.": ((-1, 1, -1), (-1, 1, -1), 1.0),
    "They have the other sign: negate fx, fy, fz.": ((-1, -1, -1), (1, 1, 1), 1.0),
    f"They are in g and forward-left-up: multiply by {STANDARD_GRAVITY}, and negate fy, fz, wy, wz.": (
        (-1, 1, -1), (-1, 1, -1), STANDARD_GRAVITY,
    ),
    f"They are in g and have the other sign: multiply by -{STANDARD_GRAVITY}.": (
        (-1, -1, -1), (1, 1, 1), STANDARD_GRAVITY,
    ),
}  # fmt: skip


def _find_force_remedy(imu: ImuLog, reference: ReferenceLog) -> str:
    """Return the change with which the velocity of the reference changes as the force says, or ''."""
    errors = {
        remedy: _force_error(
            imu._replace(
                force=factor * np.array(of_force) * imu.force, rate=np.array(of_rate) * imu.rate
            ),
            reference,
        )
        for remedy, (of_force, of_rate, factor) in _FORCE_REMEDIES.items()
    }
    for factor, unit in ((1.0, ""), (STANDARD_GRAVITY, f"multiply by {STANDARD_GRAVITY}, and ")):
        error = _force_error(imu._replace(force=factor * imu.force), reference, gravity=0.0)
        errors[_without_gravity(unit)] = error
    remedy = min(errors, key=lambda text: errors[text])
    return remedy if errors[remedy] <= _AGREEING_FORCE else ""


def _without_gravity(unit: str) -> str:
    g = STANDARD_GRAVITY
    return (
        "Gravity is missing, as in a linear acceleration. Record the specific force, or "
        f"{unit}add {g} sin(pitch) to fx, and subtract {g} cos(pitch) sin(roll) from fy and "
        f"{g} cos(pitch) cos(roll) from fz."
    )


def _force_error(imu: ImuLog, reference: ReferenceLog, gravity: float = STANDARD_GRAVITY) -> float:
    """Return the part of the force that the reference needs over about a second which the IMU does not show."""
    inside = (reference.time >= imu.time[0]) & (reference.time <= imu.time[-1])
    stride = max(1, round(1.0 / float(np.median(np.diff(reference.time)))))
    time = reference.time[inside][::stride]
    if len(time) < 3:
        return math.inf
    _, increment = integrate_windows(imu, time)
    q = torch.from_numpy(reference.attitude[inside][::stride][:-1])
    level = rotate(q, increment).numpy() / np.diff(time)[:, None] - [0.0, 0.0, gravity]
    change = np.diff(reference.velocity[inside][::stride], axis=0) / np.diff(time)[:, None]
    needed = float(np.median(np.linalg.norm(change + np.array([0.0, 0.0, gravity]), axis=1)))
    error = float(np.median(np.linalg.norm(change - level, axis=1)))
    return error / max(needed, _LEAST_FORCE)


def check_overlap(imu_name: str, imu_time: Array, name: str, time: Array) -> None:
    """Check that two tables have a common time.

    Shapes: imu_time [n], time [m].
    """
    if min(imu_time[-1], time[-1]) <= max(imu_time[0], time[0]):
        raise ValueError(
            f"{imu_name} and {name} must overlap in time, got t = {imu_time[0]:.3f} to "
            f"{imu_time[-1]:.3f} and t = {time[0]:.3f} to {time[-1]:.3f}. "
            f"{find_overlap_remedy(time, imu_time, name)}"
        )


def check_rotation(
    imu: ImuLog,
    reference: ReferenceLog,
    names: tuple[str, str],
    others: Callable[[], Mapping[str, ReferenceLog]],
    offset: str = "",
) -> None:
    """Compare angular rates with the reference.

    Rates of slow vehicles in deg/s pass all absolute limits.
    """
    rates = _mean_rates(imu, reference)
    if rates is None:
        return
    measured, true = rates
    if np.sqrt(np.mean(true**2)) < 0.02:
        return  # at low angular rates the comparison contains mostly noise
    slope = float((measured * true).sum() / (true * true).sum())
    if slope > 20.0 or slope < 0.05:
        raise ValueError(
            f"{names[0]} and {names[1]} must turn together, got rates wx, wy, wz of {slope:.3g} times "
            f"those of roll, pitch, yaw. {_find_turn_remedy(imu, reference, others(), offset)}"
        )


def _find_turn_remedy(
    imu: ImuLog, reference: ReferenceLog, others: Mapping[str, ReferenceLog], offset: str
) -> str:
    """Return the change with which IMU and reference turn together."""
    changes = {
        f"wx, wy, wz are in deg/s: multiply by {_DEGREE:.10f}.": (imu._replace(rate=_DEGREE * imu.rate), reference),
        "wx, wy, wz have the other sign: negate them.": (imu._replace(rate=-imu.rate), reference),
        "The gyroscope is forward-left-up: negate wy and wz.": (imu._replace(rate=imu.rate * [-1, 1, -1]), reference),
        **{text: (imu, variant) for text, variant in others.items()},
    }  # fmt: skip
    errors = {text: _turn_error(*pair) for text, pair in changes.items()}
    agreeing = [text for text, error in errors.items() if error <= _AGREEING_TURN]
    if agreeing:  # a heading and rates of the other sign turn alike, but the force differs
        return min(agreeing, key=lambda text: _force_error(*changes[text]))
    if offset:
        return f"{offset}."
    return (
        "No other unit or sign of either makes them agree. Check that axes are forward-right-down, yaw "
        "clockwise from North, and that both have the same clock."
    )


def _turn_error(imu: ImuLog, reference: ReferenceLog) -> float:
    """Return the part of the rates of the reference that those of the IMU do not explain."""
    rates = _mean_rates(imu, reference)
    if rates is None:
        return math.inf
    measured, true = rates
    return float(np.square(measured - true).sum() / np.square(true).sum())


def _mean_rates(imu: ImuLog, reference: ReferenceLog) -> tuple[Array, Array] | None:
    """Return mean angular rates of IMU and reference [n, 3] without their mean, None if few."""
    # longer intervals reduce the effect of the reference noise
    stride = max(1, round(0.25 / float(np.median(np.diff(reference.time)))))
    inside = (reference.time >= imu.time[0]) & (reference.time <= imu.time[-1])
    time, q = (
        reference.time[inside][::stride],
        torch.from_numpy(reference.attitude[inside][::stride]),
    )
    if len(time) < 10:
        return None
    inverse = q[:-1] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    true = chart.rotation_vector_from_quaternion(chart.quaternion_multiply(inverse, q[1:])).numpy()
    summed = np.cumsum(0.5 * np.diff(imu.time)[:, None] * (imu.rate[1:] + imu.rate[:-1]), axis=0)
    angle = np.vstack([np.zeros(3), summed])
    measured = np.diff(
        np.stack([np.interp(time, imu.time, column) for column in angle.T], axis=-1), axis=0
    )
    measured, true = (turn / np.diff(time)[:, None] for turn in (measured, true))
    # the mean contains the gyro bias
    return measured - measured.mean(axis=0), true - true.mean(axis=0)


# --------------------------------------------------------------------------------------------------
# Scale of one table against another. A wrong unit changes all rows alike, so that single rows look right.

WINDOW = 1.0  # s; tables are compared over windows of about this length
MIN_RMS_SPEED = 1.0  # m/s; smallest RMS velocity at which position and velocity have a common scale
MIN_RMS_TURN = 0.03  # rad; smallest RMS rotation in a window, about its mean, that shows a scale
FEWEST_WINDOWS = 5  # for a scale
CORRELATED = 0.95  # least correlation of a slow axis, whose slope noise reduces to 0.9 at most
SCALES = (0.7, 1.4)  # least and largest scale of one table against another


def check_position_scale(table: LogTable, time: Array, expected: Array, displacement: Array) -> None:  # fmt: skip
    """Check that displacements have the scale of the integrated velocities.

    A slow axis is judged only if both are correlated, since noise of the velocity reduces the slope.

    Shapes: expected [n, 3], displacement [n, 3].
    """
    window = ((time[1:] - time[0]) / WINDOW - 1e-9).astype(int)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    speeds = np.sqrt(np.square(expected / np.diff(time)[:, None]).mean(0))
    for axis, name in enumerate(("East", "North", "Up")):
        x, y = expected[:, axis], displacement[:, axis]
        if speeds[axis] < MIN_RMS_SPEED:
            x, y = np.add.reduceat(x, starts), np.add.reduceat(y, starts)
            if len(x) < FEWEST_WINDOWS or not _is_correlated(x, y):
                continue
        slope = float((x * y).sum() / (x * x).sum())
        if not SCALES[0] < slope < SCALES[1]:
            raise ValueError(
                f"{table.name}: the {name} position must change with the velocity, got {slope:.3g} "
                "times the change. Check units (m, m/s, deg), signs and order of the columns."
            )


def _is_correlated(x: Array, y: Array) -> bool:
    square = float((x * x).sum()) * float((y * y).sum())
    return abs(float((x * y).sum())) > CORRELATED * math.sqrt(square)


def check_turn_scale(table: LogTable, x: Array, y: Array, window: float) -> None:
    """Check that rotations of the reference have the scale of those of the IMU.

    Shapes: x [n, 3], y [n, 3].
    """
    if len(x) < FEWEST_WINDOWS or window < 0.5 * WINDOW:
        return  # between neighbouring rows, noise has a larger part
    x, y = x - x.mean(0), y - y.mean(0)  # without the bias of the gyroscope
    for axis, name in enumerate(("x", "y", "z")):
        square = float((x[:, axis] ** 2).sum())
        if np.sqrt(square / len(x)) < MIN_RMS_TURN:
            continue
        slope = float((x[:, axis] * y[:, axis]).sum()) / square
        if not SCALES[0] < slope < SCALES[1]:
            raise ValueError(
                f"{table.name}: the attitude must turn with the angular rate about {name}, got "
                f"{slope:.3g} times the rotation. Check units (rad, rad/s), signs and axes."
            )


# --------------------------------------------------------------------------------------------------
# Checks of the tables of a road drive: direction of the wheels, and positions that are given twice.

_GEOCENTRIC, _GEODETIC = ("x", "y", "z"), ("lat_deg", "lon_deg", "h_m")
SAME_POSITION = 1.0  # m; difference of two forms of one position, for rounded degrees
_BRAKING, _SLOW = 10.0, 1.0  # m/s^2, hard braking on a road; m/s, noise of the wheels about zero


def check_geocentric(table: LogTable) -> None:
    """Check that Earth-fixed and geodetic positions are the same, if a table has both."""
    if not table.has(_GEOCENTRIC):
        return
    geodetic = parse_numbers(table, _GEODETIC) * [np.pi / 180, np.pi / 180, 1.0]
    expected = earth.ecef(torch.from_numpy(geodetic)).numpy()
    difference = np.linalg.norm(parse_numbers(table, _GEOCENTRIC) - expected, axis=1)
    i = int(np.argmax(difference))
    if difference[i] > SAME_POSITION:
        raise ValueError(
            f"{table.name}: x, y, z and lat_deg, lon_deg, h_m must be the same position within "
            f"{SAME_POSITION:g} m, got {difference[i]:.3g} m in {table.row(i)}. "
            "Correct the wrong columns, or remove x, y, z."
        )


def check_wheel_direction(table: LogTable, time: Array, speed: Array) -> tuple[str, ...]:
    """Check that the wheels stop before they reverse.

    The reference velocity of a road vehicle does not show whether it moves backwards.

    Returns a note if most of the drive is backwards. Shapes: time [T], speed [T].
    """
    change, largest = np.abs(np.diff(speed)), 2.0 * _SLOW + _BRAKING * np.diff(time)
    wrong = np.flatnonzero((speed[1:] * speed[:-1] < 0.0) & (change > largest))
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(
            f"{table.name}: column v_fwd must change its sign near zero, got {speed[i + 1]:g} m/s "
            f"after {speed[i]:g} m/s in {table.row(i + 1)} ({wrong.size} such rows). "
            "Correct the sign or remove this row."
        )
    moving = np.abs(speed) > _SLOW
    backwards = int((speed < -_SLOW).sum())
    if 2 * backwards <= int(moving.sum()):
        return ()
    return (
        f"{table.name}: the wheels turn backwards in {backwards} of {int(moving.sum())} moving rows. "
        "Check the sign of v_fwd",
    )
