"""How errors of an INS grow: the exact nonlinear equations, and the linear blocks.

Errors are INS minus truth: x [..., 9] = attitude (East, North, Up; `attitude.attitude_error`, of any size), velocity
(East, North, Up), position. Position errors are in (rad, rad, m) wherever rates or F matrices are spoken of, and in
metres (North, East, Up) in what goes over an interval: `propagate` and `in_metres`. Nominal quantities are the INS's
own, with its errors. Everything broadcasts: errors [R, N, 9] with nominals [R, 1, 3], say.

[Yan Gongmin, postdoctoral report, eqs 4-17 to 4-21, for large misalignment angles; linear blocks as in any inertial
text]
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import attitude, earth
from pfbench.nav.strapdown import Intervals


class Nominal(NamedTuple):
    """What the INS believes at one instant, or on average over an interval.

    Attributes:
        dcm: body to level [..., 3, 3].
        vel: East, North, Up [..., 3] m/s.
        pos: latitude, longitude, height [..., 3] rad, rad, m.
        f: specific force in the frame the INS believes in [..., 3] m/s^2.
    """

    dcm: Tensor
    vel: Tensor
    pos: Tensor
    f: Tensor


def mid_interval(intervals: Intervals) -> Nominal:
    """Nominal quantities at the middle of intervals; the mean of two attitudes is good to second order."""
    return Nominal((intervals.dcm + intervals.dcm_end) / 2, intervals.vel, intervals.pos, intervals.f)


def rate(x: Tensor, nominal: Nominal, gyro: Tensor | None = None, accelerometer: Tensor | None = None) -> Tensor:
    """Exact time derivative of the errors, position in (rad, rad, m).

    Args:
        x: errors [..., 9].
        nominal: the INS.
        gyro: gyro errors in body axes [..., 3] rad/s, or None for none.
        accelerometer: accelerometer errors in body axes [..., 3] m/s^2, or None.

    Returns:
        [..., 9].
    """
    alpha, dv, dp = x.split(3, dim=-1)
    dcm, v, pos, f = nominal
    v_t, pos_t = v - dv, pos - dp
    m = attitude.dcm_from_euler(alpha)
    w_ie, w_en = earth.earth_rate(pos[..., 0]), earth.transport_rate(pos[..., 0], pos[..., 2], v)
    d_ie = w_ie - earth.earth_rate(pos_t[..., 0])
    d_en = w_en - earth.transport_rate(pos_t[..., 0], pos_t[..., 2], v_t)

    w = w_ie + w_en
    turn = w - _transposed(m, w - d_ie - d_en)
    push = f - _times(m, f) - _cross(2 * d_ie + d_en, v_t) - _cross(2 * w_ie + w_en, dv)
    if gyro is not None:
        turn = turn - _times(dcm, gyro)
    if accelerometer is not None:
        push = push + _times(m, _times(dcm, accelerometer))
    sink = earth.gravity(pos_t[..., 0], pos_t[..., 2]) - earth.gravity(pos[..., 0], pos[..., 2])
    push = torch.cat([push[..., :2], push[..., 2:] + sink.unsqueeze(-1)], dim=-1)
    drift = earth.position_rate(pos, v) - earth.position_rate(pos_t, v_t)
    return torch.cat(torch.broadcast_tensors(_euler_rate(alpha, turn), push, drift), dim=-1)


def propagate(
    x: Tensor, interval: Intervals, gyro: Tensor | None = None, accelerometer: Tensor | None = None, passes: int = 1
) -> Tensor:
    """Errors over one interval by the exact equations; position in metres (North, East, Up), before and after.

    Classical Runge-Kutta with the nominal of mid-interval: second order in the interval's length, because the nominal
    is frozen.

    Args:
        x: errors at the start [..., 9].
        interval: one that broadcasts with x: `map_inputs(lambda a: a[:, t, None], intervals)` for x [R, N, 9].
        gyro: gyro errors during the interval, body axes [..., 3] rad/s.
        accelerometer: accelerometer errors, body axes [..., 3] m/s^2.
        passes: Runge-Kutta steps within the interval.

    Returns:
        Errors at the end [..., 9].
    """
    nominal, step = mid_interval(interval), (interval.duration / passes).unsqueeze(-1)

    def slope(errors: Tensor) -> Tensor:
        return rate(errors, nominal, gyro, accelerometer)

    x = _scaled(x, 1 / earth.metre_scale(interval.pos_start))
    for _ in range(passes):
        k1 = slope(x)
        k2 = slope(x + step / 2 * k1)
        k3 = slope(x + step / 2 * k2)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + step * k3))
    return _scaled(x, earth.metre_scale(interval.pos_end))


def coupling_matrix(pos: Tensor, vel: Tensor) -> Tensor:
    """Linear error dynamics F [..., 9, 9] of velocity and position errors, position in (rad, rad, m).

    Blocks F12, F13, F22, F23, F32, F33; the attitude's own columns F11 and F21 are 0 here, for models that treat
    attitude nonlinearly; `small_angle_matrix` fills them.

    Args:
        pos: [..., 3] rad, rad, m.
        vel: East, North, Up [..., 3] m/s.
    """
    lat, h = pos[..., 0], pos[..., 2]
    radius_m, radius_n = earth.radii(lat)
    r_m, r_n = radius_m + h, radius_n + h
    tan, sec = torch.tan(lat), 1 / torch.cos(lat)
    v_e, v_n = vel[..., 0], vel[..., 1]
    o = torch.zeros_like(r_m)
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, vel)

    f12 = _matrix(o, -1 / r_m, o, 1 / r_n, o, o, tan / r_n, o, o)
    f_ie = _matrix(o, o, o, -w_ie[..., 2], o, o, w_ie[..., 1], o, o)
    f_en = _matrix(o, o, v_n / r_m**2, o, o, -v_e / r_n**2, v_e * sec**2 / r_n, o, -v_e * tan / r_n**2)
    spring = _matrix(o, o, o, o, o, o, o, o, 2 * earth.gravity(lat, h) / torch.sqrt(radius_m * radius_n))
    across = attitude.skew(vel)
    f22 = across @ f12 - attitude.skew(2 * w_ie + w_en)
    f23 = across @ (2 * f_ie + f_en) + spring
    f32 = _matrix(o, 1 / r_m, o, sec / r_n, o, o, o, o, o + 1)
    f33 = _matrix(o, o, -v_n / r_m**2, v_e * sec * tan / r_n, o, -v_e * sec / r_n**2, o, o, o)
    zero = torch.zeros_like(f12)
    rows = [[zero, f12, f_ie + f_en], [zero, f22, f23], [zero, f32, f33]]
    return torch.cat([torch.cat(row, dim=-1) for row in rows], dim=-2)


def small_angle_matrix(pos: Tensor, vel: Tensor, f: Tensor) -> Tensor:
    """Linear error dynamics F [..., 9, 9] for small attitude errors: F11 = -skew(w_in), F21 = skew(f) are filled in.

    Position in (rad, rad, m). Sensor errors in body axes enter with -C into attitude (gyros) and +C into velocity.

    Args:
        pos: [..., 3] rad, rad, m.
        vel: East, North, Up [..., 3] m/s.
        f: specific force in the INS's level frame [..., 3] m/s^2.
    """
    matrix = coupling_matrix(pos, vel)
    w_in = earth.earth_rate(pos[..., 0]) + earth.transport_rate(pos[..., 0], pos[..., 2], vel)
    own = torch.cat([-attitude.skew(w_in), attitude.skew(f), torch.zeros_like(matrix[..., :3, :3])], dim=-2)
    return torch.cat([own, matrix[..., 3:]], dim=-1)


def in_metres(transition: Tensor, pos_start: Tensor, pos_end: Tensor) -> Tensor:
    """A transition matrix over an interval with position in (rad, rad, m) to one in metres (North, East, Up).

    S_k Phi S_(k-1)^-1, each scale taken at its own end of the interval. Only rows and columns 6 to 8 change, so the
    matrix may be larger than 9 x 9 (sensor states after the position).

    Args:
        transition: [..., D, D], D >= 9.
        pos_start: nominal position at the start [..., 3].
        pos_end: at the end [..., 3].
    """
    size = transition.shape[-1]
    before = _scaled(torch.ones_like(transition[..., 0, :]), earth.metre_scale(pos_start))
    after = _scaled(torch.ones_like(transition[..., 0, :]), earth.metre_scale(pos_end))
    return transition * after.unsqueeze(-1).expand(*after.shape, size) / before.unsqueeze(-2)


def _euler_rate(alpha: Tensor, w: Tensor) -> Tensor:
    """Rates of the Euler errors that turn M at w: alpha' = Cw^-1 w [..., 3]."""
    x, y = alpha[..., 0], alpha[..., 1]
    tan_x, sin_y, cos_y = torch.tan(x), torch.sin(y), torch.cos(y)
    level = cos_y * w[..., 2] - sin_y * w[..., 0]
    parts = [cos_y * w[..., 0] + sin_y * w[..., 2], w[..., 1] - tan_x * level, level / torch.cos(x)]
    return torch.stack(parts, dim=-1)


def _scaled(x: Tensor, scale: Tensor) -> Tensor:
    """x [..., D] with its components 6 to 8 multiplied by scale [..., 3]."""
    shape = torch.broadcast_shapes(x.shape[:-1], scale.shape[:-1])
    x, scale = x.expand(*shape, x.shape[-1]), scale.expand(*shape, 3)
    return torch.cat([x[..., :6], x[..., 6:9] * scale, x[..., 9:]], dim=-1)


def _matrix(*entries: Tensor) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*entries), dim=-1).unflatten(-1, (3, 3))


def _times(m: Tensor, a: Tensor) -> Tensor:
    return (m @ a.unsqueeze(-1)).squeeze(-1)


def _transposed(m: Tensor, a: Tensor) -> Tensor:
    return _times(m.transpose(-1, -2), a)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))
