"""SINS/SAR: INS errors with a quaternion, aided by radar and barometer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock, wrap_angle
from pfbench.core.density import independent_normal
from pfbench.core.parameter_checks import as_float64, require
from pfbench.core.record import Record
from pfbench.model.ins_gnss import (
    BIASES,
    NAVIGATION,
    InsErrorModel,
    additive_transition,
    inflate_noise,
    name_ins_components,
)
from pfbench.nav import attitude
from pfbench.nav.aiding import (
    AlignmentErrors,
    ProcessNoiseInflation,
    SarSensor,
    compute_heading_difference,
)
from pfbench.nav.earth import (
    convert_from_metres,
    convert_to_metres,
    earth_quantities,
    rotate_quaternion,
    rotate_vectors,
    rotation_matrix,
)
from pfbench.nav.imu_errors import ImuErrors
from pfbench.nav.strapdown import InsIntervals

_SIZES = (4, 3, 3, 3, 3)  # quaternion, velocity, position, gyro bias, accelerometer bias
_CHART = Chart((QuaternionBlock(), EuclideanBlock(12)))


class SarStep(NamedTuple):
    """INS output over each interval, in the INS level frame n', with its errors.

    Attributes:
        dcm: Mean body to level, [R, T, 3, 3].
        forward: Forward axis of the body at the end, [R, T, 3].
        f: Mean specific force, [R, T, 3], m/s^2.
        vel: Mean velocity, [R, T, 3], m/s.
        pos: Mean position, [R, T, 3], rad, rad, m.
        pos_start: Position at the start, [R, T, 3].
        pos_end: Position at the end, [R, T, 3].
        w_in: Rate of the level frame in inertial space, [R, T, 3], rad/s.
        free: Gravity and Coriolis acceleration, [R, T, 3], m/s^2.
        drift: Rate of the position, [R, T, 3], rad/s, rad/s, m/s.
        gain: Noise gain in the chart, [R, T, 15, W].
        duration: [R or 1, T], s.
    """

    dcm: Tensor
    forward: Tensor
    f: Tensor
    vel: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    w_in: Tensor
    free: Tensor
    drift: Tensor
    gain: Tensor
    duration: Tensor


class SinsSar(InsErrorModel):
    """INS errors (INS minus truth) with an attitude error quaternion.

    State [16] [Yan et al. 2016, eq. 1]: attitude error quaternion, velocity (E, N, U), position (N,
    E, U) in metres of the true position, gyro and accelerometer bias in body axes. The paper gives
    f and h by reference only. This is the standard model for misalignments of any size [ours]. The
    quaternion rotates the INS level frame n' to the true one n, C_b^n = R(q) C_b^n'. With w = w_in'
    - R(q)^T w_in - C gyro_bias,

        q' = q [0, w] / 2,
        dv' = (I - R(q)) f + R(q) C accelerometer_bias + free(INS) - free(truth),

    and the position error grows by the difference of INS and true position rates. Biases are
    constant. A step is the midpoint rule with mean inputs of the interval.

    White sensor noise over an interval enters as x (+) G w with G = (-C, C) sqrt(T) times the
    densities, rank 6. With `rotate_noise_by_error` the velocity block is R(q) C. The distribution is the same,
    because all axes have equal noise. Measurements are the heading difference and the position
    error in metres (North, East from the radar, Up from the barometer) [eqs. 4 and 5]. `error` is
    corrected navigation minus truth with attitude as a rotation vector, for sensor states estimate
    minus truth.

    Args:
        imu: Sensor errors that the model assumes.
        receiver: Noise of radar and barometer that the model assumes.
        initial: Initial errors that the model assumes.
        rotate_noise_by_error: Whether accelerometer noise is rotated by the attitude error of each
            state, as in the continuous G(x). Otherwise, as printed (G(t)), the noise is additive in
            the chart.
        inflation: Additional process noise, or None. With it the transition has a density.

    Raises:
        ValueError: If a sensor is without a constant bias or has a Markov part, the receiver measures
            other channels, or `rotate_noise_by_error` is combined with `inflation`.
    """

    channel_names, input_type = SarSensor.channel_names, SarSensor.input_type
    r: Tensor
    density: Tensor

    def __init__(
        self,
        imu: ImuErrors,
        receiver: SarSensor,
        initial: AlignmentErrors,
        rotate_noise_by_error: bool = False,
        inflation: ProcessNoiseInflation | None = None,
    ) -> None:
        super().__init__()
        self.check_receiver(receiver)
        require(
            not imu.gyro_markov > 0 and (not imu.accelerometer_markov > 0),
            "model.imu",
            "have constant biases",
            f"gyro_markov_deg_h={imu.gyro_markov_deg_h}, accelerometer_markov_ug={imu.accelerometer_markov_ug}",
            "Set both to 0.",
        )
        biases = [imu.gyro_bias] * 3 + [imu.accelerometer_bias] * 3
        require(
            not min(biases) <= 0.0,
            "model.imu",
            "have positive biases",
            f"gyro_bias_deg_h={imu.gyro_bias_deg_h}, accelerometer_bias_ug={imu.accelerometer_bias_ug}",
            "Change them.",
        )
        require(
            not rotate_noise_by_error or not inflation,
            "model.rotate_noise_by_error",
            "be false with model.inflation",
            "true",
            "Change one of them.",
        )
        self.names, self.units, self.groups = name_ins_components(NAVIGATION + BIASES)
        self.rotate_noise_by_error, self.inflation = rotate_noise_by_error, inflation
        density = [imu.gyro_random_walk] * 3 + [imu.accelerometer_random_walk] * 3
        self.register_buffer("p0", torch.cat([initial.sd, as_float64(biases)]))
        self.register_buffer("r", receiver.sd)
        self.register_buffer("density", as_float64(density))
        self.noise_dim = len(self.names) if inflation else 6
        self.choices = (
            "the attitude error quaternion rotates the INS level frame to the true one "
            "(multiplicative reading)",
            *([f"process noise is inflated for every filter: {inflation}"] if inflation else []),
        )

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(15)])

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, SarStep):
            return record
        return record._replace(u=self.discretise(super().prepare(record).u))

    def discretise(self, u: InsIntervals) -> SarStep:
        """Compute mean inputs over intervals, with the gain at the identity quaternion."""
        dcm = (u.dcm + u.dcm_end) / 2
        w_in, free, drift = (
            a.squeeze(-1) for a in earth_quantities(u.pos.unsqueeze(-1), u.vel.unsqueeze(-1))
        )
        gain = self._gain(dcm, u.duration)
        motion = (dcm, u.dcm_end[..., 1], u.f, u.vel, u.pos, u.pos_start, u.pos_end)
        return SarStep(*motion, w_in, free, drift, gain, u.duration)

    def _gain(self, dcm: Tensor, duration: Tensor) -> Tensor:
        """Return the noise gain [..., 15, W]."""
        root = torch.sqrt(duration)[..., None, None]
        gyro, accelerometer = self.density.to(dcm).split(3)
        gain = dcm.new_zeros(*dcm.shape[:-2], 15, 6)
        gain[..., 0:3, 0:3], gain[..., 3:6, 3:6] = -dcm * gyro * root, dcm * accelerometer * root
        return gain if self.inflation is None else inflate_noise(gain, self.inflation, 1)

    @override
    def propagate(self, x: Tensor, u: SarStep, w: Tensor) -> Tensor:
        q, dv, metres, *biases = x.mT.split(_SIZES, -2)  # component-major from here on: [R, k, N]
        drifting, pushed = (u.dcm @ bias for bias in biases)
        dp, span = convert_from_metres(metres, u.pos_start.unsqueeze(-1)), u.duration[:, None, None]
        turn, push, slide = _rates(u, q, dv, dp, drifting, pushed)
        half = 0.5 * span
        middle = rotate_quaternion(q, turn * half), dv + push * half, dp + slide * half
        turn, push, slide = _rates(u, *middle, drifting, pushed)
        metres = convert_to_metres(dp + slide * span, u.pos_end.unsqueeze(-1))
        q, plain = rotate_quaternion(q, turn * span), [dv + push * span, metres, *biases]
        shaken = u.gain @ w.mT
        tilt, rest = shaken.split((3, 12), -2)
        if self.rotate_noise_by_error:
            rest = torch.cat(
                [rotate_vectors(rotation_matrix(q), rest[..., :3, :]), rest[..., 3:, :]], -2
            )
        return torch.cat([rotate_quaternion(q, tilt), torch.cat(plain, -2) + rest], -2).mT

    @override
    def noise_gain(self, u: SarStep) -> Tensor | None:
        return None if self.rotate_noise_by_error else u.gain

    @override
    def transition(self, x: Tensor, u: SarStep) -> Distribution | None:
        return None if self.inflation is None else additive_transition(self, x, u)

    @override
    def observation(self, x: Tensor, u: SarStep) -> Distribution:
        forward = u.forward.unsqueeze(-1)
        turn = compute_heading_difference(
            forward.mT, rotate_vectors(rotation_matrix(x.mT[:, :4]), forward).mT
        )
        return independent_normal(torch.cat([turn.unsqueeze(-2), x.mT[:, 7:10]], -2).mT, self.r)

    @override
    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        r = y - y_hat
        return torch.cat([wrap_angle(r[..., :1]), r[..., 1:]], -1)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        vectors = self.place_groups(truth)
        q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(vectors[..., :3]))
        return torch.cat([q, vectors[..., 3:]], -1)

    @override
    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        difference = self.chart.subtract(truth, mean)
        return torch.cat([difference[..., :9], -difference[..., 9:]], -1)


def _rates(
    u: SarStep, q: Tensor, dv: Tensor, dp: Tensor, drifting: Tensor, pushed: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the rates of attitude (in n'), velocity error and position error."""
    pos, vel, w_ins, f, free_ins, drift_ins = (
        a.unsqueeze(-1) for a in (u.pos, u.vel, u.w_in, u.f, u.free, u.drift)
    )
    w_in, free, drift = earth_quantities(pos - dp, vel - dv)
    m = rotation_matrix(q)
    turn = (
        w_ins - (m * w_in.unsqueeze(-2)).sum(-3) - drifting
    )  # transposed: true level frame to the INS's
    return turn, f - rotate_vectors(m, f - pushed) + free_ins - free, drift_ins - drift
