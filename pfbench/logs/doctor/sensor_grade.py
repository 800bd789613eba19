"""Noise of the IMU: Allan deviation at a second at rest, and noise of the rate in motion."""

from __future__ import annotations

from typing import Any

import numpy as np

from pfbench.logs.doctor.bad_samples import list_stretches
from pfbench.logs.doctor.raw_log import RawImu, RawLog, RawReference
from pfbench.logs.worlds.log_tables import Array, ImuLog, ReferenceLog

_BLOCK = 0.5  # s; mean values that show rest
_QUIET_SPEED, _QUIET_RATE, _LEAST_STANDING = 0.15, 0.03, 8.0  # m/s, rad/s, s
# grade by the density of the gyroscope, rad/s/sqrt(Hz), the best first
_GRADES = ((1e-5, "navigation or fibre-optic"), (1e-4, "tactical"), (1e-3, "industrial MEMS"), (np.inf, "consumer MEMS"))  # fmt: skip


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
