"""Standing: its detection by the IMU alone, with thresholds from a standing part of the log, and the noise of the IMU there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.logs.doctor.bad_samples import list_stretches
from pfbench.logs.doctor.raw_log import RawImu, RawLog, RawReference
from pfbench.logs.worlds.log_tables import Array, ImuLog, NavigationLog, ReferenceLog

_WINDOW = 0.5  # s; at 0.2 s engine and hand hide in the noise, longer windows find a start late
_QUANTILE = 0.95
_MARGINS = (1.5, 1.2, 1.5)  # times these quantiles of rate, scatter and change of the force [ours]
_SETTLED = 1.0  # s without a change of the force: a steady acceleration is as quiet as rest
_MOVING = 0.3  # m/s
_LARGEST_FALSE = 0.05  # share of the moving steps; 0 on a car and a walk
_BLOCK = 0.5  # s; mean values that show rest
_QUIET_SPEED, _QUIET_RATE, _LEAST_STANDING = 0.15, 0.03, 8.0  # m/s, rad/s, s
# grade by the density of the gyroscope, rad/s/sqrt(Hz), the best first
_GRADES = ((1e-5, "navigation or fibre-optic"), (1e-4, "tactical"), (1e-3, "industrial MEMS"), (np.inf, "consumer MEMS"))  # fmt: skip


def detect_standing(log: NavigationLog, time: Array) -> tuple[NDArray[np.bool_], str]:
    """Detect the steps at which the IMU is standing, and was quiet at the step before.

    Three numbers of the last half second must be as small as in the longest part of the log in which the
    reference is standing. They are the mean rate less its bias, the scatter of the force, and the change of the
    mean force from the half second before. The last one must have been small for a second.

    Args:
        log: Log with the reference, which decides the thresholds alone.
        time: Ends of the steps, s, [T].

    Returns:
        Mask, [T], and a note with thresholds and shares.

    Raises:
        ValueError: If the log lacks such a part, or the thresholds take motion for standing.
    """
    stretch = find_standing(log.imu, log.reference)
    remedy = "Set constraints.zero_velocity_sd and zero_rate_sd to null."
    require(stretch is not None, "the log", "stand for 8 s, for the thresholds of standing", "no such part", remedy)  # fmt: skip
    at = log.imu.time[stretch]
    rate, *others = _measure_windows(log.imu, at[at >= at[0] + 2.0 * _WINDOW])
    bias = np.median(rate, axis=0)
    limits = [m * float(np.quantile(a, _QUANTILE)) for m, a in zip(_MARGINS, (_norm(rate - bias), *others), strict=True)]  # fmt: skip
    rate, scatter, change = _measure_windows(log.imu, time)
    quiet = (_norm(rate - bias) < limits[0]) & (scatter < limits[1])
    changed = np.maximum.accumulate(np.where(change < limits[2], log.imu.time[0], time))
    standing = quiet & np.r_[False, quiet[:-1]] & (time - changed > _SETTLED)
    speed = np.interp(time, log.reference.time, _norm(log.reference.velocity))
    moving = speed > _MOVING
    false = float(standing[moving].mean()) if moving.any() else 0.0
    require(
        false <= _LARGEST_FALSE,
        "thresholds of standing",
        f"find standing in at most {_LARGEST_FALSE:.0%} of the steps above {_MOVING} m/s",
        f"{false:.1%}",
        remedy,
    )
    note = (
        f"standing is detected at {int(standing.sum())} of {len(time)} steps, {false:.2%} of the moving ones; "
        f"thresholds {limits[0]:.3g} rad/s, {limits[1]:.3g} and {limits[2]:.3g} m/s^2 from t = {at[0]:.1f} to {at[-1]:.1f} s"
    )
    return standing, note


def _measure_windows(imu: ImuLog, time: Array) -> tuple[Array, Array, Array]:
    """Return mean rate, rad/s, [T, 3], scatter of the force and change of its mean, m/s^2, [T], before each time."""
    force = imu.force - imu.force.mean(0)
    sums = np.vstack([np.zeros(9), np.cumsum(np.hstack([imu.rate, force, force**2]), axis=0)])

    def average(end: Array) -> Array:
        first = np.searchsorted(imu.time, end - _WINDOW)
        last = np.searchsorted(imu.time, end, side="right")
        return np.asarray((sums[last] - sums[first]) / np.maximum(last - first, 1)[:, None])

    rate, mean, square = np.split(average(time), 3, axis=1)
    scatter = np.sqrt(np.maximum(square - mean**2, 0.0).sum(1))
    return rate, scatter, _norm(mean - average(time - _WINDOW)[:, 3:6])


def _norm(a: Array) -> Array:
    """Return the lengths of vectors, [n]."""
    return np.asarray(np.linalg.norm(a, axis=1))


def measure_noise(log: RawLog, facts: dict[str, Any]) -> None:
    """Measure the noise at rest, by the speed of the reference and quiet rates."""
    standing = find_standing(log.imu, log.reference)
    facts["standing [s]"] = None
    if standing is None:
        return
    time = log.imu.time[standing]
    rate = 1.0 / float(np.median(np.diff(log.imu.time)))
    gyroscope = allan_deviation(log.imu.rate[standing], rate)
    accelerometer = allan_deviation(log.imu.force[standing], rate)
    facts["standing [s]"] = [round(float(time[0]), 3), round(float(time[-1]), 3)]
    facts["gyro density [rad/s/sqrt(Hz)]"] = [float(f"{v:.3g}") for v in gyroscope]
    facts["accelerometer density [m/s^2/sqrt(Hz)]"] = [float(f"{v:.3g}") for v in accelerometer]
    facts["grade"] = next(name for limit, name in _GRADES if gyroscope.max() <= limit)


def find_standing(imu: RawImu | ImuLog, reference: RawReference | ReferenceLog) -> slice | None:
    """Return the samples of the longest stretch at rest, None if it is short."""
    time = imu.time
    step = float(np.median(np.diff(time)))
    size = int(_BLOCK / step)
    count = len(time) // size if size >= 3 else 0
    if not count:
        return None
    rate = imu.rate[: count * size].reshape(count, size, 3).mean(1)
    speed = np.interp(
        time[: count * size : size], reference.time, np.linalg.norm(reference.velocity, axis=1)
    )  # fmt: skip
    turning = np.linalg.norm(rate - np.median(rate, 0), axis=1)
    quiet = (speed < _QUIET_SPEED) & (turning < _QUIET_RATE)
    stretches = list_stretches(quiet).tolist()
    first, last = max(stretches, key=lambda blocks: blocks[1] - blocks[0], default=(0, 0))
    is_long = (last - first) * _BLOCK >= _LEAST_STANDING
    return slice(first * size, last * size) if is_long else None


def allan_deviation(values: Array, rate: float) -> Array:
    """Return the Allan deviation at one second.

    For white noise it is the density, per square root of Hz.

    Args:
        values: Samples, [n, k].
        rate: Samples per second.

    Returns:
        Deviations, [k].
    """
    size = max(1, round(rate))
    count = len(values) // size
    means = values[: count * size].reshape(count, size, -1).mean(1)
    return np.asarray(np.sqrt(0.5 * np.square(np.diff(means, axis=0)).mean(0)))
