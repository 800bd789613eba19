"""Attitude: direction cosine matrices, Euler angles, quaternions, attitude errors.

Body axes are right, forward, up. The level frame is East, North, Up. Euler angles are
(pitch, roll, yaw) in rad. Yaw is counter-clockwise from North, so heading = -yaw. A positive
roll puts the right wing down. C = Rz(yaw) Rx(pitch) Ry(roll) rotates body vectors to level
ones [Yan Gongmin, PSINS]. Quaternions are scalar first with Hamilton's product,
v_n = q v_b q*. Every function broadcasts over leading axes.
"""

from __future__ import annotations

import torch
from torch import Tensor


def skew(a: Tensor) -> Tensor:
    """Build cross-product matrices [..., 3, 3].

    Shapes: a [..., 3].
    """
    x, y, z = a.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def dcm_from_euler(euler: Tensor) -> Tensor:
    """Convert Euler angles (pitch, roll, yaw) [..., 3] to matrices [..., 3, 3]."""
    (st, sg, sy), (ct, cg, cy) = torch.sin(euler).unbind(-1), torch.cos(euler).unbind(-1)
    rows = [cg * cy - sg * st * sy, -ct * sy, sg * cy + cg * st * sy]
    rows += [cg * sy + sg * st * cy, ct * cy, sg * sy - cg * st * cy]
    rows += [-sg * ct, st, cg * ct]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def euler_from_dcm(c: Tensor) -> Tensor:
    """Convert matrices [..., 3, 3] to Euler angles (pitch, roll, yaw) [..., 3].

    Pitch is in [-pi/2, pi/2], roll and yaw in (-pi, pi].
    """
    # not asin C[2, 1]: rounding can carry it above 1, and it loses half the digits near 90 degrees
    pitch = torch.atan2(c[..., 2, 1], torch.hypot(c[..., 2, 0], c[..., 2, 2]))
    roll = torch.atan2(-c[..., 2, 0], c[..., 2, 2])
    return torch.stack([pitch, roll, torch.atan2(-c[..., 0, 1], c[..., 1, 1])], dim=-1)


def dcm_from_rotation_vector(r: Tensor) -> Tensor:
    """Convert rotation vectors [..., 3] to matrices [..., 3, 3] by Rodrigues' formula."""
    turn = torch.linalg.vector_norm(r, dim=-1)[..., None, None] / torch.pi
    # torch.sinc(x) = sin(pi x) / (pi x) is exact at 0, and the half-angle form avoids the
    # cancellation in 1 - cos
    k, unit = skew(r), torch.eye(3, dtype=r.dtype, device=r.device)
    return unit + torch.sinc(turn) * k + 0.5 * torch.sinc(turn / 2) ** 2 * (k @ k)


def dcm_from_quaternion(q: Tensor) -> Tensor:
    """Convert unit quaternions [..., 4] to matrices [..., 3, 3]."""
    a, b, c, d = q.unbind(-1)
    rows = [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)]
    rows += [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)]
    rows += [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def quaternion_from_dcm(c: Tensor) -> Tensor:
    """Convert matrices [..., 3, 3] to unit quaternions [..., 4] with scalar part >= 0.

    Normalises the row of 4 q q^T with the largest diagonal element, which avoids division by
    small numbers [Shepperd 1978].
    """
    xx, yy, zz = c[..., 0, 0], c[..., 1, 1], c[..., 2, 2]
    ax, ay, az = (
        c[..., 2, 1] - c[..., 1, 2],
        c[..., 0, 2] - c[..., 2, 0],
        c[..., 1, 0] - c[..., 0, 1],
    )
    xy, xz, yz = (
        c[..., 0, 1] + c[..., 1, 0],
        c[..., 0, 2] + c[..., 2, 0],
        c[..., 1, 2] + c[..., 2, 1],
    )
    rows = [1 + xx + yy + zz, ax, ay, az, ax, 1 + xx - yy - zz, xy, xz]
    rows += [ay, xy, 1 - xx + yy - zz, yz, az, xz, yz, 1 - xx - yy + zz]
    outer = torch.stack(rows, dim=-1).unflatten(-1, (4, 4))
    largest = torch.diagonal(outer, dim1=-2, dim2=-1).argmax(-1)
    q = torch.take_along_dim(outer, largest[..., None, None], dim=-2).squeeze(-2)
    q = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def error_dcm(c_true: Tensor, c_ins: Tensor) -> Tensor:
    """Compute M = C_true C_ins^T, which rotates INS level axes to the true ones.

    Returns m, [..., 3, 3]. Shapes: c_true [..., 3, 3], c_ins [..., 3, 3].
    """
    return c_true @ c_ins.transpose(-1, -2)


def attitude_error(c_true: Tensor, c_ins: Tensor) -> Tensor:
    """Compute the attitude error alpha with M = Rz(a_U) Rx(a_E) Ry(a_N), any size.

    For small angles M ~ I + skew(alpha). It differs from the difference of pitch, roll and yaw.

    Returns alpha (East, North, Up), [..., 3], rad. Shapes: c_true [..., 3, 3], c_ins [..., 3, 3].
    """
    return euler_from_dcm(error_dcm(c_true, c_ins))


def residual_error(alpha_true: Tensor, alpha_hat: Tensor) -> Tensor:
    """Compute the attitude error after the correction C_hat = C(alpha_hat) C_ins.

    Also re-centres particles after such a correction.

    Returns remaining attitude error, [..., 3], rad. Shapes: alpha_true [..., 3], alpha_hat
    [..., 3].
    """
    return euler_from_dcm(dcm_from_euler(alpha_true) @ dcm_from_euler(alpha_hat).transpose(-1, -2))
