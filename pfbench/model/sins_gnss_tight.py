"""Tightly coupled SINS/GNSS: 17 linear error states, pseudoranges and range rates."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.affine_map import affine_map
from pfbench.core.covariance import factor
from pfbench.core.normal import independent_normal
from pfbench.core.record import Record, map_inputs
from pfbench.model.ins_errors import InsErrorModel, additive_transition
from pfbench.model.tight_coupling import (
    NAMES,
    TIGHT_GROUPS,
    UNITS,
    check_satellites,
    compute_initial_sd,
    predict_measurement,
)
from pfbench.nav import earth, error_dynamics
from pfbench.nav.aiding import AlignmentErrors, ProcessNoiseInflation
from pfbench.nav.gnss.ranging import RangingInputs, RangingReceiver
from pfbench.nav.gnss.satellite_geometry import SatelliteGeometry
from pfbench.nav.imu_errors import ImuErrors

_TAYLOR = 4  # terms of exp(F T), at 1 s the fifth is below 1e-6 in any entry
_CHAIN = 5  # terms of the noise: gyro noise enters position as T^5 / 20
_EPOCHS = 64  # prepared at once, below 50 MB of temporaries for 100 runs


class TightStep(NamedTuple):
    """Discrete model of the first nine errors, and the predicted geometry at the end.

    Attributes:
        phi: Transition from the first fifteen errors, [R, T, 9, 15].
        gain: Lower triangular root of the noise, [R, T, 9, 9].
        duration: [R or 1, T], s.
        sine, cosine, height, vel, distance, line, closing: See `SatelliteGeometry`.
    """

    phi: Tensor
    gain: Tensor
    duration: Tensor
    sine: Tensor
    cosine: Tensor
    height: Tensor
    vel: Tensor
    distance: Tensor
    line: Tensor
    closing: Tensor


class SinsGnssTight(InsErrorModel):
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

    channel_names, input_type = RangingReceiver.channel_names, RangingReceiver.input_type
    r: Tensor
    names, units, groups = NAMES, UNITS, TIGHT_GROUPS

    def __init__(
        self,
        imu: ImuErrors,
        receiver: RangingReceiver,
        initial: AlignmentErrors,
        inflation: ProcessNoiseInflation | None = None,
    ) -> None:
        super().__init__()
        self.check_receiver(receiver)
        self.imu, self.clock, self.inflation = imu, receiver.clock, inflation
        self.register_buffer("p0", compute_initial_sd(imu, receiver.clock, initial))
        self.register_buffer("r", receiver.sd)
        self.noise_dim = 17 if inflation else 11
        self.choices = (
            (f"process noise is inflated for every filter: {inflation}",) if inflation else ()
        )

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, TightStep):
            return record
        u = check_satellites(super().prepare(record), len(self.r))
        steps = u.duration.shape[-1]
        blocks = [
            self.discretise(map_inputs(lambda a, i=i: a[:, i : i + _EPOCHS], u))
            for i in range(0, steps, _EPOCHS)
        ]
        phi, gain = (torch.cat(a, 1) for a in zip(*blocks, strict=True))
        return record._replace(u=TightStep(phi, gain, u.duration, *u.sight))

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
        if not bool(ok.all()):
            raise ValueError(
                f"model.imu must have random walks of both sensors, got {self.imu}. "
                "Otherwise the noise covariance is singular."
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
        density = torch.diag(f.new_tensor([gyro] * 3 + [accelerometer] * 3 + [0.0] * 3))
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
        mean = predict_measurement(x[..., 6:9], x[..., 3:6], x[..., 15:], SatelliteGeometry(*u[3:]))
        return independent_normal(mean, self.r)

    @override
    def transition(self, x: Tensor, u: TightStep) -> Distribution | None:
        return None if self.inflation is None else additive_transition(self, x, u)
