"""Growth of INS errors: the exact nonlinear equations and the linear blocks.

Errors are INS minus truth: x [..., 9] = attitude (East, North, Up, `attitude.attitude_error`,
of any size), velocity (East, North, Up), position. Position errors are in (rad, rad, m) in
rates and F matrices. They are in metres (North, East, Up) over an interval, in `propagate_error`
and `convert_transition_to_metres`. Nominal quantities come from the INS and include its errors. Everything broadcasts,
for example errors [R, N, 9] with nominals [R, 1, 3].

[Yan Gongmin, postdoctoral report, eqs 4-17 to 4-21, for large misalignment angles; linear
blocks as in standard textbooks]
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import attitude, earth
from pfbench.nav.strapdown import InsIntervals


class NominalState(NamedTuple):
    """INS output at one instant, or its average over an interval.

    Attributes:
        dcm: Body to level, [..., 3, 3].
        vel: East, North, Up, [..., 3], m/s.
        pos: Latitude, longitude, height, [..., 3], rad, rad, m.
        f: Specific force in the level frame of the INS, [..., 3], m/s^2.
    """

    dcm: Tensor
    vel: Tensor
    pos: Tensor
    f: Tensor


def mid_interval(intervals: InsIntervals) -> NominalState:
    """Compute nominal quantities at mid-interval.

    The mean of two attitudes is correct to second order.
    """
    return NominalState(
        (intervals.dcm + intervals.dcm_end) / 2, intervals.vel, intervals.pos, intervals.f
    )


def error_rate(
    x: Tensor,
    nominal: NominalState,
    gyro: Tensor | None = None,
    accelerometer: Tensor | None = None,
) -> Tensor:
    """Compute the exact time derivative of the errors, position in (rad, rad, m).

    Returns derivative, [..., 9]. Shapes: x [..., 9], gyro [..., 3], accelerometer [..., 3].
    """
    alpha, dv, dp = x.split(3, dim=-1)
    dcm, v, pos, f = nominal
    v_t, pos_t = v - dv, pos - dp
    m = attitude.dcm_from_euler(alpha)
    w_ie, w_en = earth.earth_rate(pos[..., 0]), earth.transport_rate(pos[..., 0], pos[..., 2], v)
    d_ie = w_ie - earth.earth_rate(pos_t[..., 0])
    d_en = w_en - earth.transport_rate(pos_t[..., 0], pos_t[..., 2], v_t)

    w = w_ie + w_en
    turn = w - _multiply(m.transpose(-1, -2), w - d_ie - d_en)
    push = f - _multiply(m, f) - _cross(2 * d_ie + d_en, v_t) - _cross(2 * w_ie + w_en, dv)
    if gyro is not None:
        turn = turn - _multiply(dcm, gyro)
    if accelerometer is not None:
        push = push + _multiply(m, _multiply(dcm, accelerometer))
    sink = earth.gravity(pos_t[..., 0], pos_t[..., 2]) - earth.gravity(pos[..., 0], pos[..., 2])
    push = torch.cat([push[..., :2], push[..., 2:] + sink.unsqueeze(-1)], dim=-1)
    drift = earth.position_rate(pos, v) - earth.position_rate(pos_t, v_t)
    return torch.cat(torch.broadcast_tensors(_euler_rate(alpha, turn), push, drift), dim=-1)


def propagate_error(
    x: Tensor,
    interval: InsIntervals,
    gyro: Tensor | None = None,
    accelerometer: Tensor | None = None,
    passes: int = 1,
) -> Tensor:
    """Propagate errors over one interval by the exact equations, position in metres.

    Classical Runge-Kutta with the nominal quantities of mid-interval. The method is second order in
    the length of the interval, because the nominal is constant within it.

    Returns errors at the end, [..., 9]. Shapes: x [..., 9], interval [R, N, 9], gyro [..., 3],
    accelerometer [..., 3].
    """
    nominal, step = mid_interval(interval), (interval.duration / passes).unsqueeze(-1)

    def derivative(errors: Tensor) -> Tensor:
        return error_rate(errors, nominal, gyro, accelerometer)

    x = _scale_position(x, 1 / earth.metre_scale(interval.pos_start))
    for _ in range(passes):
        k1 = derivative(x)
        k2 = derivative(x + step / 2 * k1)
        k3 = derivative(x + step / 2 * k2)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + derivative(x + step * k3))
    return _scale_position(x, earth.metre_scale(interval.pos_end))


def coupling_matrix(pos: Tensor, vel: Tensor) -> Tensor:
    """Compute the linear dynamics F [..., 9, 9] of velocity and position errors.

    Position is in (rad, rad, m). Blocks F12, F13, F22, F23, F32, F33 are set. The attitude columns
    F11 and F21 are 0, for models that treat attitude nonlinearly. `small_angle_matrix` fills them.

    Returns f, [..., 9, 9]. Shapes: pos [..., 3], vel [..., 3].
    """
    lat, h = pos[..., 0], pos[..., 2]
    radius_m, radius_n = earth.radii(lat)
    r_m, r_n = radius_m + h, radius_n + h
    tan, sec = torch.tan(lat), 1 / torch.cos(lat)
    v_e, v_n = vel[..., 0], vel[..., 1]
    z = torch.zeros_like(r_m)
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, vel)

    f12 = _matrix(z, -1 / r_m, z, 1 / r_n, z, z, tan / r_n, z, z)
    f_ie = _matrix(z, z, z, -w_ie[..., 2], z, z, w_ie[..., 1], z, z)
    f_en = _matrix(
        z, z, v_n / r_m**2, z, z, -v_e / r_n**2, v_e * sec**2 / r_n, z, -v_e * tan / r_n**2
    )
    spring = _matrix(
        z, z, z, z, z, z, z, z, 2 * earth.gravity(lat, h) / torch.sqrt(radius_m * radius_n)
    )
    across = attitude.skew(vel)
    f22 = across @ f12 - attitude.skew(2 * w_ie + w_en)
    f23 = across @ (2 * f_ie + f_en) + spring
    f32 = _matrix(z, 1 / r_m, z, sec / r_n, z, z, z, z, z + 1)
    f33 = _matrix(z, z, -v_n / r_m**2, v_e * sec * tan / r_n, z, -v_e * sec / r_n**2, z, z, z)
    attitude_columns = torch.zeros_like(f12)
    blocks = ((f12, f_ie + f_en), (f22, f23), (f32, f33))
    rows = [[attitude_columns, *row] for row in blocks]
    return torch.cat([torch.cat(row, dim=-1) for row in rows], dim=-2)


def small_angle_matrix(pos: Tensor, vel: Tensor, f: Tensor) -> Tensor:
    """Compute the linear dynamics F [..., 9, 9] for small attitude errors.

    `coupling_matrix` with F11 = -skew(w_in) and F21 = skew(f). Position is in (rad, rad, m).
    Sensor errors in body axes enter with -C into attitude (gyros) and +C into velocity.

    Returns f, [..., 9, 9]. Shapes: pos [..., 3], vel [..., 3], f [..., 3].
    """
    matrix = coupling_matrix(pos, vel)
    w_in = earth.earth_rate(pos[..., 0]) + earth.transport_rate(pos[..., 0], pos[..., 2], vel)
    blocks = [-attitude.skew(w_in), attitude.skew(f), torch.zeros_like(matrix[..., :3, :3])]
    return torch.cat([torch.cat(blocks, dim=-2), matrix[..., 3:]], dim=-1)


def convert_transition_to_metres(transition: Tensor, pos_start: Tensor, pos_end: Tensor) -> Tensor:
    """Convert a transition matrix from position in (rad, rad, m) to metres.

    S_k Phi S_(k-1)^-1, with each scale at its end of the interval. Only rows and columns 6 to 8
    change, so the matrix may be larger than 9 x 9 (sensor states after the position).

    Returns matrix for position errors North, East, Up in m, [..., D, D]. Shapes: transition
    [..., D, D], pos_start [..., 3], pos_end [..., 3].
    """
    size = transition.shape[-1]
    before = _scale_position(torch.ones_like(transition[..., 0, :]), earth.metre_scale(pos_start))
    after = _scale_position(torch.ones_like(transition[..., 0, :]), earth.metre_scale(pos_end))
    return transition * after.unsqueeze(-1).expand(*after.shape, size) / before.unsqueeze(-2)


def _euler_rate(alpha: Tensor, w: Tensor) -> Tensor:
    """Compute rates of the Euler errors of M rotating at w: alpha' = Cw^-1 w."""
    x, y = alpha[..., 0], alpha[..., 1]
    tan_x, sin_y, cos_y = torch.tan(x), torch.sin(y), torch.cos(y)
    level = cos_y * w[..., 2] - sin_y * w[..., 0]
    rates = [cos_y * w[..., 0] + sin_y * w[..., 2], w[..., 1] - tan_x * level, level / torch.cos(x)]
    return torch.stack(rates, dim=-1)


def _scale_position(x: Tensor, scale: Tensor) -> Tensor:
    """Multiply components 6 to 8 of x [..., D] by scale [..., 3]."""
    position = x[..., 6:9] * scale
    x = x.expand(*position.shape[:-1], x.shape[-1])
    return torch.cat([x[..., :6], position, x[..., 9:]], dim=-1)


def _matrix(*entries: Tensor) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*entries), dim=-1).unflatten(-1, (3, 3))


def _multiply(m: Tensor, a: Tensor) -> Tensor:
    return (m @ a.unsqueeze(-1)).squeeze(-1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))
