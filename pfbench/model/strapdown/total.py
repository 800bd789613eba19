"""Total-state loosely coupled INS/GNSS for MEMS sensors.

With gyro biases of a degree per second an open-loop INS, and an error state about it, is useless
after seconds. The state is therefore the motion with the sensor biases. IMU data enter as
increments over a filter interval, with first-order bias corrections (`preintegration`). A step
is then one inexpensive map for all particles at any IMU rate.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core import quaternion
from pfbench.core.channels import name_channels
from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.manifold.group_block import LieGroupBlock
from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive, check_tuning
from pfbench.core.record import Record
from pfbench.model.base import StateSpaceModel, check_truth_sizes
from pfbench.model.ins_errors import name_components
from pfbench.model.strapdown.tuning import StrapdownTuning
from pfbench.nav.preintegration import PreintegratedImu, rotate

_SIZES = (4, 3, 3, 3, 3)  # quaternion, velocity, position, gyro bias, accelerometer bias
_CHART = Chart((QuaternionBlock(), EuclideanBlock(12)))
_AXES = ("East", "North", "Up")
FIX_CHANNELS = (*name_channels("position", _AXES, "m"), *name_channels("velocity", _AXES, "m/s"))


class StrapdownTotal(StateSpaceModel):
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

    input_type = PreintegratedImu
    density: Tensor
    r: Tensor
    p0: Tensor
    noise_dim = 12
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

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    def group_chart(self, side: str) -> Chart:
        """Return an invariant chart: attitude, velocity and position are an element of SE_2(3).

        The noise gain holds in the left chart as well, to first order in the attitude noise of a step.
        The reason is that the density of the accelerometer is the same in all axes.

        Args:
            side: `left` or `right`, see LieGroupBlock.
        """
        return Chart((LieGroupBlock(side=side), EuclideanBlock(6)))

    @property
    @override
    def anchor(self) -> Tensor:
        return self.p0

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(15)])

    @override
    def prepare(self, record: Record) -> Record:
        record = super().prepare(record)
        if record.y.shape[-1] != len(self.r):
            raise ValueError(
                f"the scenario must measure the {len(self.r)} components of tuning.position_sd "
                f"and velocity_sd, got {record.y.shape[-1]}. Set tuning.velocity_sd and "
                "receiver.velocity_sd both to three numbers, or both to null."
            )
        return record

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

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
        if not values:
            raise ValueError(
                f"truth must contain a group of the model, {sorted(self.groups)}, "
                f"got {sorted(truth)}. Choose a scenario that fits the model."
            )
        missing = values[0].new_full((*values[0].shape[:-1], 1), torch.nan)
        blocks = [
            truth.get(name, missing.expand(*missing.shape[:-1], size))
            for name, size in sizes.items()
        ]
        return torch.cat(blocks, -1)
