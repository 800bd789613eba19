"""Attitude: direction cosine matrices, Euler angles, quaternions, rotation vectors, and what an attitude error is.

Body axes are right, forward, up; the level frame is East, North, Up. Euler angles are (pitch, roll, yaw) in rad: yaw
is counter-clockwise from North, so heading = -yaw, and a positive roll puts the right wing down.
C = Rz(yaw) Rx(pitch) Ry(roll) turns body vectors into level ones [Yan Gongmin, PSINS]. Quaternions are scalar first,
Hamilton's product, v_n = q v_b q*. Every function broadcasts over leading axes.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Hamilton's table: row 4 i + j says which component the product of units i and j is, and with what sign.
_HAMILTON = torch.zeros(16, 4, dtype=torch.float64)
for _i, _row in enumerate(((+1, +2, +3, +4), (+2, -1, +4, -3), (+3, -4, -1, +2), (+4, +3, -2, -1))):
    for _j, _unit in enumerate(_row):
        _HAMILTON[4 * _i + _j, abs(_unit) - 1] = math.copysign(1.0, _unit)


def skew(a: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3] with skew(a) b = a x b."""
    x, y, z = a.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def dcm_from_euler(euler: Tensor) -> Tensor:
    """(pitch, roll, yaw) [..., 3] -> C [..., 3, 3]."""
    (st, sg, sy), (ct, cg, cy) = torch.sin(euler).unbind(-1), torch.cos(euler).unbind(-1)
    rows = [cg * cy - sg * st * sy, -ct * sy, sg * cy + cg * st * sy]
    rows += [cg * sy + sg * st * cy, ct * cy, sg * sy - cg * st * cy]
    rows += [-sg * ct, st, cg * ct]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def euler_from_dcm(c: Tensor) -> Tensor:
    """C [..., 3, 3] -> (pitch, roll, yaw) [..., 3]; pitch in [-pi/2, pi/2], the others in (-pi, pi]."""
    # not asin C[2, 1]: rounding can carry that above 1, and it loses half the digits near 90 degrees
    pitch = torch.atan2(c[..., 2, 1], torch.hypot(c[..., 2, 0], c[..., 2, 2]))
    roll = torch.atan2(-c[..., 2, 0], c[..., 2, 2])
    return torch.stack([pitch, roll, torch.atan2(-c[..., 0, 1], c[..., 1, 1])], dim=-1)


def dcm_from_rotation_vector(r: Tensor) -> Tensor:
    """Rodrigues: exp(skew(r)), [..., 3] -> [..., 3, 3]."""
    turn = torch.linalg.vector_norm(r, dim=-1)[..., None, None] / torch.pi
    # torch.sinc(x) = sin(pi x) / (pi x) is exact at 0; half-angle form, since 1 - cos cancels for small angles
    k, unit = skew(r), torch.eye(3, dtype=r.dtype, device=r.device)
    return unit + torch.sinc(turn) * k + 0.5 * torch.sinc(turn / 2) ** 2 * (k @ k)


def quaternion_from_rotation_vector(r: Tensor) -> Tensor:
    """[..., 3] -> unit quaternion [..., 4]."""
    angle = torch.linalg.vector_norm(r, dim=-1, keepdim=True)
    return torch.cat([torch.cos(angle / 2), 0.5 * torch.sinc(angle / (2 * torch.pi)) * r], dim=-1)


def rotation_vector_from_quaternion(q: Tensor) -> Tensor:
    """Unit quaternion [..., 4] -> [..., 3], the short way round (length at most pi)."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    half_sine = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    small = half_sine < torch.finfo(q.dtype).tiny
    divisor = torch.where(small, torch.ones_like(half_sine), half_sine)
    return torch.where(small, 2 / w, 2 * torch.atan2(half_sine, w) / divisor) * v


def quaternion_multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton's product p q: [..., 4], [..., 4] -> [..., 4]."""
    # sixteen products at once: in forward-mode differentiation sixteen separate ones cost three times as much
    products = (p.unsqueeze(-1) * q.unsqueeze(-2)).flatten(-2)
    return products @ _HAMILTON.to(products)


def dcm_from_quaternion(q: Tensor) -> Tensor:
    """Unit quaternion [..., 4] -> C [..., 3, 3]."""
    a, b, c, d = q.unbind(-1)
    rows = [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)]
    rows += [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)]
    rows += [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def quaternion_from_dcm(c: Tensor) -> Tensor:
    """C [..., 3, 3] -> unit quaternion [..., 4] with scalar part >= 0.

    Of the four rows of 4 q q^T the one with the largest diagonal is normalised, so nothing small is divided by
    [Shepperd 1978].
    """
    xx, yy, zz = c[..., 0, 0], c[..., 1, 1], c[..., 2, 2]
    ax, ay, az = c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]
    xy, xz, yz = c[..., 0, 1] + c[..., 1, 0], c[..., 0, 2] + c[..., 2, 0], c[..., 1, 2] + c[..., 2, 1]
    rows = [1 + xx + yy + zz, ax, ay, az, ax, 1 + xx - yy - zz, xy, xz]
    rows += [ay, xy, 1 - xx + yy - zz, yz, az, xz, yz, 1 - xx - yy + zz]
    outer = torch.stack(rows, dim=-1).unflatten(-1, (4, 4))
    largest = torch.diagonal(outer, dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(outer, largest[..., None, None], dim=-2).squeeze(-2)
    q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def error_dcm(c_true: Tensor, c_ins: Tensor) -> Tensor:
    """M = C_true C_ins^T [..., 3, 3]: turns vectors of the frame the INS believes in into the true level frame."""
    return c_true @ c_ins.transpose(-1, -2)


def attitude_error(c_true: Tensor, c_ins: Tensor) -> Tensor:
    """Attitude error alpha (East, North, Up) [..., 3] in rad: M = Rz(a_U) Rx(a_E) Ry(a_N), whatever its size.

    For small angles M ~ I + skew(alpha). It is not the difference of pitch, roll and yaw.
    """
    return euler_from_dcm(error_dcm(c_true, c_ins))


def residual_error(alpha_true: Tensor, alpha_hat: Tensor) -> Tensor:
    """Attitude error [..., 3] left after the INS is corrected by alpha_hat, i.e. C_hat = C(alpha_hat) C_ins.

    Also how particles are re-centred after such a correction.
    """
    return euler_from_dcm(dcm_from_euler(alpha_true) @ dcm_from_euler(alpha_hat).transpose(-1, -2))
