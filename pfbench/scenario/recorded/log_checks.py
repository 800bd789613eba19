"""Checks of units, axes and times of a navigation log."""

from __future__ import annotations

import math

import numpy as np
import torch

from pfbench.core import quaternion
from pfbench.scenario.plausibility.time_order import find_overlap_remedy
from pfbench.scenario.recorded.log_tables import Array
from pfbench.scenario.recorded.navigation_log import ImuLog, ReferenceLog

STANDARD_GRAVITY = 9.80665
_DEGREE = math.pi / 180.0


def check_force(force: Array, name: str) -> None:
    """Check unit and axes of the specific force.

    Args:
        force: Specific force in forward, right, down, [n, 3].
        name: Name of the table, for the message.

    Raises:
        ValueError: If the force is in another unit, or its down axis points up.
    """
    typical = float(np.median(np.linalg.norm(force, axis=1)))
    if 0.8 < typical < 1.25:
        raise ValueError(
            f"{name}: fx, fy, fz must be in m/s^2, got a median norm of {typical:.3f}, which is in g. "
            f"Multiply by {STANDARD_GRAVITY}."
        )
    if not 5.0 < typical < 20.0:
        raise ValueError(
            f"{name}: fx, fy, fz must have a median norm near 9.8 m/s^2 from gravity, "
            f"got {typical:g}. Check the unit."
        )
    down = float(np.median(force[:, 2]))
    if down > 0.5 * typical:
        raise ValueError(
            f"{name}: fz must be about -9.8 when level (forward-right-down axes), "
            f"got a median of {down:+.2f}. If axes are forward-left-up, negate fy, fz, wy, wz."
        )


def check_overlap(imu_name: str, imu_time: Array, name: str, time: Array) -> None:
    """Check that two tables have a common time.

    Args:
        imu_name: Name of the IMU table, for the message.
        imu_time: Times of the IMU table, s, [n].
        name: Name of the second table, for the message.
        time: Times of the second table, s, [m].

    Raises:
        ValueError: If the tables do not overlap.
    """
    if min(imu_time[-1], time[-1]) <= max(imu_time[0], time[0]):
        raise ValueError(
            f"{imu_name} and {name} must overlap in time, got t = {imu_time[0]:.3f} to "
            f"{imu_time[-1]:.3f} and t = {time[0]:.3f} to {time[-1]:.3f}. "
            f"{find_overlap_remedy(time, imu_time, name)}"
        )


def check_rotation(imu: ImuLog, reference: ReferenceLog, name: str, reference_name: str) -> None:
    """Compare angular rates with the reference.

    Rates of slow vehicles in deg/s pass all absolute limits.

    Args:
        imu: IMU samples.
        reference: Reference motion.
        name: Name of the IMU table, for the message.
        reference_name: Name of the reference table, for the message.

    Raises:
        ValueError: If the rates have another scale or sign than the reference.
    """
    rates = _mean_rates(imu, reference)
    if rates is None:
        return
    measured, true = rates
    if np.sqrt(np.mean(true**2)) < 0.02:
        return  # at low angular rates the comparison contains mostly noise
    slope = float((measured * true).sum() / (true * true).sum())
    if slope > 20.0:
        raise ValueError(
            f"{name}: wx, wy, wz must be in rad/s, got {slope:.0f} times the rate of {reference_name}, "
            f"so they are in deg/s. Multiply by {_DEGREE:.10f}."
        )
    if slope < 0.05:
        raise ValueError(
            f"{name} and {reference_name} must turn together, got a slope of {slope:.3f}. Check that "
            "roll, pitch, yaw are in rad (0.017: in degrees), that axes are forward-right-down, "
            "yaw clockwise from North, and that both have the same clock."
        )


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
    true = quaternion.rotation_vector_from_quaternion(
        quaternion.quaternion_multiply(inverse, q[1:])
    ).numpy()
    summed = np.cumsum(0.5 * np.diff(imu.time)[:, None] * (imu.rate[1:] + imu.rate[:-1]), axis=0)
    angle = np.vstack([np.zeros(3), summed])
    measured = np.diff(
        np.stack([np.interp(time, imu.time, column) for column in angle.T], axis=-1), axis=0
    )
    measured, true = (turn / np.diff(time)[:, None] for turn in (measured, true))
    # the mean contains the gyro bias
    return measured - measured.mean(axis=0), true - true.mean(axis=0)
