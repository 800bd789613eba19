"""Total-state strapdown models for MEMS sensors: INS/GNSS, with barometer and magnetometer, with pseudoranges."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core import chart as quaternion
from pfbench.core.chart import Chart, EuclideanBlock, LieGroupBlock, QuaternionBlock
from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import as_float64, check_positive, check_tuning, require
from pfbench.core.record import Record, name_channels
from pfbench.model.base import StateSpaceModel, check_truth_sizes
from pfbench.model.ins_gnss import name_components
from pfbench.model.relative_ranges import RAW_CHANNELS, predict_raw
from pfbench.model.strapdown_tuning import AidedTuning, StrapdownTuning, TightTuning
from pfbench.nav.strapdown import PreintegratedImu, rotate

# With gyro biases of a degree per second an open-loop INS, and an error state about it, is useless
# after seconds. The state is therefore the motion with the sensor biases. IMU data enter as
# increments over a filter interval, with first-order bias corrections (`preintegration`). A step
# is then one inexpensive map for all particles at any IMU rate.

_SIZES = (4, 3, 3, 3, 3)  # quaternion, velocity, position, gyro bias, accelerometer bias
_AXES = ("East", "North", "Up")
FIX_CHANNELS = (*name_channels("position", _AXES, "m"), *name_channels("velocity", _AXES, "m/s"))


@cache
def _chart(attitude: QuaternionBlock | LieGroupBlock, further: int) -> Chart:
    """Return the chart of an attitude and further components."""
    return Chart((attitude, EuclideanBlock(further)))


def block_diagonal(a: Tensor, b: Tensor) -> Tensor:
    """Return a matrix with two blocks, [B, n + m, p + q].

    Shapes: a [B or 1, n, p], b [B or 1, m, q].
    """
    upper_right = a.new_zeros(a.shape[0], a.shape[1], b.shape[2])
    lower_left = b.new_zeros(b.shape[0], b.shape[1], a.shape[2])
    rows = ([a, upper_right], [lower_left, b])
    return torch.cat([torch.cat(row, -1) for row in rows], -2)


class StrapdownModel(StateSpaceModel):
    """Preintegrated inertial increments, and a start of each run from the recorded scenario."""

    input_type: type = PreintegratedImu
    p0: Tensor
    r: Tensor
    further = 0  # states after attitude, velocity, position and the sensor biases
    measured = remedy = ""  # what the scenario must measure, if their number is fixed

    @property
    @override
    def chart(self) -> Chart:
        return _chart(QuaternionBlock(), 12 + self.further)

    def group_chart(self, side: str) -> Chart:
        """Return an invariant chart: attitude, velocity and position are an element of SE_2(3).

        The noise gain holds in the left chart as well, to first order in the attitude noise of a step.
        The reason is that the density of the accelerometer is the same in all axes.

        Args:
            side: `left` or `right`, see LieGroupBlock.
        """
        return _chart(LieGroupBlock(side=side), 6 + self.further)

    @property
    @override
    def anchor(self) -> Tensor:
        return self.p0

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(15 + self.further)])

    @override
    def prepare(self, record: Record) -> Record:
        record = super().prepare(record)
        if self.measured:
            size, got = len(self.r), record.y.shape[-1]
            must = f"measure the {size} components of {self.measured}"
            require(got == size, "the scenario", must, got, self.remedy)
        return record

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)


class StrapdownTotal(StrapdownModel):
    """Motion of a vehicle with the biases of its IMU.

    State [16]: quaternion body to level, velocity and position (East, North, Up), gyro and
    accelerometer bias (body axes). Over an interval T, with increments corrected for the bias,

        q' = q (turn) exp(a),   v' = v - g T + C push + n,
        p' = p + v T - g T^2 / 2 + C shift + n T / 2,

    where a and n are the integrals of white gyro and accelerometer noise. The biases are random
    walks. The position noise is the exact regression on the velocity noise. The remainder, a
    variance of q T^3 / 12 (millimetres at T = 0.25 s), is omitted, so 12 normal numbers drive 15
    components. Attitude errors are rotation vectors in body axes: right (pitch), forward (roll), up
    (yaw). Position, or position and velocity, are measured.

    The origin is level, facing North, at rest, without biases. Recorded scenarios provide the
    start of each run. In `assemble`, group `attitude` is a quaternion [R, T, 4].

    Args:
        tuning: Standard deviations and densities.

    Raises:
        ValueError: If a density or standard deviation is not positive.
    """

    density: Tensor
    noise_dim = 12
    measured = "tuning.position_sd and velocity_sd"
    remedy = (
        "Set tuning.velocity_sd and receiver.velocity_sd both to three numbers, or both to null."
    )
    choices = (
        "flat Earth about the start with constant normal gravity; "
        "the gyro bias absorbs the Earth's rate (0.004 deg/s)",
        "position noise over an interval is half the velocity noise times the interval "
        "(its exact regression)",
    )

    def __init__(self, tuning: StrapdownTuning) -> None:
        super().__init__()
        check_tuning(tuning, StrapdownTuning)
        density = {
            "gyro_density": tuning.gyro_density,
            "accelerometer_density": tuning.accelerometer_density,
            "gyro_bias_walk": tuning.gyro_bias_walk,
            "accelerometer_bias_walk": tuning.accelerometer_bias_walk,
        }
        roots = [check_positive(f"tuning.{name}", [value] * 3) for name, value in density.items()]
        self.register_buffer("density", torch.cat(roots))
        self.register_buffer("r", tuning.measurement_sd)
        self.channel_names = FIX_CHANNELS[: len(self.r)]
        self.register_buffer("p0", tuning.initial_sd)
        axes = {
            "attitude": (("pitch", "roll", "yaw"), "rad"),
            "velocity": (("E", "N", "U"), "m/s"),
            "position": (("E", "N", "U"), "m"),
            "gyro_bias": (("right", "forward", "up"), "rad/s"),
            "accelerometer_bias": (("right", "forward", "up"), "m/s^2"),
        }
        self.names, self.units, self.groups = name_components(axes)

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        q, v, p, *biases = x.split(_SIZES, -1)
        change = (torch.cat(biases, -1) - u.bias.unsqueeze(1)) @ u.jacobian.mT
        rotation, push, shift = change.split(3, -1)
        correction = quaternion.quaternion_from_rotation_vector(rotation)
        turn = quaternion.quaternion_multiply(u.rotation.unsqueeze(1), correction)
        span, zero = u.duration[:, None, None], torch.zeros_like(u.gravity)
        free_dv = torch.stack([zero, zero, -u.gravity], -1).unsqueeze(1) * span
        position = (
            p + (v + 0.5 * free_dv) * span + rotate(q, u.position_increment.unsqueeze(1) + shift)
        )
        velocity = v + free_dv + rotate(q, u.velocity_increment.unsqueeze(1) + push)
        motion = [quaternion.quaternion_multiply(q, turn), velocity, position]
        return self.chart.add(torch.cat([*motion, *biases], -1), w @ self.noise_gain(u).mT)

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        root = torch.sqrt(u.duration)[:, None] * self.density  # [R or 1, 12]
        gain = root.new_zeros(root.shape[0], 15, 12)
        gain[:, :6, :6] = torch.diag_embed(root[:, :6])
        gain[:, 6:9, 3:6] = torch.diag_embed(0.5 * u.duration[:, None] * root[:, 3:6])
        gain[:, 9:, 6:] = torch.diag_embed(root[:, 6:])
        return gain

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        mean = x[..., 7:10] if len(self.r) == 3 else torch.cat([x[..., 7:10], x[..., 4:7]], -1)
        return independent_normal(mean, self.r)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        sizes = dict(zip(self.groups, _SIZES, strict=True))
        check_truth_sizes(truth, sizes)
        values = [truth[name] for name in self.groups if name in truth]
        require(
            values,
            "truth",
            f"contain a group of the model, {sorted(self.groups)}",
            sorted(truth),
            "Choose a scenario that fits the model.",
        )
        missing = values[0].new_full((*values[0].shape[:-1], 1), torch.nan)
        blocks = [
            truth.get(name, missing.expand(*missing.shape[:-1], size))
            for name, size in sizes.items()
        ]
        return torch.cat(blocks, -1)


# Motion and sensor biases are as in the loosely coupled model. Pressure measures the height plus a
# bias that varies with weather, airspeed and temperature. The magnetometer measures the Earth's
# field in body axes plus the field of the aircraft. The three field components are used, and not a
# heading: their errors are normal and need no attitude for levelling.

_MOTION, _BIASES = 16, 4
INSTRUMENT_CHANNELS = (
    "pressure height above the start [m]",
    *name_channels("magnetic field in body axes", ("right", "forward", "up"), "gauss"),
)
_DRIVEN = StrapdownTotal.noise_dim


class StrapdownAided(StrapdownModel):
    """StrapdownTotal with barometer and magnetometer biases.

    State [20]: the state of StrapdownTotal, then the barometer bias m and the magnetometer bias,
    right, forward, up, gauss. Measurements are position, or position and velocity, the height above
    the start plus the barometer bias, and C^T B + b with the Earth's field B in level axes. The
    biases are random walks. On a straight flight, heading and the two level components of b cannot
    be separated. Turns and fixes separate them. Scale and soft iron of the magnetometer are not
    states: the field strength is constant to 1 %, and turns give little information on them [ours].

    The origin is level, facing North, at rest, without biases. Recorded scenarios provide the start
    of each run.

    Args:
        tuning: Standard deviations, densities and the field.

    Raises:
        ValueError: If a density or standard deviation is not positive, or the field is not three
            numbers or is zero.
    """

    measured = "StrapdownAided (a fix, a height, a field)"
    remedy = (
        "Choose scenario=recorded_fixed_wing_aided, and set velocity_sd of tuning.motion and of the "
        "receiver both to three numbers or both to null."
    )
    magnetic_field_gauss: Tensor
    walk: Tensor
    noise_dim = _DRIVEN + _BIASES
    further = _BIASES

    def __init__(self, tuning: AidedTuning) -> None:
        super().__init__()
        check_tuning(tuning, AidedTuning)
        north, east, down = _field(tuning.magnetic_field_gauss)
        self.motion = StrapdownTotal(tuning.motion)
        self.channel_names = (*self.motion.channel_names, *INSTRUMENT_CHANNELS)
        self.register_buffer("p0", torch.cat([tuning.motion.initial_sd, tuning.bias_sd]))
        self.register_buffer("r", tuning.measurement_sd)
        self.register_buffer("magnetic_field_gauss", as_float64([east, north, -down]))
        height = check_positive("tuning.height_bias_walk", [tuning.height_bias_walk])
        magnetic = check_positive("tuning.magnetic_bias_walk", [tuning.magnetic_bias_walk] * 3)
        self.register_buffer("walk", torch.cat([height, magnetic]))
        first = len(self.motion.names)
        self.names = (
            *self.motion.names,
            "height_bias",
            *(f"magnetic_bias_{axis}" for axis in ("right", "forward", "up")),
        )
        self.units = (*self.motion.units, "m", "gauss", "gauss", "gauss")
        self.groups = {
            **self.motion.groups,
            "height_bias": (first,),
            "magnetic_bias": (first + 1, first + 2, first + 3),
        }
        self.choices = (
            *self.motion.choices,
            "errors of pressure height and magnetic field are correlated over seconds and modelled "
            "as white noise plus a random-walk bias",
        )

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        motion = self.motion.propagate(x[..., :_MOTION], u, w[..., :_DRIVEN])
        change = torch.sqrt(u.duration)[:, None, None] * self.walk * w[..., _DRIVEN:]
        return torch.cat([motion, x[..., _MOTION:] + change], -1)

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        motion = self.motion.noise_gain(u)
        walk = torch.diag_embed(torch.sqrt(u.duration)[:, None] * self.walk)
        return block_diagonal(motion, walk)

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        fix = self.motion.observation(x[..., :_MOTION], u).mean
        to_body = torch.cat([x[..., :1], -x[..., 1:4]], -1)
        magnetic = rotate(to_body, self.magnetic_field_gauss) + x[..., _MOTION + 1 :]
        height = x[..., 9:10] + x[..., _MOTION : _MOTION + 1]
        return independent_normal(torch.cat([fix, height, magnetic], -1), self.r)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        motion = self.motion.assemble(truth)
        height = truth.get("height_bias", motion.new_full((*motion.shape[:-1], 1), torch.nan))
        magnetic = truth.get("magnetic_bias", motion.new_full((*motion.shape[:-1], 3), torch.nan))
        return torch.cat([motion, height, magnetic], -1)


def _field(values: Sequence[float]) -> Sequence[float]:
    require(
        len(values) == 3 and any(values),
        "tuning.magnetic_field_gauss",
        "be three numbers that are not all zero",
        list(values),
        "Give the Earth's field, North, East, Down, in gauss.",
    )
    return values


# --------------------------------------------------------------------------------------------------
# Total-state tightly coupled INS/GNSS for MEMS sensors, with a receiver clock.
#
# Motion and sensor biases are as in the loosely coupled model. Measurements are pseudorange and
# range rate of each satellite. Ranges are 2e7 m and their errors metres, so the record contains
# ranges minus the ranges from a fixed position near the receiver. The model expands about that
# position exactly, and filters can use single precision.

_MOTION_TIGHT, _CLOCK = 16, 3
_DRIVEN_TIGHT = StrapdownTotal.noise_dim


class TightMemsInputs(NamedTuple):
    """Inputs of a step: preintegrated IMU, and S satellites at its end.

    Geometry is relative to a position that is fixed to the ground.

    Attributes:
        increments: Preintegrated IMU.
        line: Unit vectors to the satellites, East, North, Up, [R or 1, T, S, 3].
        reach: Distances of the satellites, [R or 1, T, S], m.
        velocity: Velocities of the satellites, East, North, Up, [R or 1, T, S, 3], m/s.
        other_system: 1 for a satellite of a different system than the clock's, else 0, [R or 1, T, S].
        range_sd: Standard deviation stated by the receiver, [R or 1, T, S], m.
        rate_sd: Standard deviation stated by the receiver, [R or 1, T, S], m/s.
    """

    increments: PreintegratedImu
    line: Tensor
    reach: Tensor
    velocity: Tensor
    other_system: Tensor
    range_sd: Tensor
    rate_sd: Tensor


class StrapdownTight(StrapdownModel):
    """StrapdownTotal with a receiver clock, measured by pseudoranges and range rates.

    State [19]: the state of StrapdownTotal, then bias m and drift m/s of the receiver clock, and
    the inter-system bias m. Clock states are differences from a nominal course that the record
    subtracts. Ranges and rates are those of `predict_raw` plus bias and drift.

    The origin is level, facing North, at rest, without biases. Recorded scenarios provide the start
    of each run.

    Args:
        tuning: Standard deviations and densities.

    Raises:
        ValueError: If a density or standard deviation is not positive.
    """

    channel_names = RAW_CHANNELS
    input_type = TightMemsInputs
    other_walk: Tensor
    noise_dim = _DRIVEN_TIGHT + _CLOCK
    further = _CLOCK

    def __init__(self, tuning: TightTuning) -> None:
        super().__init__()
        check_tuning(tuning, TightTuning)
        self.motion = StrapdownTotal(tuning.motion)
        self.clock, self.range, self.rate = tuning.clock, tuning.range, tuning.rate
        self.register_buffer("p0", torch.cat([tuning.motion.initial_sd, tuning.clock_sd]))
        self.register_buffer(
            "other_walk", check_positive("tuning.inter_system_walk", [tuning.inter_system_walk])
        )
        first = len(self.motion.names)
        self.names = (*self.motion.names, "clock_bias", "clock_drift", "inter_system_bias")
        self.units = (*self.motion.units, "m", "m/s", "m")
        clocks = {name: (first + i,) for i, name in enumerate(self.names[first:])}
        self.groups = {**self.motion.groups, **clocks}
        self.choices = (
            *self.motion.choices,
            "errors of code and Doppler are modelled as white; multipath is correlated, "
            "so their standard deviations are inflated",
        )

    @override
    def propagate(self, x: Tensor, u: TightMemsInputs, w: Tensor) -> Tensor:
        motion, bias, drift, inter_system = x.split([_MOTION_TIGHT, 1, 1, 1], -1)
        motion = self.motion.propagate(motion, u.increments, w[..., :_DRIVEN_TIGHT])
        span = u.increments.duration
        clock = torch.cat([bias + drift * span[:, None, None], drift, inter_system], -1)
        return torch.cat([motion, clock + w[..., _DRIVEN_TIGHT:] @ self._clock_gain(span).mT], -1)

    @override
    def noise_gain(self, u: TightMemsInputs) -> Tensor:
        clock = self._clock_gain(u.increments.duration)
        return block_diagonal(self.motion.noise_gain(u.increments), clock)

    def _clock_gain(self, duration: Tensor) -> Tensor:
        """Return the noise gain of bias, drift and inter-system bias [R or 1, 3, 3]."""
        walk = (self.other_walk * torch.sqrt(duration))[:, None, None]
        return block_diagonal(self.clock.noise_gain(duration), walk)

    @override
    def observation(self, x: Tensor, u: TightMemsInputs) -> Distribution:
        ranges, rates = predict_raw(x[..., 7:10], x[..., 4:7], u)
        bias, drift, inter_system = x[..., _MOTION_TIGHT:].split(1, -1)
        ranges, rates = ranges + bias + inter_system * u.other_system.unsqueeze(1), rates + drift
        sd = torch.cat([self.range.sd(u.range_sd), self.rate.sd(u.rate_sd)], -1)
        return independent_normal(torch.cat([ranges, rates], -1), sd.unsqueeze(1))

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        motion = self.motion.assemble(truth)
        missing = motion.new_full((*motion.shape[:-1], 1), torch.nan)
        clocks = [truth.get(name, missing) for name in list(self.groups)[len(self.motion.groups) :]]
        return torch.cat([motion, *clocks], -1)
