"""Loosely coupled SINS/GPS with a large azimuth error: nonlinear error models with 9 or 15 states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Angles, Chart, Euclidean, wrap
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import Alignment, Receiver
from pfbench.nav.sensors import ImuErrors
from pfbench.nav.strapdown import Intervals
from pfbench.record import Record

_ATTITUDE, _VELOCITY, _POSITION = slice(0, 3), slice(3, 6), slice(6, 9)


class Step(NamedTuple):
    """What one interval needs, from the middle of it; axes [R or 1, T].

    Attributes:
        matrix: linear blocks F [..., 9, 9] without the attitude's own columns, position in (rad, rad, m).
        dcm: body to level as the INS believes [..., 3, 3].
        pos: latitude, longitude, height [..., 3].
        vel: East, North, Up [..., 3].
        w_in: rate of the level frame [..., 3] rad/s.
        f: mean specific force in the INS's level frame [..., 3] m/s^2.
        metres: per (rad, rad, m) at the start [..., 3].
        metres_end: at the end [..., 3].
        duration: [...] s.
        gain: of the noise [..., D, W].
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


class Form(Protocol):
    """Error equations, component-major: x [R, 9, N] with position in (rad, rad, m); inputs of one step [R or 1, ...]."""

    @property
    def linear_given(self) -> tuple[int, ...]:
        """Components of the nine in which, with the biases, they are linear given the others; none if nothing is."""

    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: Step) -> Tensor:
        """Time derivative of attitude and velocity errors [R, 6, N]; sensor biases in level axes [R, 3, N or 1]."""

    def drift(self, dv: Tensor, dp: Tensor, u: Step) -> Tensor:
        """Time derivative of the position error, of velocity and position errors [R, 3, N] each: rad/s, rad/s, m/s."""


class _Linear:
    """Position errors grow by the linear blocks F32 and F33."""

    def drift(self, dv: Tensor, dp: Tensor, u: Step) -> Tensor:
        return u.matrix[:, _POSITION, 3:] @ torch.cat([dv, dp], 1)


@dataclass(frozen=True)
class Paper(_Linear):
    """X' = F X + G(alpha) + Gamma W, G = ((I - M^T) w_in, (I - M) f, 0), M of first order in the tilts, exact in azimuth.

    The paper's equation 1; its G is lost in print, and this is the reading that its words fit [ours].
    """

    linear_given = (0, 1, 3, 4, 5, 6, 7, 8)

    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: Step) -> Tensor:
        linear = u.matrix[:, :6, 3:] @ x[:, 3:]
        return level_coupling(x[:, _ATTITUDE], u.w_in, u.f) + linear + torch.cat([-gyro, accelerometer], 1)


@dataclass(frozen=True)
class Full(_Linear):
    """The exact equations of attitude and velocity, but with differences of rates, gravity and position rates linearised."""

    linear_given = (3, 4, 5, 6, 7, 8)

    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: Step) -> Tensor:
        alpha = x[:, _ATTITUDE].mT
        m, w_in = attitude.dcm_from_euler(alpha), u.w_in.unsqueeze(1)
        d_in, coupled = (u.matrix[:, :6, 3:] @ x[:, 3:]).mT.split(3, -1)
        turn = w_in - _times(m.mT, w_in - d_in) - gyro.mT
        push = u.f.unsqueeze(1) - _times(m, u.f.unsqueeze(1) - accelerometer.mT) + coupled
        return torch.cat([euler_rate(alpha, turn), push], -1).mT


@dataclass(frozen=True)
class Exact:
    """Differences of the mechanisation equations themselves [Yan Gongmin, postdoctoral report, eqs 4-17 to 4-21]."""

    linear_given = ()

    def rate(self, x: Tensor, gyro: Tensor, accelerometer: Tensor, u: Step) -> Tensor:
        level = torch.eye(3, dtype=x.dtype, device=x.device)  # the biases are in level axes already
        nominal = error_dynamics.Nominal(level, u.vel.unsqueeze(1), u.pos.unsqueeze(1), u.f.unsqueeze(1))
        return error_dynamics.rate(x.mT, nominal, gyro.mT, accelerometer.mT).mT[:, :6]

    def drift(self, dv: Tensor, dp: Tensor, u: Step) -> Tensor:
        pos, vel = u.pos.unsqueeze(1), u.vel.unsqueeze(1)
        return (earth.position_rate(pos, vel) - earth.position_rate(pos - dp.mT, vel - dv.mT)).mT


class Discretisation(Protocol):
    """Over an interval attitude and velocity errors go on by T times their rate; the position error by T times its own."""

    @property
    def share(self) -> float:
        """Of the new velocity error in the one that moves the position error; the rest is of the old one."""


@dataclass(frozen=True)
class Euler:
    """X + T X', as printed. With 1 s it loses 15 m in 10 s of 10 m/s^2 from an azimuth error of 20 degrees."""

    share = 0.0


@dataclass(frozen=True)
class Trapezoid:
    """The mean of the old velocity error and the new one [ours]."""

    share = 0.5


class SinsGpsAzimuth(StateSpaceModel):
    """Errors of an INS (INS minus truth) whose azimuth may be wrong by any angle; a receiver sees velocity and position errors.

    States: Euler errors of the attitude (E, N, U; the last one of any size, the first two of degrees), velocity (E, N, U),
    position in metres (N, E, U) [particle filter with state reconstruction by Dynamic Matrix Control, eqs 1 and 14]. The
    sensors' biases are then part of the noise W, white and `q_inflation` times as large as they are:
    s^2 = kappa^2 (b^2 + N^2 / T) [ours]. With `biases` gyro and accelerometer bias are states besides, 15 in all, driven as
    hard as the sensors' Markov parts are, and W is what is left.

    White noise is the same in all axes, so that turning it by M leaves its law as it is: it is additive in every form.

    Args:
        imu: what the model believes of the sensors.
        receiver: what it believes of the receiver; measurement order position N, E, U, velocity E, N, U.
        initial: what it believes of the initial errors.
        form: the error equations: Paper, Full or Exact.
        step: how they are discretised: Euler or Trapezoid.
        q_inflation: kappa, factor on the standard deviations of W.
        biases: 15 states instead of 9.

    Raises:
        ValueError: a factor that is not positive; with `biases`, a sensor without one.
    """

    p0: Tensor
    r: Tensor
    seen: Tensor

    def __init__(
        self,
        imu: ImuErrors,
        receiver: Receiver,
        initial: Alignment,
        form: Form,
        step: Discretisation,
        q_inflation: float = 1.0,
        biases: bool = False,
    ) -> None:
        super().__init__()
        if not q_inflation > 0.0:
            raise ValueError(f"model.q_inflation={q_inflation}: give a positive factor; 1 takes the sensors at their word")
        axes = {
            "attitude": (("E", "N", "U"), "rad"),
            "velocity": (("E", "N", "U"), "m/s"),
            "position": (("N", "E", "U"), "m"),
        }
        if biases:
            axes |= {"gyro_bias": (("x", "y", "z"), "rad/s"), "accelerometer_bias": (("x", "y", "z"), "m/s^2")}
        self.names = tuple(f"{group}_{axis}" for group, (parts, _) in axes.items() for axis in parts)
        self.units = tuple(unit for _, unit in axes.values() for _ in range(3))
        self.groups = {group: (3 * i, 3 * i + 1, 3 * i + 2) for i, group in enumerate(axes)}
        self.noise_dim = 12 if biases else 6
        self.linear_given = (*form.linear_given, *range(9, len(self.names))) if form.linear_given else ()
        self.imu, self.form, self.step, self.q_inflation, self.biases = imu, form, step, q_inflation, biases
        sizes = _bias_sizes(imu)
        if biases and not bool((sizes > 0).all()):
            raise ValueError(f"model.imu: biases {sizes.tolist()}; give gyro and accelerometer a positive one, or biases=false")
        self.register_buffer("p0", torch.cat([initial.sd, sizes]) if biases else initial.sd)
        self.register_buffer("r", receiver.sd)
        self.register_buffer("seen", torch.tensor([6, 7, 8, 3, 4, 5][: len(receiver.sd)]))
        told = f"error equations {type(form).__name__}, discretised by {type(step).__name__}"
        counted = "" if biases else f"; sensor biases count as white noise, {q_inflation:g} times as large"
        self.choices = (told + counted,)

    @property
    def chart(self) -> Chart:
        """The azimuth wraps, the rest adds."""
        return Chart((Euclidean(2), Angles(1), Euclidean(len(self.names) - 3)))

    @property
    def anchor(self) -> Tensor:
        return self.p0

    def prepare(self, record: Record) -> Record:
        """Intervals of the nominal trajectory to what a step needs.

        Raises:
            ValueError: inputs that are not the intervals of an INS.
        """
        if isinstance(record.u, Step):
            return record
        if not isinstance(record.u, Intervals):
            raise ValueError(
                f"record.u is {type(record.u).__name__}: SinsGpsAzimuth needs Intervals of an INS; choose a simulated flight"
            )
        u, middle = record.u, error_dynamics.mid_interval(record.u)
        matrix = error_dynamics.coupling_matrix(u.pos, u.vel)
        ends = earth.metre_scale(u.pos_start), earth.metre_scale(u.pos_end)
        step = Step(matrix, middle.dcm, u.pos, u.vel, u.w_in, u.f, *ends, u.duration, u.f.new_zeros(()))
        return record._replace(u=step._replace(gain=self._gain(step, u.dcm)))

    def _gain(self, u: Step, dcm: Tensor) -> Tensor:
        """Noise gain [..., D, W]: impulses of gyros and accelerometers, then the drivers of the biases where they are states.

        In the axes of the interval's start, dcm [..., 3, 3]: a mean attitude is no rotation and would make the noise smaller.
        """
        imu, span = self.imu, u.duration.unsqueeze(-1)
        held = _bias_sizes(imu).to(span) * (0.0 if self.biases else 1.0)
        random_walk = span.new_tensor([imu.gyro_random_walk] * 3 + [imu.accelerometer_random_walk] * 3)
        impulse = self.q_inflation * torch.hypot(held * span, random_walk * span.sqrt()).unsqueeze(-2)  # [..., 1, 6]
        zero = torch.zeros_like(dcm)
        moved = self.step.share * (u.metres_end * span).unsqueeze(-1) * (u.matrix[..., _POSITION, _VELOCITY] @ dcm)
        rows = [[-dcm, zero], [zero, dcm], [zero, moved]]
        gain = torch.cat([torch.cat(row, -1) for row in rows], -2) * impulse
        if not self.biases:
            return gain
        driver = [_driver(imu.gyro_markov, imu.gyro_markov_time)] * 3
        driver += [_driver(imu.accelerometer_markov, imu.accelerometer_markov_time)] * 3
        walk = torch.diag_embed(span.new_tensor(driver) * span.sqrt()).expand(*gain.shape[:-2], 6, 6)
        return torch.cat([torch.nn.functional.pad(gain, (0, 6)), torch.nn.functional.pad(walk, (6, 0))], -2)

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Step, w: Tensor) -> Tensor:
        a, span = x.mT, u.duration[:, None, None]  # component-major: rows of particles
        start = torch.cat([a[:, :6], a[:, _POSITION] / u.metres.unsqueeze(-1), a[:, 9:]], 1)
        moved = start[:, :6] + span * self.form.rate(start[:, :9], *self._level_biases(start, u), u)
        velocity = torch.lerp(start[:, _VELOCITY], moved[:, _VELOCITY], self.step.share)
        position = start[:, _POSITION] + span * self.form.drift(velocity, start[:, _POSITION], u)
        still = torch.cat([moved, position * u.metres_end.unsqueeze(-1), start[:, 9:]], 1)
        end = torch.baddbmm(still, u.gain.expand(x.shape[0], -1, -1), w.mT)
        return torch.cat([end[:, :2], wrap(end[:, 2:3]), end[:, 3:]], 1).mT

    def _level_biases(self, a: Tensor, u: Step) -> tuple[Tensor, Tensor]:
        """Gyro and accelerometer biases in the level axes that the INS believes in [R, 3, N]; zeros where they are no states."""
        if not self.biases:
            zero = torch.zeros_like(u.f).unsqueeze(-1)
            return zero, zero
        return u.dcm @ a[:, 9:12], u.dcm @ a[:, 12:15]

    def noise_gain(self, u: Step) -> Tensor:
        return u.gain

    def observation(self, x: Tensor, u: Step) -> Distribution:
        return independent_normal(x.mT.index_select(1, self.seen).mT, self.r)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Corrected navigation minus truth; for the sensor states, estimate minus truth."""
        turned = attitude.residual_error(truth[..., _ATTITUDE], mean[..., _ATTITUDE])
        return torch.cat([turned, truth[..., 3:9] - mean[..., 3:9], mean[..., 9:] - truth[..., 9:]], -1)


def level_coupling(alpha: Tensor, w: Tensor, f: Tensor) -> Tensor:
    """G: ((I - M^T) w, (I - M) f), M to first order in the tilts: alpha [R, 3, N], w and f [R or 1, 3] -> [R, 6, N].

    M = [[c, -s, y c + x s], [s, c, y s - x c], [-y, x, 1]] with x, y the tilts, c and s of the azimuth error.
    """
    x, y, z = alpha.unbind(1)
    (w_e, w_n, w_u), (f_e, f_n, f_u) = w.unsqueeze(-1).unbind(1), f.unsqueeze(-1).unbind(1)
    c, s = torch.cos(z), torch.sin(z)
    p, q, lost = y * c + x * s, y * s - x * c, 1 - c
    turn = [lost * w_e - s * w_n + y * w_u, lost * w_n + s * w_e - x * w_u, -(p * w_e + q * w_n)]
    push = [lost * f_e + s * f_n - p * f_u, lost * f_n - s * f_e - q * f_u, y * f_e - x * f_n]
    return torch.stack(turn + push, 1)


def euler_rate(alpha: Tensor, w: Tensor) -> Tensor:
    """Rates of the Euler errors that turn M at w: alpha' = Cw^-1(alpha) w [..., 3]."""
    (sx, sy, _), (cx, cy, _) = torch.sin(alpha).unbind(-1), torch.cos(alpha).unbind(-1)
    level = cy * w[..., 2] - sy * w[..., 0]
    return torch.stack([cy * w[..., 0] + sy * w[..., 2], w[..., 1] - sx / cx * level, level / cx], -1)


def _times(m: Tensor, a: Tensor) -> Tensor:
    return (m @ a.unsqueeze(-1)).squeeze(-1)


def _bias_sizes(imu: ImuErrors) -> Tensor:
    """Standard deviations of the gyro biases and of the accelerometer biases, constant and Markov parts together [6]."""
    gyro = (imu.gyro_bias**2 + imu.gyro_markov**2) ** 0.5
    accelerometer = (imu.accelerometer_bias**2 + imu.accelerometer_markov**2) ** 0.5
    return torch.tensor([gyro] * 3 + [accelerometer] * 3, dtype=torch.float64)


def _driver(sigma: float, time: float) -> float:
    """Root density that drives a first-order Markov process of stationary `sigma`."""
    return sigma * (2.0 / time) ** 0.5 if sigma > 0 else 0.0
