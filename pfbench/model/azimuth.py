"""Loosely coupled SINS/GPS with a large azimuth error: the nonlinear models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import pad
from typing_extensions import override

from pfbench.core.chart import AngleBlock, Chart, EuclideanBlock, wrap_angle
from pfbench.core.density import independent_normal
from pfbench.core.parameter_checks import as_float64, require_range
from pfbench.core.record import Record
from pfbench.model.ins_gnss import BIASES, NAVIGATION, InsErrorModel, name_ins_components
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import LOOSE_CHANNELS, AlignmentErrors, GnssReceiver
from pfbench.nav.imu_errors import ImuErrors
from pfbench.nav.strapdown import InsIntervals

_VELOCITY, _POSITION = slice(3, 6), slice(6, 9)


class Discretisation(Protocol):
    """Propagation of an interval: attitude and velocity errors by T times their rate.

    The position error is propagated by T times its rate at a mean velocity error.
    """

    @property
    def mean_weight(self) -> float:
        """Weight of the new velocity error in the velocity error that moves the position."""


@dataclass(frozen=True)
class EulerDiscretisation:
    """X + T X', as printed.

    With T = 1 s it loses 15 m in 10 s of 10 m/s^2 at an azimuth error of 20 degrees.
    """

    mean_weight = 0.0


@dataclass(frozen=True)
class TrapezoidDiscretisation:
    """The mean of the old and the new velocity error [ours]."""

    mean_weight = 0.5


class SinsGpsAzimuth(InsErrorModel):
    """INS errors (INS minus truth) with an azimuth error of any size.

    A receiver measures velocity and position errors. States are Euler errors of the attitude (E, N,
    U), velocity (E, N, U) and position in metres (N, E, U). The azimuth error has any size, tilts are
    degrees [particle filter with state reconstruction by Dynamic Matrix Control, eqs 1 and 14]. Sensor
    biases are part of the white noise W, with `process_noise_factor`: s^2 = kappa^2 (b^2 + N^2 / T)
    [ours]. With `biases` gyro and accelerometer biases are states too, 15 in all. They have the
    driving noise of the sensors' Gauss-Markov parts, and W contains the white noise only.

    White noise is equal in all axes, so its distribution is invariant under rotation by M, and it
    is additive in all error equations.

    Args:
        imu: Sensor errors that the model assumes.
        receiver: Receiver noise that the model assumes, order position N, E, U, velocity E, N, U.
        initial: Initial errors that the model assumes.
        error_equations: PrintedErrorEquations, LinearisedRateEquations or ExactErrorEquations.
        discretisation: EulerDiscretisation or TrapezoidDiscretisation.
        process_noise_factor: kappa, factor on the standard deviations of W.
        biases: Whether to use 15 states instead of 9.

    Raises:
        ValueError: If the factor is not positive, with `biases` a sensor bias is 0, or the receiver
            measures other channels.
    """

    input_type = InsIntervals
    r: Tensor
    observed_indices: Tensor

    def __init__(
        self,
        imu: ImuErrors,
        receiver: GnssReceiver,
        initial: AlignmentErrors,
        error_equations: ErrorEquations,
        discretisation: Discretisation,
        process_noise_factor: float = 1.0,
        biases: bool = False,
    ) -> None:
        super().__init__()
        self.channel_names = LOOSE_CHANNELS[: len(receiver.sd)]
        self.check_receiver(receiver)
        require_range(
            "model.process_noise_factor",
            process_noise_factor,
            "(0, inf] Use 1.0 for the sensors' nominal noise.",
        )
        self.names, self.units, self.groups = name_ins_components(
            NAVIGATION + (BIASES if biases else ())
        )
        self.noise_dim = 12 if biases else 6
        self.linear_given = (
            (*error_equations.linear_given, *range(9, len(self.names)))
            if error_equations.linear_given
            else ()
        )
        self.imu, self.process_noise_factor, self.biases = imu, process_noise_factor, biases
        self.error_equations, self.discretisation = error_equations, discretisation
        sizes = _bias_sizes(imu)
        if biases and not bool((sizes > 0).all()):
            raise ValueError(
                "model.imu must have positive gyro and accelerometer biases, "
                f"got {sizes.tolist()}. "
                "Change them, or set biases=false."
            )
        self.register_buffer("p0", torch.cat([initial.sd, sizes]) if biases else initial.sd)
        self.register_buffer("r", receiver.sd)
        self.register_buffer(
            "observed_indices", torch.tensor([6, 7, 8, 3, 4, 5][: len(receiver.sd)])
        )
        equations = f"error equations {type(error_equations).__name__}, discretised by {type(discretisation).__name__}"
        factor = f"; sensor biases count as white noise, {process_noise_factor:g} times as large"
        self.choices = (equations if biases else equations + factor,)

    @property
    @override
    def chart(self) -> Chart:
        return Chart((EuclideanBlock(2), AngleBlock(1), EuclideanBlock(len(self.names) - 3)))

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, AzimuthStep):
            return record
        u = super().prepare(record).u
        middle = error_dynamics.mid_interval(u)
        matrix = error_dynamics.coupling_matrix(u.pos, u.vel)
        ends = earth.metre_scale(u.pos_start), earth.metre_scale(u.pos_end)
        step = AzimuthStep(
            matrix, middle.dcm, u.pos, u.vel, u.w_in, u.f, *ends, u.duration, u.f.new_zeros(())
        )
        return record._replace(u=step._replace(gain=self._gain(step, u.dcm)))

    def _gain(self, u: AzimuthStep, dcm: Tensor) -> Tensor:
        """Return the noise gain [..., D, W]: sensor impulses, then drivers of bias states."""
        # In the axes dcm [..., 3, 3] of the interval's start: a mean attitude is not a rotation
        # and would reduce the noise.
        imu, span = self.imu, u.duration.unsqueeze(-1)
        constant = _bias_sizes(imu).to(span) * (0.0 if self.biases else 1.0)
        random_walk = as_float64([imu.gyro_random_walk] * 3 + [imu.accelerometer_random_walk] * 3)
        sd = torch.hypot(constant * span, random_walk.to(span) * span.sqrt())
        impulse = self.process_noise_factor * sd.unsqueeze(-2)  # [..., 1, 6]
        zero = torch.zeros_like(dcm)
        scale = self.discretisation.mean_weight * (u.metres_end * span).unsqueeze(-1)
        position = scale * (u.matrix[..., _POSITION, _VELOCITY] @ dcm)
        rows = [[-dcm, zero], [zero, dcm], [zero, position]]
        gain = torch.cat([torch.cat(row, -1) for row in rows], -2) * impulse
        if not self.biases:
            return gain
        driver = [_driver_root(imu.gyro_markov, imu.gyro_markov_time_s)] * 3
        driver += [_driver_root(imu.accelerometer_markov, imu.accelerometer_markov_time_s)] * 3
        walk = torch.diag_embed(as_float64(driver).to(span) * span.sqrt()).expand(
            *gain.shape[:-2], 6, 6
        )
        return torch.cat([pad(gain, (0, 6)), pad(walk, (6, 0))], -2)

    @override
    def propagate(self, x: Tensor, u: AzimuthStep, w: Tensor) -> Tensor:
        a, span = x.mT, u.duration[:, None, None]  # component-major: rows of particles
        start = torch.cat([a[:, :6], a[:, _POSITION] / u.metres.unsqueeze(-1), a[:, 9:]], 1)
        rate = self.error_equations.rate(start[:, :9], *self._level_biases(start, u), u)
        motion = start[:, :6] + span * rate
        velocity = torch.lerp(
            start[:, _VELOCITY], motion[:, _VELOCITY], self.discretisation.mean_weight
        )
        position = start[:, _POSITION] + span * self.error_equations.drift(
            velocity, start[:, _POSITION], u
        )
        mean = torch.cat([motion, position * u.metres_end.unsqueeze(-1), start[:, 9:]], 1)
        end = torch.baddbmm(mean, u.gain.expand(x.shape[0], -1, -1), w.mT)
        return torch.cat([end[:, :2], wrap_angle(end[:, 2:3]), end[:, 3:]], 1).mT

    def _level_biases(self, a: Tensor, u: AzimuthStep) -> tuple[Tensor, Tensor]:
        """Return gyro and accelerometer biases in level axes [R, 3, N], zeros if not states."""
        if not self.biases:
            zero = torch.zeros_like(u.f).unsqueeze(-1)
            return zero, zero
        return u.dcm @ a[:, 9:12], u.dcm @ a[:, 12:15]

    @override
    def noise_gain(self, u: AzimuthStep) -> Tensor:
        return u.gain

    @override
    def observation(self, x: Tensor, u: AzimuthStep) -> Distribution:
        return independent_normal(x.mT.index_select(1, self.observed_indices).mT, self.r)

    def observation_jacobian(self, x: Tensor, u: AzimuthStep) -> Tensor:
        """Return the matrix that selects the measured components, [1, 1, k, D].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return eye[self.observed_indices][None, None]


def _bias_sizes(imu: ImuErrors) -> Tensor:
    """Return standard deviations of all gyro and accelerometer biases [6]."""
    gyro = (imu.gyro_bias**2 + imu.gyro_markov**2) ** 0.5
    accelerometer = (imu.accelerometer_bias**2 + imu.accelerometer_markov**2) ** 0.5
    return as_float64([gyro] * 3 + [accelerometer] * 3)


def _driver_root(sigma: float, time: float) -> float:
    """Return the driving root density of a Markov process of stationary `sigma`."""
    return sigma * (2.0 / time) ** 0.5 if sigma > 0 else 0.0


# --------------------------------------------------------------------------------------------------
# Error equations of an INS with a large azimuth error.

_ATTITUDE, _POSITION_ROWS = slice(0, 3), slice(6, 9)


class AzimuthStep(NamedTuple):
    """Inputs of one interval, at its middle, axes [R or 1, T].

    Attributes:
        matrix: Linear blocks F [..., 9, 9] without the attitude columns, position in (rad, rad, m).
        dcm: Body to level of the INS, [..., 3, 3].
        pos: Latitude, longitude, height, [..., 3].
        vel: East, North, Up, [..., 3].
        w_in: Rate of the level frame, [..., 3], rad/s.
        f: Mean specific force in the INS level frame, [..., 3], m/s^2.
        metres: Metres per (rad, rad, m) at the start, [..., 3].
        metres_end: Metres per (rad, rad, m) at the end, [..., 3].
        duration: [...], s.
        gain: Noise gain, [..., D, W].
    """

    matrix: Tensor
    dcm: Tensor
    pos: Tensor
    vel: Tensor
    w_in: Tensor
    f: Tensor
    metres: Tensor
    metres_end: Tensor
    duration: Tensor
    gain: Tensor


class ErrorEquations(Protocol):
    """Error equations, component-major.

    States x are [R, 9, N] with position in (rad, rad, m). Inputs are of one step [R or 1, ...].
    """

    @property
    def linear_given(self) -> tuple[int, ...]:
        """Components of the nine in which, with the biases, the equations are linear.

        They are linear given the other components. Empty if none.
        """

    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: AzimuthStep) -> Tensor:
        """Compute the time derivative of attitude and velocity errors, [R, 6, N].

        Args:
            x: Errors, [R, 9, N].
            gyro: Gyro biases in level axes, [R, 3, N or 1].
            accelerometer: Accelerometer biases in level axes, [R, 3, N or 1].
            u: Inputs of the step.
        """

    def drift(self, dv: Tensor, dp: Tensor, u: AzimuthStep) -> Tensor:
        """Compute the time derivative of the position error, [R, 3, N], rad/s, rad/s, m/s.

        Args:
            dv: Velocity errors, [R, 3, N].
            dp: Position errors, [R, 3, N].
            u: Inputs of the step.
        """


class _LinearDrift(ErrorEquations):
    """Growth of position errors by the linear blocks F32 and F33."""

    @override
    def drift(self, dv: Tensor, dp: Tensor, u: AzimuthStep) -> Tensor:
        return u.matrix[:, _POSITION_ROWS, 3:] @ torch.cat([dv, dp], 1)


@dataclass(frozen=True)
class PrintedErrorEquations(_LinearDrift):
    """X' = F X + G(alpha) + Gamma W, G = ((I - M^T) w_in, (I - M) f, 0).

    M is first order in the tilts and exact in azimuth. The paper's equation 1. Its G is damaged in
    print, and this reading fits the text [ours].
    """

    linear_given = (0, 1, 3, 4, 5, 6, 7, 8)

    @override
    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: AzimuthStep) -> Tensor:
        linear = u.matrix[:, :6, 3:] @ x[:, 3:]
        return (
            compute_level_coupling(x[:, _ATTITUDE], u.w_in, u.f)
            + linear
            + torch.cat([-gyro, accelerometer], 1)
        )


@dataclass(frozen=True)
class LinearisedRateEquations(_LinearDrift):
    """Exact equations of attitude and velocity with linearised rate differences.

    Differences of rates, gravity and position rates are linearised.
    """

    linear_given = (3, 4, 5, 6, 7, 8)

    @override
    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: AzimuthStep) -> Tensor:
        alpha = x[:, _ATTITUDE].mT
        m, w_in = attitude.dcm_from_euler(alpha), u.w_in.unsqueeze(1)
        d_in, coupled = (u.matrix[:, :6, 3:] @ x[:, 3:]).mT.split(3, -1)
        w = w_in - _times(m.mT, w_in - d_in) - gyro.mT
        acceleration = u.f.unsqueeze(1) - _times(m, u.f.unsqueeze(1) - accelerometer.mT) + coupled
        return torch.cat([compute_euler_rate(alpha, w), acceleration], -1).mT


@dataclass(frozen=True)
class ExactErrorEquations(ErrorEquations):
    """Differences of the mechanisation equations.

    [Yan Gongmin, postdoctoral report, eqs 4-17 to 4-21]
    """

    linear_given = ()

    @override
    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: AzimuthStep) -> Tensor:
        level = torch.eye(3, dtype=x.dtype, device=x.device)  # the biases are in level axes already
        nominal = error_dynamics.NominalState(
            level, u.vel.unsqueeze(1), u.pos.unsqueeze(1), u.f.unsqueeze(1)
        )
        return error_dynamics.error_rate(x.mT, nominal, gyro.mT, accelerometer.mT).mT[:, :6]

    @override
    def drift(self, dv: Tensor, dp: Tensor, u: AzimuthStep) -> Tensor:
        pos, vel = u.pos.unsqueeze(1), u.vel.unsqueeze(1)
        return (earth.position_rate(pos, vel) - earth.position_rate(pos - dp.mT, vel - dv.mT)).mT


def compute_level_coupling(alpha: Tensor, w: Tensor, f: Tensor) -> Tensor:
    """Compute G = ((I - M^T) w, (I - M) f) with M to first order in the tilts.

    The tilts are x and y. The cosine and sine of the azimuth error are c and s. Then
    M = [[c, -s, y c + x s], [s, c, y s - x c], [-y, x, 1]].

    Returns g, [R, 6, N]. Shapes: alpha [R, 3, N], w [R or 1, 3], f [R or 1, 3].
    """
    x, y, z = alpha.unbind(1)
    (w_e, w_n, w_u), (f_e, f_n, f_u) = w.unsqueeze(-1).unbind(1), f.unsqueeze(-1).unbind(1)
    c, s = torch.cos(z), torch.sin(z)
    p, q, versine = y * c + x * s, y * s - x * c, 1 - c
    rotation = [
        versine * w_e - s * w_n + y * w_u,
        versine * w_n + s * w_e - x * w_u,
        -(p * w_e + q * w_n),
    ]
    force = [
        versine * f_e + s * f_n - p * f_u,
        versine * f_n - s * f_e - q * f_u,
        y * f_e - x * f_n,
    ]
    return torch.stack(rotation + force, 1)


def compute_euler_rate(alpha: Tensor, w: Tensor) -> Tensor:
    """Compute the rates of the Euler errors of M rotating at w: alpha' = Cw^-1 w.

    Shapes: alpha [..., 3], w [..., 3].
    """
    (sx, sy, _), (cx, cy, _) = torch.sin(alpha).unbind(-1), torch.cos(alpha).unbind(-1)
    level = cy * w[..., 2] - sy * w[..., 0]
    return torch.stack(
        [cy * w[..., 0] + sy * w[..., 2], w[..., 1] - sx / cx * level, level / cx], -1
    )


def _times(m: Tensor, a: Tensor) -> Tensor:
    return (m @ a.unsqueeze(-1)).squeeze(-1)
