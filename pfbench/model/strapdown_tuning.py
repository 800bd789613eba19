"""Parameters that filters assume in the strapdown models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.parameter_checks import (
    as_float64,
    check_positive,
    check_three_positive,
    require,
)
from pfbench.nav.ranging import ReceiverClock


@dataclass(frozen=True)
class StrapdownStart:
    """Standard deviations that filters assume at the start.

    Attributes:
        attitude_sd_deg: About right (pitch), forward (roll), up (yaw) axis, deg.
        initial_velocity_sd: East, North, Up, m/s.
        initial_position_sd: East, North, Up, m.
        gyro_bias_sd_deg_s: Of each axis, deg/s.
        accelerometer_bias_sd: Of each axis, m/s^2.
    """

    attitude_sd_deg: Sequence[float]
    initial_velocity_sd: Sequence[float]
    initial_position_sd: Sequence[float]
    gyro_bias_sd_deg_s: float
    accelerometer_bias_sd: float

    @property
    def initial_sd(self) -> Tensor:
        """Standard deviations of the initial errors in the chart [15], SI.

        Raises:
            ValueError: If a number is not positive, or a list does not have three.
        """
        degree = math.pi / 180.0
        blocks = [check_three_positive("tuning.attitude_sd_deg", self.attitude_sd_deg) * degree]
        blocks += [check_three_positive("tuning.initial_velocity_sd", self.initial_velocity_sd)]
        blocks += [check_three_positive("tuning.initial_position_sd", self.initial_position_sd)]
        blocks += [
            check_positive("tuning.gyro_bias_sd_deg_s", [self.gyro_bias_sd_deg_s] * 3) * degree
        ]
        blocks += [check_positive("tuning.accelerometer_bias_sd", [self.accelerometer_bias_sd] * 3)]
        return torch.cat(blocks)


@dataclass(frozen=True)
class StrapdownTuning(StrapdownStart):
    """Parameters that filters assume for the sensors and the receiver, and for the start.

    Attributes:
        gyro_density: Effective root density with vibration, rad/s/sqrt(Hz).
        accelerometer_density: Effective root density with vibration, m/s^2/sqrt(Hz).
        gyro_bias_walk: Random walk of the bias, rad/s/sqrt(s).
        accelerometer_bias_walk: Random walk of the bias, m/s^2/sqrt(s).
        position_sd: Standard deviation of a fix, East, North, Up, m.
        velocity_sd: Standard deviation of velocity, East, North, Up, m/s. None if not measured.
        gyro_bias_deg_s: Nominal bias in the axes of the files (forward, right, down), deg/s.
        accelerometer_bias: Nominal bias in the axes of the files (forward, right, down), m/s^2.
    """

    gyro_density: float
    accelerometer_density: float
    gyro_bias_walk: float
    accelerometer_bias_walk: float
    position_sd: Sequence[float]
    velocity_sd: Sequence[float] | None
    gyro_bias_deg_s: Sequence[float] = (0.0, 0.0, 0.0)
    accelerometer_bias: Sequence[float] = (0.0, 0.0, 0.0)

    @property
    def measurement_sd(self) -> Tensor:
        """Standard deviations of a measurement [3 or 6], SI.

        Raises:
            ValueError: If a number is not positive, or a list does not have three.
        """
        position = check_three_positive("tuning.position_sd", self.position_sd)
        if self.velocity_sd is None:
            return position
        return torch.cat([position, check_three_positive("tuning.velocity_sd", self.velocity_sd)])

    @property
    def bias(self) -> Tensor:
        """Nominal gyro and accelerometer bias in model axes (right, forward, up) [6], SI."""
        (gf, gr, gd), (af, ar, ad) = self.gyro_bias_deg_s, self.accelerometer_bias
        gyro = as_float64([gr, gf, -gd]) * (math.pi / 180.0)
        return torch.cat([gyro, as_float64([ar, af, -ad])])


@dataclass(frozen=True)
class RangeErrorModel:
    """Error model of one kind of measurement.

    sd^2 = floor_sd^2 + (stated_sd_factor stated)^2 + added_sd^2. [ours]

    Attributes:
        floor_sd: Errors unknown to the receiver (multipath, atmosphere), m or m/s.
        stated_sd_factor: Factor on the stated standard deviation of each satellite.
        added_sd: Noise that a regime adds to the recorded measurements, m or m/s.

    Raises:
        ValueError: If `floor_sd` is not positive, or the factor or `added_sd` is negative.
    """

    floor_sd: float
    stated_sd_factor: float = 1.0
    added_sd: float = 0.0

    def __post_init__(self) -> None:
        check_positive("tuning.floor_sd", [self.floor_sd])
        require(
            self.stated_sd_factor >= 0.0 and self.added_sd >= 0.0,
            "tuning.stated_sd_factor and tuning.added_sd",
            "not be negative",
            f"{self.stated_sd_factor} and {self.added_sd}",
            "Use 0 to omit a term.",
        )

    def sd(self, stated: Tensor) -> Tensor:
        """Compute the standard deviation from stated standard deviations [...]."""
        return torch.sqrt(
            self.floor_sd**2 + self.added_sd**2 + (self.stated_sd_factor * stated) ** 2
        )


@dataclass(frozen=True)
class TightTuning:
    """Parameters that filters assume.

    Attributes:
        motion: Sensors and start. Its parameters of fixes are not used.
        clock: Receiver clock, relative to its nominal course.
        range: Error model of the ranges.
        rate: Error model of the rates.
        inter_system_sd: Initial standard deviation of the second system's clock relative to the
            first system's, about its nominal value, m.
        inter_system_walk: Random walk of the inter-system bias, m/sqrt(s).
    """

    motion: StrapdownTuning
    clock: ReceiverClock
    range: RangeErrorModel
    rate: RangeErrorModel
    inter_system_sd: float = 3.0
    inter_system_walk: float = 0.02

    @property
    def clock_sd(self) -> Tensor:
        """Initial standard deviation of bias m, drift m/s and inter-system bias m [3].

        Raises:
            ValueError: If a standard deviation is not positive.
        """
        inter_system = check_positive("tuning.inter_system_sd", [self.inter_system_sd])
        clock = as_float64([self.clock.bias_sd, self.clock.drift_sd])
        return torch.cat([clock, inter_system])


@dataclass(frozen=True)
class AidedTuning:
    """Parameters that filters assume.

    Attributes:
        motion: Inertial sensors, receiver and start.
        height_sd: Standard deviation of a pressure height, m.
        magnetic_sd: Standard deviation of the field about the forward, right and down axis, gauss.
        magnetic_field_gauss: The Earth's field, North, East, Down, gauss.
        height_bias_sd: Initial standard deviation about the level that the record subtracts, m.
        height_bias_walk: Random walk of the barometer bias, m/sqrt(s).
        magnetic_bias_sd: Initial standard deviation of each axis about the hard iron that the
            record subtracts, gauss.
        magnetic_bias_walk: Random walk of each axis, gauss/sqrt(s).
    """

    motion: StrapdownTuning
    height_sd: float
    magnetic_sd: Sequence[float]
    magnetic_field_gauss: Sequence[float]
    height_bias_sd: float
    height_bias_walk: float
    magnetic_bias_sd: float
    magnetic_bias_walk: float

    @property
    def bias_sd(self) -> Tensor:
        """Initial standard deviation of barometer and magnetometer biases [4].

        Raises:
            ValueError: If a standard deviation is not positive.
        """
        height = check_positive("tuning.height_bias_sd", [self.height_bias_sd])
        return torch.cat(
            [height, check_positive("tuning.magnetic_bias_sd", [self.magnetic_bias_sd] * 3)]
        )

    @property
    def measurement_sd(self) -> Tensor:
        """Standard deviation of fix, height and field (right, forward, up) [7 or 10].

        Raises:
            ValueError: If a standard deviation is not positive.
        """
        height = check_positive("tuning.height_sd", [self.height_sd])
        magnetic = check_three_positive("tuning.magnetic_sd", self.magnetic_sd)[[1, 0, 2]]
        return torch.cat([self.motion.measurement_sd, height, magnetic])
