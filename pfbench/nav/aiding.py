"""Sizes of what surrounds an INS: the receiver's errors, the errors that it starts with, and noise added on purpose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.nav.sensors import DEG_H, UG

ARCMIN = math.pi / 180.0 / 60.0


def _sizes(key: str, values: Sequence[float], zero: bool = False) -> Tensor:
    sizes = torch.tensor(list(values), dtype=torch.float64)
    if sizes.shape != (3,) or not bool(((sizes >= 0) if zero else (sizes > 0)).all()):
        wanted = "non-negative" if zero else "positive"
        raise ValueError(f"{key}={list(values)}: give three {wanted} standard deviations, one per axis")
    return sizes


@dataclass(frozen=True)
class Receiver:
    """A GNSS receiver that gives position, and velocity unless `velocity_sd` is None.

    Args:
        position_sd: standard deviation North, East, Up [3] m.
        velocity_sd: East, North, Up [3] m/s.

    Raises:
        ValueError: not three positive numbers.
    """

    position_sd: Sequence[float]
    velocity_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _ = self.sd

    @property
    def sd(self) -> Tensor:
        """Of the measurement vector: position N, E, U, then velocity E, N, U [3] or [6]."""
        position = _sizes("receiver.position_sd", self.position_sd)
        if self.velocity_sd is None:
            return position
        return torch.cat([position, _sizes("receiver.velocity_sd", self.velocity_sd)])


@dataclass(frozen=True)
class Alignment:
    """Initial errors of an INS, one standard deviation.

    Args:
        attitude_arcmin: East, North, Up [3].
        velocity: East, North, Up [3] m/s.
        position: North, East, Up [3] m.

    Raises:
        ValueError: not three positive numbers each.
    """

    attitude_arcmin: Sequence[float]
    velocity: Sequence[float]
    position: Sequence[float]

    def __post_init__(self) -> None:
        _ = self.sd

    @property
    def sd(self) -> Tensor:
        """Attitude rad, velocity m/s, position m [9]."""
        attitude = _sizes("initial.attitude_arcmin", self.attitude_arcmin) * ARCMIN
        return torch.cat([attitude, _sizes("initial.velocity", self.velocity), _sizes("initial.position", self.position)])


@dataclass(frozen=True)
class Inflation:
    """Noise that the model adds to each step beyond what the sensors explain, one standard deviation.

    An INS error model has next to no process noise, so a particle filter with an honest model impoverishes. Whoever inflates
    must inflate for every filter in the comparison, the Kalman filters included; the report says so. The defaults are [ours].

    Args:
        attitude_arcsec: East, North, Up [3]; velocity: [3] m/s; position: [3] m; gyro_deg_h, accelerometer_ug: per axis.

    Raises:
        ValueError: a negative number.
    """

    attitude_arcsec: Sequence[float] = (5.0, 5.0, 15.0)
    velocity: Sequence[float] = (0.05, 0.05, 0.05)
    position: Sequence[float] = (1.0, 1.0, 1.0)
    gyro_deg_h: float = 0.002
    accelerometer_ug: float = 3.0

    def __post_init__(self) -> None:
        _ = self.motion, self.gyro, self.accelerometer

    @property
    def motion(self) -> Tensor:
        """Attitude rad, velocity m/s, position m [9]."""
        attitude = _sizes("inflation.attitude_arcsec", self.attitude_arcsec, zero=True) * ARCMIN / 60.0
        velocity = _sizes("inflation.velocity", self.velocity, zero=True)
        return torch.cat([attitude, velocity, _sizes("inflation.position", self.position, zero=True)])

    @property
    def gyro(self) -> Tensor:
        """rad/s [3]."""
        return _sizes("inflation.gyro_deg_h", [self.gyro_deg_h] * 3, zero=True) * DEG_H

    @property
    def accelerometer(self) -> Tensor:
        """m/s^2 [3]."""
        return _sizes("inflation.accelerometer_ug", [self.accelerometer_ug] * 3, zero=True) * UG
