"""States, measurements and inputs that tightly coupled SINS/GNSS models share."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core import chart as quaternion
from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.density import independent_normal
from pfbench.core.linear_algebra import affine_map, factor
from pfbench.core.parameter_checks import as_float64, require
from pfbench.core.record import Record, map_inputs
from pfbench.model.ins_gnss import (
    BIASES,
    NAVIGATION,
    InsErrorModel,
    additive_transition,
    name_ins_components,
)
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import AlignmentErrors, ProcessNoiseInflation
from pfbench.nav.imu_errors import ImuErrors
from pfbench.nav.orbits import SatelliteGeometry
from pfbench.nav.ranging import RangingInputs, RangingReceiver, ReceiverClock
from pfbench.nav.strapdown import rotate

_INS = name_ins_components(NAVIGATION + BIASES)
NAMES = (*_INS.names, "clock_bias", "clock_drift")
UNITS = (*_INS.units, "m", "m/s")
TIGHT_GROUPS = {**_INS.groups, "clock": (15, 16)}


def predict_measurement(
    position: Tensor, velocity: Tensor, clock: Tensor, sight: SatelliteGeometry
) -> Tensor:
    """Predict INS minus receiver, ranges and then rates, [R, N, 2 S].

    Returns the prediction. Shapes: position [R, N, 3], velocity [R, N, 3], clock [R, N, 2].
    """
    ranges, rates = sight.range_differences(position, velocity)
    return torch.cat([ranges - clock[..., :1], rates - clock[..., 1:]], -1)


def compute_initial_sd(imu: ImuErrors, clock: ReceiverClock, initial: AlignmentErrors) -> Tensor:
    """Return the standard deviations of the initial errors, [17]."""
    require(
        not imu.gyro_markov > 0.0 and (not imu.accelerometer_markov > 0.0),
        "model.imu",
        "not have Markov parts",
        f"{imu.gyro_markov_deg_h} deg/h and {imu.accelerometer_markov_ug} ug",
        "Biases are constant in this model. Set gyro_markov_deg_h and accelerometer_markov_ug to 0.",
    )
    sizes = [imu.gyro_bias] * 3 + [imu.accelerometer_bias] * 3 + [clock.bias_sd, clock.drift_sd]
    require(
        not min(sizes) <= 0.0,
        "model.imu",
        "have positive gyro and accelerometer biases",
        f"{imu.gyro_bias_deg_h} deg/h and {imu.accelerometer_bias_ug} ug",
        "Change them.",
    )
    return torch.cat([initial.sd, as_float64(sizes)])


class _TightModel(InsErrorModel):
    """States, sensors and measurements of the tightly coupled models."""

    channel_names, input_type = RangingReceiver.channel_names, RangingReceiver.input_type
    r: Tensor
    names, units, groups = NAMES, UNITS, TIGHT_GROUPS

    def __init__(self, imu: ImuErrors, receiver: RangingReceiver, initial: AlignmentErrors) -> None:
        super().__init__()
        self.check_receiver(receiver)
        self.imu, self.clock = imu, receiver.clock
        self.register_buffer("p0", compute_initial_sd(imu, receiver.clock, initial))
        self.register_buffer("r", receiver.sd)

    def ranging_inputs(self, record: Record) -> RangingInputs:
        """Return the inputs of a record whose measurements are those of the receiver."""
        u: RangingInputs = super().prepare(record).u
        size, got = len(self.r), record.y.shape[-1]
        must = f"measure the {size} components of model.receiver"
        require(got == size, "the scenario", must, got, "Give both the same satellites.")
        return u


# --------------------------------------------------------------------------------------------------
# Tightly coupled SINS/GNSS: 17 linear error states, pseudoranges and range rates.

_TAYLOR = 4  # terms of exp(F T), at 1 s the fifth is below 1e-6 in any entry
_CHAIN = 5  # terms of the noise: gyro noise enters position as T^5 / 20
_EPOCHS = 64  # prepared at once, below 50 MB of temporaries for 100 runs


class TightStep(NamedTuple):
    """Discrete model of the first nine errors, and the predicted geometry at the end.

    Attributes:
        phi: Transition from the first fifteen errors, [R, T, 9, 15].
        gain: Lower triangular root of the noise, [R, T, 9, 9].
        duration: [R or 1, T], s.
        sight: Geometry at the end.
    """

    phi: Tensor
    gain: Tensor
    duration: Tensor
    sight: SatelliteGeometry


class SinsGnssTight(_TightModel):
    """Errors of an INS (INS minus truth) and a receiver clock, measured by ranges.

    The 17 states are attitude phi (E, N, U), velocity (E, N, U), position in metres (N, E, U),
    constant sensor biases, clock bias and drift in m and m/s. The paper has radians for
    latitude and longitude [ours]. The groups are the paper's [COFM-AMSSRCPF 2024, Measurement and
    Control, section 2]. Order, axes and signs are ours.

    Measurements are ranges and rates, INS minus receiver. They are not linearised, but almost
    linear: 2.5e-6 m for an error of 10 m. Phi is the matrix exponential to order 4 of the mean F of
    the interval. The noise is its exact integral, of rank 11: attitude, velocity, position, clock.
    The biases are constant, so the transition is singular. With `inflation` the rank is 17 and the
    transition has a density. `error` is corrected navigation minus truth, for sensors and clock
    estimate minus truth.

    Args:
        imu: Sensor errors that the model assumes.
        receiver: Receiver noise and clock that the model assumes.
        initial: Initial errors that the model assumes.
        inflation: Additional process noise, or None.

    Raises:
        ValueError: If a sensor bias is 0, which makes the initial distribution improper, or a
            sensor has a Markov part.
    """

    def __init__(
        self,
        imu: ImuErrors,
        receiver: RangingReceiver,
        initial: AlignmentErrors,
        inflation: ProcessNoiseInflation | None = None,
    ) -> None:
        super().__init__(imu, receiver, initial)
        self.inflation = inflation
        self.noise_dim = 17 if inflation else 11
        self.choices = (
            (f"process noise is inflated for every filter: {inflation}",) if inflation else ()
        )

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, TightStep):
            return record
        u = self.ranging_inputs(record)
        steps = u.duration.shape[-1]
        blocks = [
            self.discretise(map_inputs(lambda a, i=i: a[:, i : i + _EPOCHS], u))
            for i in range(0, steps, _EPOCHS)
        ]
        phi, gain = (torch.cat(a, 1) for a in zip(*blocks, strict=True))
        return record._replace(u=TightStep(phi, gain, u.duration, u.sight))

    def discretise(self, u: RangingInputs) -> tuple[Tensor, Tensor]:
        """Compute transition [..., 9, 15] and noise gain [..., 9, 9] of nine errors.

        Float64, with the leading axes of the intervals.
        """
        f, b, q = self.continuous(u)
        span = u.duration[..., None, None]
        eye = torch.eye(9, dtype=f.dtype, device=f.device).expand_as(f)
        phi, gamma, power = eye, eye, eye
        for n in range(1, _TAYLOR + 1):
            power = power @ f * (span / n)  # (F T)^n / n!
            phi, gamma = phi + power, gamma + power / (n + 1)
        noise, term = q * span, q * span
        for n in range(2, _CHAIN + 1):
            term = (f @ term + term @ f.mT) * (span / n)  # series of the integral of Phi Q Phi'
            noise = noise + term
        phi, driven = (
            error_dynamics.convert_transition_to_metres(a, u.pos_start, u.pos_end)
            for a in (phi, gamma)
        )
        scale = torch.cat(
            [torch.ones_like(u.vel), torch.ones_like(u.vel), earth.metre_scale(u.pos_end)], -1
        )
        noise = noise * scale.unsqueeze(-1) * scale.unsqueeze(-2)
        if self.inflation is not None:
            noise = noise + torch.diag(self.inflation.motion.to(noise).square())
        root, ok = factor(noise)
        require(
            bool(ok.all()),
            "model.imu",
            "have random walks of both sensors",
            self.imu,
            "Otherwise the noise covariance is singular.",
        )
        return torch.cat([phi, driven @ b * span], -1), root

    @staticmethod
    def _bias_columns(dcm: Tensor) -> Tensor:
        zero = torch.zeros_like(dcm)
        rows = ([-dcm, zero], [zero, dcm], [zero, zero])
        return torch.cat([torch.cat(row, -1) for row in rows], -2)

    def continuous(self, u: RangingInputs) -> tuple[Tensor, Tensor, Tensor]:
        """Return continuous-time matrices, position in radians.

        F of the first nine errors [..., 9, 9], columns of the biases [..., 9, 6], and the noise
        density [9, 9].
        """
        dcm = error_dynamics.mid_interval(u.intervals).dcm
        f = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
        gyro, accelerometer = self.imu.gyro_random_walk**2, self.imu.accelerometer_random_walk**2
        # isotropic, so it is the same in body and in level axes
        density = torch.diag(as_float64([gyro] * 3 + [accelerometer] * 3 + [0.0] * 3).to(f))
        return f, self._bias_columns(dcm), density

    @override
    def propagate(self, x: Tensor, u: TightStep, w: Tensor) -> Tensor:
        return affine_map(self.transition_matrix(u), x, self.noise_gain(u), w)

    def transition_matrix(self, u: TightStep) -> Tensor:
        """Build Phi of one step, [R or 1, 17, 17]."""
        phi = torch.eye(17, dtype=u.phi.dtype, device=u.phi.device).repeat(u.phi.shape[0], 1, 1)
        phi[:, :9, :15] = u.phi
        phi[:, 15, 16] = u.duration
        return phi

    def propagation_jacobian(self, x: Tensor, u: TightStep) -> Tensor:
        """Return the transition matrix, [R or 1, 1, 17, 17].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return self.transition_matrix(u).unsqueeze(1)

    @override
    def noise_gain(self, u: TightStep) -> Tensor:
        gain = u.gain.new_zeros(u.gain.shape[0], 17, self.noise_dim)
        gain[:, :9, :9] = u.gain
        gain[:, 15:, -2:] = self.clock.noise_gain(u.duration)
        if self.inflation is not None:
            extra = torch.cat([self.inflation.gyro, self.inflation.accelerometer])
            gain[:, 9:15, 9:15] = torch.diag(extra.to(gain))
        return gain

    @override
    def observation(self, x: Tensor, u: TightStep) -> Distribution:
        mean = predict_measurement(x[..., 6:9], x[..., 3:6], x[..., 15:], u.sight)
        return independent_normal(mean, self.r)

    @override
    def transition(self, x: Tensor, u: TightStep) -> Distribution | None:
        return None if self.inflation is None else additive_transition(self, x, u)


# --------------------------------------------------------------------------------------------------
# Tightly coupled SINS/GNSS for unknown heading, with exact attitude errors.

_CHART = Chart((QuaternionBlock(), EuclideanBlock(14)))


class NonlinearTightStep(NamedTuple):
    """INS output over each interval, and the predicted geometry at its end.

    Attributes:
        dcm: Body to level at mid-interval, [R, T, 3, 3].
        pos, pos_start, pos_end, vel, w_in, f, duration: See `InsIntervals`.
        sight: Geometry at the end.
    """

    dcm: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    vel: Tensor
    w_in: Tensor
    f: Tensor
    duration: Tensor
    sight: SatelliteGeometry


class SinsGnssTightNl(_TightModel):
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

    noise_dim = 11
    choices = ("an interval's specific force enters as one impulse, not in steps of 0.1 s",)

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
        u = self.ranging_inputs(record)
        dcm = error_dynamics.mid_interval(u.intervals).dcm
        interval = (dcm, u.pos, u.pos_start, u.pos_end, u.vel, u.w_in, u.f, u.duration)
        return record._replace(u=NonlinearTightStep(*interval, u.sight))

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
        mean = predict_measurement(x[..., 7:10], x[..., 4:7], x[..., 16:], u.sight)
        return independent_normal(mean, self.r)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        flat = self.place_groups(truth | {"attitude": truth["attitude"]})
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
        return torch.cat(
            [
                q,
                dv_end,
                end * earth.metre_scale(u.pos_end.unsqueeze(1) - end),
                gyro,
                accelerometer,
                clock,
            ],
            -1,
        )


class _Level(NamedTuple):
    """INS at mid-interval [R, 1, 3], for errors dv m/s and dp rad, rad, m [R, N, 3]."""

    pos: Tensor
    vel: Tensor
    w_in: Tensor

    def rate(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute the rate of the true level frame in inertial space.

        Shapes: dv [R, N, 3], dp [R, N, 3].
        """
        pos = self.pos - dp
        return earth.earth_rate(pos[..., 0]) + earth.transport_rate(
            pos[..., 0], pos[..., 2], self.vel - dv
        )

    def drift(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute the rate of dp.

        Shapes: dv [R, N, 3], dp [R, N, 3].
        """
        return earth.position_rate(self.pos, self.vel) - earth.position_rate(
            self.pos - dp, self.vel - dv
        )

    def free_acceleration(self, dv: Tensor, dp: Tensor) -> Tensor:
        """Compute Coriolis acceleration plus gravity, INS minus truth.

        Shapes: dv [R, N, 3], dp [R, N, 3].
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


def _conjugate(q: Tensor) -> Tensor:
    return torch.cat([q[..., :1], -q[..., 1:]], -1)
