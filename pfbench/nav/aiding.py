"""Aids of an INS: sensor protocol, GNSS fixes, radar, barometer, initial errors, process noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import as_float64, require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels, fix_channels, name_channels
from pfbench.nav import earth
from pfbench.nav.imu_errors import DEG_H, UG
from pfbench.nav.strapdown import InsIntervals

ARCMIN = math.pi / 180.0 / 60.0
POSITION_DIFFERENCES = name_channels("INS minus measured position", ("North", "East", "Up"), "m")
VELOCITY_DIFFERENCES = name_channels("INS minus measured velocity", ("East", "North", "Up"), "m/s")
LOOSE_CHANNELS = (*POSITION_DIFFERENCES, *VELOCITY_DIFFERENCES)


class FlightSolution(NamedTuple):
    """The truth and the INS output of each run at the ends of T filter intervals.

    Attributes:
        time: [T], s.
        pos: Latitude, longitude, height, [T, 3], rad, rad, m.
        vel: East, North, Up, [T, 3], m/s.
        dcm: Body to level, [T, 3, 3].
        ins: Intervals of the INS, [R, T, ...].
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor
    ins: InsIntervals


@dataclass(frozen=True, eq=False)
class AidingData:
    """Noise-free measurements and filter inputs of a flight.

    Attributes:
        y: Measurements without instrument noise, [R, T, Dy]. NaN marks a missing component.
        u: Inputs of the filter's model, a NamedTuple of tensors with leading axes [R or 1, T].
        truth: True states of the instruments by group, [R, T, k] each (for example a clock).
        sheet: Data that only a datasheet plots, see Episode.
    """

    y: Tensor
    u: Any
    truth: dict[str, Tensor] = field(default_factory=dict)
    sheet: dict[str, Tensor] = field(default_factory=dict)


class AidingSensor(Protocol):
    """Instruments that aid an INS.

    One that states `channel_names` and `input_type` (`pfbench.core.record`) is compared with the model.
    """

    @property
    def channels(self) -> MeasurementChannels:
        """Nominal noise [Dy], kind and source of each measurement component."""

    def measure(self, flown: FlightSolution, draws: RandomStream, process: Tensor) -> AidingData:
        """Compute the measurements along a flight.

        Args:
            flown: Truth and INS output.
            draws: Random stream, which also decides the runs.
            process: Factor on the variance of the noise that drives instrument states, [T].
        """


def _check_three(key: str, values: Sequence[float], allow_zero: bool = False) -> Tensor:
    """Return three standard deviations as a float64 tensor."""
    sd = as_float64(list(values))
    if sd.shape != (3,) or not bool(((sd >= 0) if allow_zero else (sd > 0)).all()):
        sign = "non-negative" if allow_zero else "positive"
        raise ValueError(
            f"{key} must be three {sign} standard deviations, got {list(values)}. "
            "Give one per axis."
        )
    return sd


@dataclass(frozen=True)
class GnssReceiver(AidingSensor):
    """A GNSS receiver for position, and for velocity unless `velocity_sd` is None.

    Attributes:
        position_sd: Standard deviation North, East, Up, [3], m.
        velocity_sd: Standard deviation East, North, Up, [3], m/s.

    Raises:
        ValueError: If an entry is not three positive numbers.
    """

    position_sd: Sequence[float]
    velocity_sd: Sequence[float] | None = None
    input_type = InsIntervals

    def __post_init__(self) -> None:
        _ = self.sd

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the measured differences, [3] or [6]."""
        return LOOSE_CHANNELS[: len(self.sd)]

    @property
    def sd(self) -> Tensor:
        """Standard deviation of position N, E, U, then velocity E, N, U, [3] or [6]."""
        position = _check_three("receiver.position_sd", self.position_sd)
        if self.velocity_sd is None:
            return position
        return torch.cat([position, _check_three("receiver.velocity_sd", self.velocity_sd)])

    @property
    @override
    def channels(self) -> MeasurementChannels:
        return fix_channels(self.sd)

    @override
    def measure(self, flown: FlightSolution, draws: RandomStream, process: Tensor) -> AidingData:
        ins = flown.ins
        difference = torch.cat(
            [(ins.pos_end - flown.pos) * earth.metre_scale(flown.pos), ins.vel_end - flown.vel], -1
        )
        return AidingData(difference[..., : len(self.sd)], ins)


@dataclass(frozen=True)
class AlignmentErrors:
    """Initial errors of an INS, one standard deviation.

    Attributes:
        attitude_arcmin: East, North, Up, [3].
        velocity: East, North, Up, [3], m/s.
        position: North, East, Up, [3], m.
        randomise: Whether each run draws its errors. Otherwise every run has exactly one standard
            deviation, and the filters assume the same distribution as before.

    Raises:
        ValueError: If an entry is not three positive numbers.
    """

    attitude_arcmin: Sequence[float]
    velocity: Sequence[float]
    position: Sequence[float]
    randomise: bool = True

    def __post_init__(self) -> None:
        _ = self.sd

    def draw_errors(self, draws: RandomStream) -> Tensor:
        """Draw attitude, velocity and position errors of the runs, [R, 9]."""
        z = draws.normal("world.initial", 1, 9)[:, 0]
        return self.sd * (z if self.randomise else torch.ones_like(z))

    @property
    def sd(self) -> Tensor:
        """Standard deviation of attitude rad, velocity m/s, position m, [9]."""
        attitude = _check_three("initial.attitude_arcmin", self.attitude_arcmin) * ARCMIN
        return torch.cat(
            [
                attitude,
                _check_three("initial.velocity", self.velocity),
                _check_three("initial.position", self.position),
            ]
        )


@dataclass(frozen=True)
class ProcessNoiseInflation:
    """Process noise of the model beyond the sensor noise, one standard deviation.

    The process noise of an INS error model is very small, so a particle filter with the exact
    model impoverishes. If one filter inflates, all filters of the comparison must, Kalman filters
    included. The report states it. The defaults are [ours].

    Attributes:
        attitude_arcsec: East, North, Up, [3].
        velocity: East, North, Up, [3], m/s.
        position: North, East, Up, [3], m.
        gyro_deg_h: Gyro error per axis, deg/h.
        accelerometer_ug: Accelerometer error per axis, micro-g.

    Raises:
        ValueError: If a number is negative.
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
        """Attitude rad, velocity m/s, position m, [9]."""
        attitude = (
            _check_three("inflation.attitude_arcsec", self.attitude_arcsec, allow_zero=True)
            * ARCMIN
            / 60.0
        )
        velocity = _check_three("inflation.velocity", self.velocity, allow_zero=True)
        return torch.cat(
            [attitude, velocity, _check_three("inflation.position", self.position, allow_zero=True)]
        )

    @property
    def gyro(self) -> Tensor:
        """Gyro error, [3], rad/s."""
        return _check_three("inflation.gyro_deg_h", [self.gyro_deg_h] * 3, allow_zero=True) * DEG_H

    @property
    def accelerometer(self) -> Tensor:
        """Accelerometer error, [3], m/s^2."""
        return (
            _check_three("inflation.accelerometer_ug", [self.accelerometer_ug] * 3, allow_zero=True)
            * UG
        )


# --------------------------------------------------------------------------------------------------
# Synthetic aperture radar and barometer as INS aids: heading, position, height.

_DEG = DEG_H * 3600.0
_KINDS = ("angle", "position", "position", "position")
_SOURCES = (0, 0, 0, 1)  # the radar with its map gives three components, the barometer the fourth


@dataclass(frozen=True)
class SarSensor(AidingSensor):
    """A radar with map matching (heading, position) and a barometric altimeter.

    The measurement is INS minus instrument [Yan et al. 2016, eq. 4]: heading in rad, then North,
    East, Up in metres, where the paper has latitude and longitude in rad. Metres are taken at the
    true position [ours]. The paper's table of noise sizes is lost, so the defaults are typical
    values for such instruments [ours].

    Attributes:
        heading_sd_deg: Standard deviation of the radar heading, deg.
        position_sd: Standard deviation of the radar position North, East, [2], m.
        height_sd: Standard deviation of the barometric height, m.

    Raises:
        ValueError: If a number is not positive, or `position_sd` has not two entries.
    """

    heading_sd_deg: float = 0.05
    position_sd: Sequence[float] = (20.0, 20.0)
    height_sd: float = 10.0
    channel_names = ("INS minus measured heading [rad]", *POSITION_DIFFERENCES)
    input_type = InsIntervals

    def __post_init__(self) -> None:
        require(
            len(self.position_sd) == 2,
            "receiver.position_sd",
            "be two standard deviations",
            list(self.position_sd),
            "Give North and East.",
        )
        sizes = {
            "heading_sd_deg": [self.heading_sd_deg],
            "position_sd": self.position_sd,
            "height_sd": [self.height_sd],
        }
        for name, values in sizes.items():
            require(
                all(value > 0.0 for value in values),
                f"receiver.{name}",
                "be positive",
                list(values),
                "Give standard deviations.",
            )

    @property
    def sd(self) -> Tensor:
        """Standard deviation of heading rad, position North, East, Up m, [4]."""
        return as_float64([self.heading_sd_deg * _DEG, *self.position_sd, self.height_sd])

    @property
    @override
    def channels(self) -> MeasurementChannels:
        return MeasurementChannels(self.sd, _KINDS, _SOURCES)

    @override
    def measure(self, flown: FlightSolution, draws: RandomStream, process: Tensor) -> AidingData:
        ins = flown.ins
        heading_error = compute_heading_difference(ins.dcm_end[..., 1], flown.dcm[..., 1])
        position_error = (ins.pos_end - flown.pos) * earth.metre_scale(flown.pos)
        return AidingData(torch.cat([heading_error.unsqueeze(-1), position_error], -1), ins)


def compute_heading_difference(a: Tensor, b: Tensor) -> Tensor:
    """Compute heading of a minus heading of b, clockwise from North, in [-pi, pi].

    Returns difference, [...], rad. Shapes: a [..., 3], b [..., 3].
    """
    a_east, a_north, _ = a.unbind(-1)
    b_east, b_north, _ = b.unbind(-1)
    # not atan2 - atan2: it loses digits of a small difference and needs wrapping
    return torch.atan2(a_east * b_north - a_north * b_east, a_north * b_north + a_east * b_east)
