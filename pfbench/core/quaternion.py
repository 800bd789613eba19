"""Quaternion algebra of charts: unit quaternions, scalar first."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Hamilton's table: row 4 i + j holds the sign of the product of units i and j in its component.
_HAMILTON = torch.zeros(16, 4, dtype=torch.float64)
for _i, _row in enumerate(((+1, +2, +3, +4), (+2, -1, +4, -3), (+3, -4, -1, +2), (+4, +3, -2, -1))):
    for _j, _unit in enumerate(_row):
        _HAMILTON[4 * _i + _j, abs(_unit) - 1] = math.copysign(1.0, _unit)


def quaternion_from_rotation_vector(r: Tensor) -> Tensor:
    """Convert rotation vectors [..., 3] to unit quaternions [..., 4]."""
    angle = torch.linalg.vector_norm(r, dim=-1, keepdim=True)
    return torch.cat([torch.cos(angle / 2), 0.5 * torch.sinc(angle / (2 * torch.pi)) * r], dim=-1)


def rotation_vector_from_quaternion(q: Tensor) -> Tensor:
    """Convert unit quaternions [..., 4] to rotation vectors [..., 3].

    The length of a rotation vector is at most pi.
    """
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    half_sine = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    small = half_sine < torch.finfo(q.dtype).tiny
    divisor = torch.where(small, torch.ones_like(half_sine), half_sine)
    return torch.where(small, 2 / w, 2 * torch.atan2(half_sine, w) / divisor) * v


def quaternion_multiply(p: Tensor, q: Tensor) -> Tensor:
    """Compute Hamilton's product p q.

    Args:
        p: Left factors, [..., 4].
        q: Right factors, [..., 4].

    Returns:
        Products, [..., 4].
    """
    # one operation for all products: 16 separate ones take 3 times as long in forward-mode AD
    products = (p.unsqueeze(-1) * q.unsqueeze(-2)).flatten(-2)
    return products @ _HAMILTON.to(products)
