"""Tightly coupled SINS/GNSS for a heading that is not known: 17 errors, the attitude's an exact rotation of any size."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart, Euclidean, Quaternion
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch
from pfbench.model.sins_gnss_tight import GROUPS, NAMES, UNITS, expected, initial_sd, tracked
from pfbench.model.strapdown_total import turned
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import Alignment
from pfbench.nav.ranging import Sight, TightReceiver
from pfbench.nav.sensors import ImuErrors
from pfbench.record import Record

_CHART = Chart((Quaternion(), Euclidean(14)))


class Step(NamedTuple):
    """What the INS made of each interval, and what is expected at its end.

    Attributes:
        dcm: body to level at mid-interval [R, T, 3, 3].
        pos, pos_start, pos_end, vel, w_in, f, duration: see `strapdown.Intervals`.
        sine, cosine, height, vel_end, distance, line, closing: see `ranging.Sight`.
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


class SinsGnssTightNl(StateSpaceModel):
    """`SinsGnssTight` with nothing linearised: errors of an INS that was aligned by guess, 45 degrees off in heading, say.

    State [18]: quaternion of E, which turns vectors of the true level frame into the one that the INS believes in, C_ins =
    E C_true; then velocity, position (metres at the true place), gyro and accelerometer bias, clock, as in `SinsGnssTight`.
    Differences are rotation vectors in true East, North, Up, small ones E ~ I - skew(phi). Over an interval

        E <- exp(-w_in T) exp(C eps T) E exp(w_true T),   dv' = f - E' (f - C nab) - Coriolis and gravity of INS minus truth,

    with the rate w_true at the true place and velocity in the middle, and E' the mean of both ends. The specific force enters
    as the impulse that the mechanisation summed up at the sensors' rate, so one step serves for a whole interval: E changes by
    1e-4 in a second, and what the force does within one is in the impulse; cutting it into steps of 0.1 s changes a minute's
    velocity by less than the accelerometers' noise. [ours]

    The noise is additive in the chart and does not depend on the attitude, being isotropic: attitude, velocity and position
    (with its exact covariance to the velocity), clock; what gyro noise does to the velocity within one interval is left out.

    Args:
        imu: what the model believes of the sensors.
        receiver: what it believes of the receiver and its clock.
        initial: what it believes of the initial errors.

    Raises:
        ValueError: a sensor's bias of 0, which would make the initial law improper, or one with a Markov part.
    """

    p0: Tensor
    r: Tensor
    names, units, groups = NAMES, UNITS, GROUPS
    noise_dim = 11
    choices = ("an interval's specific force enters as one impulse, not in steps of 0.1 s",)

    def __init__(self, imu: ImuErrors, receiver: TightReceiver, initial: Alignment) -> None:
        super().__init__()
        self.imu, self.clock = imu, receiver.clock
        self.register_buffer("p0", initial_sd(imu, receiver.clock, initial))
        self.register_buffer("r", receiver.sd)

    @property
    def chart(self) -> Chart:
        return _CHART

    @property
    def anchor(self) -> Tensor:
        return self.p0

    @property
    def origin(self) -> Tensor:
        """An INS without errors."""
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(17)])

    def prepare(self, record: Record) -> Record:
        """What is expected of the satellites, once for all steps. Raises as `sins_gnss_tight.tracked`."""
        if isinstance(record.u, Step):
            return record
        u = tracked(record, len(self.r))
        dcm = error_dynamics.mid_interval(u.intervals).dcm
        motion = (dcm, u.pos, u.pos_start, u.pos_end, u.vel, u.w_in, u.f, u.duration)
        return record._replace(u=Step(*motion, *u.sight))

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Step, w: Tensor) -> Tensor:
        return self.chart.add(self._carried(x, u), w @ self.noise_gain(u).mT)

    def noise_gain(self, u: Step) -> Tensor:
        root, span = torch.sqrt(u.duration)[:, None, None], u.duration[:, None, None]
        eye = torch.eye(3, dtype=root.dtype, device=root.device)
        velocity = self.imu.accelerometer_random_walk * root * eye
        gain = root.new_zeros(len(root), 17, 11)
        gain[:, 0:3, 0:3] = self.imu.gyro_random_walk * root * eye
        gain[:, 3:6, 3:6] = velocity
        gain[:, 6:9, 3:6] = (0.5 * span * velocity)[:, [1, 0, 2]]  # position is North first, velocity East
        gain[:, 6:9, 6:9] = span / math.sqrt(12.0) * velocity
        gain[:, 15:, 9:] = self.clock.gain(u.duration)
        return gain

    def observation(self, x: Tensor, u: Step) -> Distribution:
        return independent_normal(expected(x[..., 7:10], x[..., 4:7], x[..., 16:], Sight(*u[8:])), self.r)

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """True state of an Episode [R, T, 18]; its attitude error is of the law C_true = C(alpha) C_ins."""
        flat = super().assemble(truth | {"attitude": truth["attitude"]})[..., :17]
        q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(flat[..., :3]).mT)
        return torch.cat([q, flat[..., 3:]], -1)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Corrected navigation minus truth; for the sensors and the clock, estimate minus truth."""
        d = self.chart.subtract(mean, truth)
        return torch.cat([d[..., :3], -d[..., 3:9], d[..., 9:]], -1)

    def _carried(self, x: Tensor, u: Step) -> Tensor:
        """The state after an interval without noise [R, N, 18]."""
        q, dv, dp, gyro, accelerometer, clock = x.split((4, 3, 3, 3, 3, 2), -1)
        span = u.duration[:, None, None]
        level = _Level(*(a.unsqueeze(1) for a in (u.pos, u.vel, u.w_in)))
        f = u.f.unsqueeze(1) - accelerometer @ u.dcm.mT
        start = dp / _scale_true(dp, u.pos_start)
        back = _conjugate(q)
        push = u.f.unsqueeze(1) - turned(back, f) + level.sink(dv, start)
        middle = start + 0.5 * span * level.drift(dv + 0.25 * span * push, start)
        dv_middle = dv + 0.5 * span * push
        turn = attitude.quaternion_from_rotation_vector
        q = attitude.quaternion_multiply(q, turn(span * level.rate(dv_middle, middle)))
        q = attitude.quaternion_multiply(turn(span * (gyro @ u.dcm.mT)), q)
        q = attitude.quaternion_multiply(turn(-span * level.w_in), q)
        force = 0.5 * (turned(back, f) + turned(_conjugate(q), f))
        dv_end = dv + span * (u.f.unsqueeze(1) - force + level.sink(dv_middle, middle))
        end = start + span * level.drift(0.5 * (dv + dv_end), middle)
        ticked = torch.cat([clock[..., :1] + span * clock[..., 1:], clock[..., 1:]], -1)
        return torch.cat([q, dv_end, _metres(end, u.pos_end), gyro, accelerometer, ticked], -1)


class _Level(NamedTuple):
    """The INS at mid-interval [R, 1, 3]; errors dv m/s and dp rad, rad, m are [R, N, 3], INS minus truth."""

    pos: Tensor
    vel: Tensor
    w_in: Tensor

    def rate(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Rate of the true level frame in inertial space."""
        pos = self.pos - dp
        return earth.earth_rate(pos[..., 0]) + earth.transport_rate(pos[..., 0], pos[..., 2], self.vel - dv)

    def drift(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Rate of dp."""
        return earth.position_rate(self.pos, self.vel) - earth.position_rate(self.pos - dp, self.vel - dv)

    def sink(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Acceleration of the INS minus that of the truth, but for specific force: Coriolis' and gravity's."""
        return _free(self.pos, self.vel, self.w_in) - _free(self.pos - dp, self.vel - dv, self.rate(dv, dp))


def _free(pos: Tensor, vel: Tensor, w_in: Tensor) -> Tensor:
    fall = earth.gravity(pos[..., 0], pos[..., 2])
    spin = earth.earth_rate(pos[..., 0]) + w_in
    return -torch.linalg.cross(spin, vel) - torch.stack([torch.zeros_like(fall), torch.zeros_like(fall), fall], -1)


def _scale_true(dp: Tensor, pos: Tensor) -> Tensor:
    """Metres per (rad, rad, m) at the truth [R, N, 3], dp metres [R, N, 3] short of the INS's pos [R, 3]."""
    lat, height = pos[:, :1], pos[:, 2:] - dp[..., 2]
    for _ in range(2):
        lat = pos[:, :1] - dp[..., 0] / (earth.radii(lat)[0] + height)
    return earth.metre_scale(torch.stack([lat, lat, height], -1))


def _metres(offset: Tensor, pos: Tensor) -> Tensor:
    """Offsets in (rad, rad, m) [R, N, 3] from pos [R, 3] in metres at the truth; the inverse of dividing by `_scale_true`."""
    return offset * earth.metre_scale(pos.unsqueeze(1) - offset)


def _conjugate(q: Tensor) -> Tensor:
    return torch.cat([q[..., :1], -q[..., 1:]], -1)
