"""Tightly coupled SINS/GNSS for unknown heading, with exact attitude errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core import quaternion
from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.normal import independent_normal
from pfbench.core.record import Record
from pfbench.model.ins_errors import InsErrorModel
from pfbench.model.tight_coupling import (
    NAMES,
    TIGHT_GROUPS,
    UNITS,
    check_satellites,
    compute_initial_sd,
    predict_measurement,
)
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import AlignmentErrors
from pfbench.nav.gnss.ranging import RangingReceiver
from pfbench.nav.gnss.satellite_geometry import SatelliteGeometry
from pfbench.nav.imu_errors import ImuErrors
from pfbench.nav.preintegration import rotate

_CHART = Chart((QuaternionBlock(), EuclideanBlock(14)))


class NonlinearTightStep(NamedTuple):
    """INS output over each interval, and the predicted geometry at its end.

    Attributes:
        dcm: Body to level at mid-interval, [R, T, 3, 3].
        pos, pos_start, pos_end, vel, w_in, f, duration: See `InsIntervals`.
        sine, cosine, height, vel_end, distance, line, closing: See `SatelliteGeometry`, whose `vel`
            is `vel_end`.
    """

    dcm: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    vel: Tensor
    w_in: Tensor
    f: Tensor
    duration: Tensor
    sine: Tensor
    cosine: Tensor
    height: Tensor
    vel_end: Tensor
    distance: Tensor
    line: Tensor
    closing: Tensor


class SinsGnssTightNl(InsErrorModel):
    """`SinsGnssTight` without linearisation, for INS errors of any size.

    An example is an INS with an approximate initial heading, wrong by 45 degrees. State [18]:
    quaternion of E, which rotates vectors of the true level frame to the INS level frame,
    C_ins = E C_true. Then velocity, position (metres at the true position), gyro and accelerometer
    bias, clock, as in `SinsGnssTight`. Differences are rotation vectors in true East, North, Up,
    small ones E ~ I - skew(phi). Over an interval

        E <- exp(-w_in T) exp(C eps T) E exp(w_true T),
        dv' = f - E' (f - C nab) + Coriolis and gravity terms (INS minus truth),

    with the rate w_true at the true position and velocity of mid-interval, and E' the mean of both
    ends. The specific force enters as the impulse summed by the mechanisation at the sensor rate,
    so one step covers an interval. E changes by 1e-4 in a second. Steps of 0.1 s change the
    velocity after a minute by less than the accelerometer noise. [ours]

    The noise is additive in the chart and isotropic, so it does not depend on the attitude. It
    drives attitude, velocity and position (with exact covariance to velocity) and clock. The effect
    of gyro noise on velocity within one interval is omitted. `error` is corrected navigation minus
    truth, for sensors and clock estimate minus truth.

    Args:
        imu: Sensor errors that the model assumes.
        receiver: Receiver noise and clock that the model assumes.
        initial: Initial errors that the model assumes.

    Raises:
        ValueError: If a sensor bias is 0, which makes the initial distribution improper, or a
            sensor has a Markov part.
    """

    channel_names, input_type = RangingReceiver.channel_names, RangingReceiver.input_type
    r: Tensor
    names, units, groups = NAMES, UNITS, TIGHT_GROUPS
    noise_dim = 11
    choices = ("an interval's specific force enters as one impulse, not in steps of 0.1 s",)

    def __init__(self, imu: ImuErrors, receiver: RangingReceiver, initial: AlignmentErrors) -> None:
        super().__init__()
        self.check_receiver(receiver)
        self.imu, self.clock = imu, receiver.clock
        self.register_buffer("p0", compute_initial_sd(imu, receiver.clock, initial))
        self.register_buffer("r", receiver.sd)

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(17)])

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, NonlinearTightStep):
            return record
        u = check_satellites(super().prepare(record), len(self.r))
        dcm = error_dynamics.mid_interval(u.intervals).dcm
        interval = (dcm, u.pos, u.pos_start, u.pos_end, u.vel, u.w_in, u.f, u.duration)
        return record._replace(u=NonlinearTightStep(*interval, *u.sight))

    @override
    def propagate(self, x: Tensor, u: NonlinearTightStep, w: Tensor) -> Tensor:
        return self.chart.add(self._propagate_mean(x, u), w @ self.noise_gain(u).mT)

    @override
    def noise_gain(self, u: NonlinearTightStep) -> Tensor:
        root, span = torch.sqrt(u.duration)[:, None, None], u.duration[:, None, None]
        eye = torch.eye(3, dtype=root.dtype, device=root.device)
        velocity = self.imu.accelerometer_random_walk * root * eye
        gain = root.new_zeros(len(root), 17, 11)
        gain[:, 0:3, 0:3] = self.imu.gyro_random_walk * root * eye
        gain[:, 3:6, 3:6] = velocity
        gain[:, 6:9, 3:6] = (0.5 * span * velocity)[
            :, [1, 0, 2]
        ]  # position is North first, velocity East
        gain[:, 6:9, 6:9] = span / math.sqrt(12.0) * velocity
        gain[:, 15:, 9:] = self.clock.noise_gain(u.duration)
        return gain

    @override
    def observation(self, x: Tensor, u: NonlinearTightStep) -> Distribution:
        mean = predict_measurement(
            x[..., 7:10], x[..., 4:7], x[..., 16:], SatelliteGeometry(*u[8:])
        )
        return independent_normal(mean, self.r)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        flat = super().assemble(truth | {"attitude": truth["attitude"]})[..., :17]
        q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(flat[..., :3]).mT)
        return torch.cat([q, flat[..., 3:]], -1)

    @override
    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        d = self.chart.subtract(mean, truth)
        return torch.cat([d[..., :3], -d[..., 3:9], d[..., 9:]], -1)

    def _propagate_mean(self, x: Tensor, u: NonlinearTightStep) -> Tensor:
        """Propagate the state over an interval without noise, [R, N, 18]."""
        q, dv, dp, gyro, accelerometer, clock = x.split((4, 3, 3, 3, 3, 2), -1)
        span = u.duration[:, None, None]
        level = _Level(*(a.unsqueeze(1) for a in (u.pos, u.vel, u.w_in)))
        f = u.f.unsqueeze(1) - accelerometer @ u.dcm.mT
        start = dp / _scale_true(dp, u.pos_start)
        inverse = _conjugate(q)
        acceleration = u.f.unsqueeze(1) - rotate(inverse, f) + level.free_acceleration(dv, start)
        middle = start + 0.5 * span * level.drift(dv + 0.25 * span * acceleration, start)
        dv_middle = dv + 0.5 * span * acceleration
        exp = quaternion.quaternion_from_rotation_vector
        q = quaternion.quaternion_multiply(q, exp(span * level.rate(dv_middle, middle)))
        q = quaternion.quaternion_multiply(exp(span * (gyro @ u.dcm.mT)), q)
        q = quaternion.quaternion_multiply(exp(-span * level.w_in), q)
        force = 0.5 * (rotate(inverse, f) + rotate(_conjugate(q), f))
        dv_end = dv + span * (u.f.unsqueeze(1) - force + level.free_acceleration(dv_middle, middle))
        end = start + span * level.drift(0.5 * (dv + dv_end), middle)
        clock = torch.cat([clock[..., :1] + span * clock[..., 1:], clock[..., 1:]], -1)
        return torch.cat([q, dv_end, _metres(end, u.pos_end), gyro, accelerometer, clock], -1)


class _Level(NamedTuple):
    """INS at mid-interval [R, 1, 3], for errors dv m/s and dp rad, rad, m [R, N, 3]."""

    pos: Tensor
    vel: Tensor
    w_in: Tensor

    def rate(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute the rate of the true level frame in inertial space.

        Args:
            dv: Velocity errors, [R, N, 3].
            dp: Position errors, [R, N, 3].
        """
        pos = self.pos - dp
        return earth.earth_rate(pos[..., 0]) + earth.transport_rate(
            pos[..., 0], pos[..., 2], self.vel - dv
        )

    def drift(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute the rate of dp.

        Args:
            dv: Velocity errors, [R, N, 3].
            dp: Position errors, [R, N, 3].
        """
        return earth.position_rate(self.pos, self.vel) - earth.position_rate(
            self.pos - dp, self.vel - dv
        )

    def free_acceleration(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute Coriolis acceleration plus gravity, INS minus truth.

        Args:
            dv: Velocity errors, [R, N, 3].
            dp: Position errors, [R, N, 3].
        """
        true = _free(self.pos - dp, self.vel - dv, self.rate(dv, dp))
        return _free(self.pos, self.vel, self.w_in) - true


def _free(pos: Tensor, vel: Tensor, w_in: Tensor) -> Tensor:
    g = earth.gravity(pos[..., 0], pos[..., 2])
    rate = earth.earth_rate(pos[..., 0]) + w_in
    gravity = torch.stack([torch.zeros_like(g), torch.zeros_like(g), g], -1)
    return -torch.linalg.cross(rate, vel) - gravity


def _scale_true(dp: Tensor, pos: Tensor) -> Tensor:
    """Return metres per (rad, rad, m) at the truth [R, N, 3] from INS pos [R, 3]."""
    lat, height = pos[:, :1], pos[:, 2:] - dp[..., 2]
    for _ in range(2):
        lat = pos[:, :1] - dp[..., 0] / (earth.radii(lat)[0] + height)
    return earth.metre_scale(torch.stack([lat, lat, height], -1))


def _metres(offset: Tensor, pos: Tensor) -> Tensor:
    """Convert offsets (rad, rad, m) from pos [R, 3] to metres at the truth [R, N, 3]."""
    return offset * earth.metre_scale(pos.unsqueeze(1) - offset)


def _conjugate(q: Tensor) -> Tensor:
    return torch.cat([q[..., :1], -q[..., 1:]], -1)
