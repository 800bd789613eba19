"""Contents of a navigation log in right-forward-up and East-North-Up axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pfbench.scenario.recorded.log_tables import Array


class ImuLog(NamedTuple):
    """IMU samples in body axes right, forward, up.

    Attributes:
        time: Times, s, [n].
        force: Specific force, m/s^2, [n, 3].
        rate: Angular rate, rad/s, [n, 3].
    """

    time: Array
    force: Array
    rate: Array


class GnssLog(NamedTuple):
    """Fixes in East, North, Up. Missing values are NaN.

    Attributes:
        time: Times, s, [m].
        position: Positions, m, [m, 3].
        velocity: Velocities, m/s, [m, 3]. All NaN if not recorded.
    """

    time: Array
    position: Array
    velocity: Array


class ReferenceLog(NamedTuple):
    """Reference motion in East, North, Up.

    Attributes:
        time: Times, s, [k].
        attitude: Quaternions from body to level axes, [k, 4].
        velocity: Velocities, m/s, [k, 3].
        position: Positions, m, [k, 3].
    """

    time: Array
    attitude: Array
    velocity: Array
    position: Array


@dataclass(frozen=True)
class NavigationLog:
    """Log that passed all checks.

    Attributes:
        imu: IMU samples.
        fixes: Fixes.
        reference: Reference motion.
        gravity: Normal gravity at the origin, m/s^2.
        notes: Corrections and assumptions of the reader, for the report.
    """

    imu: ImuLog
    fixes: GnssLog
    reference: ReferenceLog
    gravity: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LogFiles:
    """Names of the three tables, without .parquet or .csv.

    Attributes:
        imu: Name of the IMU table.
        gnss: Name of the table of fixes. It can be the reference.
        reference: Name of the reference table.
    """

    imu: str = "imu"
    gnss: str = "gnss"
    reference: str = "reference"


def swap_frd_rfu(a: Array) -> Array:
    """Convert forward-right-down to right-forward-up vectors [..., 3].

    The function also converts North-East-Down to East-North-Up. It is its own inverse.
    """
    return np.stack([a[..., 1], a[..., 0], -a[..., 2]], axis=-1)
