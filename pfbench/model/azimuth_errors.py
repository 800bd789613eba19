"""Error equations of an INS with a large azimuth error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.nav import attitude, earth, error_dynamics

_ATTITUDE, _POSITION = slice(0, 3), slice(6, 9)


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
        return u.matrix[:, _POSITION, 3:] @ torch.cat([dv, dp], 1)


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

    Args:
        alpha: Attitude errors, [R, 3, N].
        w: Rate of the level frame, [R or 1, 3].
        f: Specific force, [R or 1, 3].

    Returns:
        G, [R, 6, N].
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

    Args:
        alpha: Euler errors, [..., 3].
        w: Angular rate, [..., 3].
    """
    (sx, sy, _), (cx, cy, _) = torch.sin(alpha).unbind(-1), torch.cos(alpha).unbind(-1)
    level = cy * w[..., 2] - sy * w[..., 0]
    return torch.stack(
        [cy * w[..., 0] + sy * w[..., 2], w[..., 1] - sx / cx * level, level / cx], -1
    )


def _times(m: Tensor, a: Tensor) -> Tensor:
    return (m @ a.unsqueeze(-1)).squeeze(-1)
