"""Total-state loosely coupled INS/GNSS for MEMS sensors: attitude, velocity, position and sensor biases themselves.

With gyro biases of a degree per second an open-loop INS is useless after seconds, and an error state about it with it; so the
state is the motion, and the IMU enters as increments preintegrated over a filter interval, with first-order corrections for
the bias [Forster, Carlone, Dellaert, Scaramuzza 2017, "On-manifold preintegration for real-time visual-inertial odometry"].
A step is then one cheap map for all particles, whatever the rate of the IMU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart, Euclidean, Quaternion
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch, positive
from pfbench.nav import attitude
from pfbench.record import Record

_SIZES = (4, 3, 3, 3, 3)  # quaternion, velocity, position, gyro bias, accelerometer bias
_CHART = Chart((Quaternion(), Euclidean(12)))


class Increments(NamedTuple):
    """What an IMU says of each filter interval, in body axes (right, forward, up) at its start, gravity left out.

    Attributes:
        turn: rotation from the body at the end to the body at the start, quaternion [R or 1, T, 4].
        push: velocity increment [R or 1, T, 3] m/s.
        shift: position increment from rest [R or 1, T, 3] m.
        jacobian: derivatives of (rotation vector on the right of `turn`, push, shift) by (gyro, accelerometer) bias
            [R or 1, T, 9, 6].
        bias: gyro and accelerometer bias that were taken off [R or 1, T, 6] rad/s, m/s^2.
        gravity: [R or 1, T] m/s^2, downwards.
        duration: [R or 1, T] s; 0 is an interval in which nothing happens, after the end of a short run.
    """

    turn: Tensor
    push: Tensor
    shift: Tensor
    jacobian: Tensor
    bias: Tensor
    gravity: Tensor
    duration: Tensor


@dataclass(frozen=True)
class Believed:
    """What filters are told about the sensors, the receiver and the start.

    Args:
        gyro_density, accelerometer_density: effective root densities, vibration included, rad/s/sqrt(Hz) and m/s^2/sqrt(Hz).
        gyro_bias_walk, accelerometer_bias_walk: of the biases, rad/s/sqrt(s) and m/s^2/sqrt(s).
        position_sd: of a fix, East, North, Up in m.
        velocity_sd: of a measured velocity, East, North, Up in m/s; None where velocity is not measured.
        attitude_sd_deg: initial, about the right, forward and up axis of the body (pitch, roll, yaw), degrees.
        initial_velocity_sd, initial_position_sd: East, North, Up in m/s and m.
        gyro_bias_sd_deg_s, accelerometer_bias_sd: initial, of each axis, deg/s and m/s^2.
        gyro_bias_deg_s, accelerometer_bias: nominal biases in the axes of the files (forward, right, down), deg/s and m/s^2.
    """

    gyro_density: float
    accelerometer_density: float
    gyro_bias_walk: float
    accelerometer_bias_walk: float
    position_sd: Sequence[float]
    velocity_sd: Sequence[float] | None
    attitude_sd_deg: Sequence[float]
    initial_velocity_sd: Sequence[float]
    initial_position_sd: Sequence[float]
    gyro_bias_sd_deg_s: float
    accelerometer_bias_sd: float
    gyro_bias_deg_s: Sequence[float] = (0.0, 0.0, 0.0)
    accelerometer_bias: Sequence[float] = (0.0, 0.0, 0.0)

    @property
    def initial_sd(self) -> Tensor:
        """Standard deviations of the initial errors in the chart [15], SI.

        Raises:
            ValueError: one that is not positive, or not three numbers where three are needed.
        """
        degree = math.pi / 180.0
        parts = [three("believed.attitude_sd_deg", self.attitude_sd_deg) * degree]
        parts += [three("believed.initial_velocity_sd", self.initial_velocity_sd)]
        parts += [three("believed.initial_position_sd", self.initial_position_sd)]
        parts += [positive("believed.gyro_bias_sd_deg_s", [self.gyro_bias_sd_deg_s] * 3) * degree]
        return torch.cat([*parts, positive("believed.accelerometer_bias_sd", [self.accelerometer_bias_sd] * 3)])

    @property
    def measurement_sd(self) -> Tensor:
        """Standard deviations of a measurement [3 or 6], SI. Raises as `initial_sd`."""
        position = three("believed.position_sd", self.position_sd)
        if self.velocity_sd is None:
            return position
        return torch.cat([position, three("believed.velocity_sd", self.velocity_sd)])

    @property
    def bias(self) -> Tensor:
        """Nominal gyro and accelerometer bias in the axes of the model (right, forward, up) [6], SI."""
        (gf, gr, gd), (af, ar, ad) = self.gyro_bias_deg_s, self.accelerometer_bias
        gyro = torch.tensor([gr, gf, -gd], dtype=torch.float64) * (math.pi / 180.0)
        return torch.cat([gyro, torch.tensor([ar, af, -ad], dtype=torch.float64)])


class StrapdownTotal(StateSpaceModel):
    """State [16]: quaternion body to level, velocity and position (East, North, Up), gyro and accelerometer bias (body axes).

    Over an interval T, with increments corrected for the bias, q' = q (turn) exp(a), v' = v - g T + C push + n and
    p' = p + v T - g T^2 / 2 + C shift + n T / 2, where a and n are the integrals of white gyro and accelerometer noise; the
    biases walk. The position's noise is the exact regression on the velocity's; the rest, a variance of q T^3 / 12 (millimetres
    at a quarter of a second), is left out, so that 12 normals drive 15 components. Errors of attitude are rotation vectors in
    body axes: about right (pitch), forward (roll) and up (yaw). What is seen: position, or position and velocity.

    Args:
        believed: standard deviations and densities.

    Raises:
        ValueError: a density or standard deviation that is not positive.
    """

    density: Tensor
    r: Tensor
    p0: Tensor
    noise_dim = 12
    choices = (
        "flat Earth about the start with constant normal gravity; the Earth's rate (0.004 deg/s) is left to the gyro bias",
        "position noise over an interval is half the velocity noise times the interval (its exact regression)",
    )

    def __init__(self, believed: Believed) -> None:
        super().__init__()
        density = {
            "gyro_density": believed.gyro_density,
            "accelerometer_density": believed.accelerometer_density,
            "gyro_bias_walk": believed.gyro_bias_walk,
            "accelerometer_bias_walk": believed.accelerometer_bias_walk,
        }
        roots = [positive(f"believed.{name}", [value] * 3) for name, value in density.items()]
        self.register_buffer("density", torch.cat(roots))
        self.register_buffer("r", believed.measurement_sd)
        self.register_buffer("p0", believed.initial_sd)
        axes = {
            "attitude": (("pitch", "roll", "yaw"), "rad"),
            "velocity": (("E", "N", "U"), "m/s"),
            "position": (("E", "N", "U"), "m"),
            "gyro_bias": (("right", "forward", "up"), "rad/s"),
            "accelerometer_bias": (("right", "forward", "up"), "m/s^2"),
        }
        self.names = tuple(f"{group}_{axis}" for group, (parts, _) in axes.items() for axis in parts)
        self.units = tuple(unit for _, unit in axes.values() for _ in range(3))
        self.groups = {group: (3 * i, 3 * i + 1, 3 * i + 2) for i, group in enumerate(axes)}

    @property
    def chart(self) -> Chart:
        return _CHART

    @property
    def anchor(self) -> Tensor:
        return self.p0

    @property
    def origin(self) -> Tensor:
        """Level, facing North, at rest, without biases; a recorded world hands over each run's own start instead."""
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(15)])

    def prepare(self, record: Record) -> Record:
        """The record as it is.

        Raises:
            ValueError: inputs of another kind, or measurements that do not fit the believed standard deviations.
        """
        if not isinstance(record.u, Increments):
            kind = type(record.u).__name__
            raise ValueError(f"record.u is {kind}: StrapdownTotal needs Increments; choose a recorded scenario")
        if record.y.shape[-1] != len(self.r):
            raise ValueError(
                f"the scenario measures {record.y.shape[-1]} components, believed.position_sd and velocity_sd give "
                f"{len(self.r)}: set believed.velocity_sd and receiver.velocity_sd both to three numbers, or both to null"
            )
        return record

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Increments, w: Tensor) -> Tensor:
        q, v, p, *biases = x.split(_SIZES, -1)
        change = (torch.cat(biases, -1) - u.bias.unsqueeze(1)) @ u.jacobian.mT
        turn, push, shift = change.split(3, -1)
        turn = attitude.quaternion_multiply(u.turn.unsqueeze(1), attitude.quaternion_from_rotation_vector(turn))
        span = u.duration[:, None, None]
        fall = torch.stack([torch.zeros_like(u.gravity), torch.zeros_like(u.gravity), -u.gravity], -1).unsqueeze(1) * span
        moved = p + (v + 0.5 * fall) * span + turned(q, u.shift.unsqueeze(1) + shift)
        faster = v + fall + turned(q, u.push.unsqueeze(1) + push)
        quiet = torch.cat([attitude.quaternion_multiply(q, turn), faster, moved, *biases], -1)
        return self.chart.add(quiet, w @ self.noise_gain(u).mT)

    def noise_gain(self, u: Increments) -> Tensor:
        root = torch.sqrt(u.duration)[:, None] * self.density  # [R or 1, 12]
        gain = root.new_zeros(root.shape[0], 15, 12)
        gain[:, :6, :6] = torch.diag_embed(root[:, :6])
        gain[:, 6:9, 3:6] = torch.diag_embed(0.5 * u.duration[:, None] * root[:, 3:6])
        gain[:, 9:, 6:] = torch.diag_embed(root[:, 6:])
        return gain

    def observation(self, x: Tensor, u: Increments) -> Distribution:
        mean = x[..., 7:10] if len(self.r) == 3 else torch.cat([x[..., 7:10], x[..., 4:7]], -1)
        return independent_normal(mean, self.r)

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """True state of an Episode: group `attitude` is a quaternion [R, T, 4]; NaN where a group has no truth.

        Raises:
            ValueError: no group of this model has a truth.
        """
        known = [truth[name] for name in self.groups if name in truth]
        if not known:
            raise ValueError(f"truth has {sorted(truth)}, the model's groups are {sorted(self.groups)}: none has a truth")
        missing = known[0].new_full((*known[0].shape[:-1], 1), torch.nan)
        sized = zip(self.groups, _SIZES, strict=True)
        return torch.cat([truth.get(name, missing.expand(*missing.shape[:-1], size)) for name, size in sized], -1)


@torch.no_grad()
def preintegrate(force: Tensor, rate: Tensor, spans: Tensor, bias: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Increments of an interval from its S pieces, each with a mean specific force and angular rate.

    The force of a piece is turned by the attitude at its middle: second order in the pieces. A piece of no duration does
    nothing, so intervals of unequal numbers of samples can be filled up with such.

    Args:
        force: measured specific force, body axes [..., S, 3] m/s^2.
        rate: measured angular rate [..., S, 3] rad/s.
        spans: durations [..., S] s.
        bias: gyro and accelerometer bias to be taken off [..., 6].

    Returns:
        turn [..., 4], push [..., 3], shift [..., 3] and jacobian [..., 9, 6], as in `Increments`.
    """
    half_turn = (rate - bias[..., None, :3]) * (0.5 * spans.unsqueeze(-1))
    halves = attitude.dcm_from_rotation_vector(half_turn)
    slips = 0.5 * spans[..., None, None] * right_jacobian(half_turn)
    f = force - bias[..., None, 3:]
    c = torch.eye(3, dtype=f.dtype, device=f.device).expand(*f.shape[:-2], 3, 3)
    v, p = torch.zeros_like(f[..., 0, :]), torch.zeros_like(f[..., 0, :])
    by_c, by_v, by_p = (f.new_zeros(*f.shape[:-2], 3, k) for k in (3, 6, 6))  # by_c: gyro bias alone
    for k in range(spans.shape[-1]):
        half, slip, dt = halves[..., k, :, :], slips[..., k, :, :], spans[..., k, None]
        middle, by_middle = c @ half, half.mT @ by_c - slip
        a = (middle @ f[..., k, :, None]).squeeze(-1)
        by_a = torch.cat([-middle @ attitude.skew(f[..., k, :]) @ by_middle, -middle], -1)
        p, by_p = p + (v + 0.5 * a * dt) * dt, by_p + (by_v + 0.5 * by_a * dt[..., None]) * dt[..., None]
        v, by_v = v + a * dt, by_v + by_a * dt[..., None]
        c, by_c = middle @ half, half.mT @ by_middle - slip
    top = torch.cat([by_c, torch.zeros_like(by_c)], -1)
    return attitude.quaternion_from_dcm(c), v, p, torch.cat([top, by_v, by_p], -2)


def right_jacobian(r: Tensor) -> Tensor:
    """J with exp(r + d) = exp(r) exp(J d) to first order [..., 3, 3], to third order in the rotation vector r [..., 3]."""
    k = attitude.skew(r)
    return torch.eye(3, dtype=r.dtype, device=r.device) - 0.5 * k + k @ k / 6.0 - k @ k @ k / 24.0


def turned(q: Tensor, a: Tensor) -> Tensor:
    """Vectors a [..., 3] turned by unit quaternions q [..., 4]."""
    axis = q[..., 1:].expand(torch.broadcast_shapes(q[..., 1:].shape, a.shape))
    twice = 2.0 * torch.linalg.cross(axis, a.expand_as(axis))
    return a + q[..., :1] * twice + torch.linalg.cross(axis, twice)


def three(name: str, values: Sequence[float]) -> Tensor:
    """Three positive numbers [3].

    Raises:
        ValueError: names the key, the value and the remedy.
    """
    if len(values) != 3:
        raise ValueError(f"{name}={list(values)}: give three numbers")
    return positive(name, list(values))
