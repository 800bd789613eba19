"""What surrounds an INS: what aids it, the errors that it starts with, and noise added on purpose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.nav import earth
from pfbench.nav.sensors import DEG_H, UG
from pfbench.nav.strapdown import Intervals
from pfbench.record import Channels, fixes

ARCMIN = math.pi / 180.0 / 60.0


class Flown(NamedTuple):
    """A flight at the ends of T filter intervals: the truth, and what the INS of each run made of it.

    Attributes:
        time: s [T].
        pos: latitude, longitude, height [T, 3] rad, rad, m.
        vel: East, North, Up [T, 3] m/s.
        dcm: body to level [T, 3, 3].
        ins: the INS's own intervals [R, T, ...].
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor
    ins: Intervals


@dataclass(frozen=True, eq=False)
class Aided:
    """What instruments make of a flight.

    Attributes:
        y: measurements without the instruments' noise [R, T, Dy]; NaN where nothing is seen.
        u: inputs of the filter's model, a NamedTuple of tensors with leading axes [R or 1, T].
        truth: true states of the instruments by group, each [R, T, k]: a receiver's clock, say.
        sheet: what a datasheet draws; see Episode.
    """

    y: Tensor
    u: Any
    truth: dict[str, Tensor] = field(default_factory=dict)
    sheet: dict[str, Tensor] = field(default_factory=dict)


class Aiding(Protocol):
    """Instruments that aid an INS."""

    @property
    def channels(self) -> Channels:
        """Nominal noise of the measurement vector [Dy], and which component comes from where."""

    def aid(self, flown: Flown, draws: Draws, process: Tensor) -> Aided:
        """Measurements along a flight; `process` [T] multiplies the variance of whatever drives the instruments' own states."""


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

    @property
    def channels(self) -> Channels:
        return fixes(self.sd)

    def aid(self, flown: Flown, draws: Draws, process: Tensor) -> Aided:
        """INS minus receiver."""
        ins = flown.ins
        difference = torch.cat([(ins.pos_end - flown.pos) * earth.metre_scale(flown.pos), ins.vel_end - flown.vel], -1)
        return Aided(difference[..., : len(self.sd)], ins)


@dataclass(frozen=True)
class Alignment:
    """Initial errors of an INS, one standard deviation.

    Args:
        attitude_arcmin: East, North, Up [3].
        velocity: East, North, Up [3] m/s.
        position: North, East, Up [3] m.
        drawn: each run draws its errors; else every run has exactly these, the filters believing in the law as before.

    Raises:
        ValueError: not three positive numbers each.
    """

    attitude_arcmin: Sequence[float]
    velocity: Sequence[float]
    position: Sequence[float]
    drawn: bool = True

    def __post_init__(self) -> None:
        _ = self.sd

    def errors(self, draws: Draws) -> Tensor:
        """Attitude, velocity, position errors of these runs [R, 9]."""
        z = draws.normal("world.initial", 1, 9)[:, 0]
        return self.sd * (z if self.drawn else torch.ones_like(z))

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
