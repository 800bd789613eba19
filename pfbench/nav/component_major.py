"""Quaternions and Earth quantities with components before particles.

Tensors are [..., k, N], the order in memory of particles. N may be 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core import quaternion
from pfbench.nav import attitude, earth


def earth_quantities(pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute quantities that depend on position and velocity only.

    Args:
        pos: Position, [..., 3, N], rad, rad, m.
        vel: Velocity (E, N, U), [..., 3, N], m/s.

    Returns:
        Rate of the level frame in inertial space, rad/s, gravity with Coriolis acceleration, m/s^2,
        and rate of the position, (rad/s, rad/s, m/s), [..., 3, N] each.
    """
    (lat, _, h), (v_e, v_n, v_u) = pos.unbind(-2), vel.unbind(-2)
    r_m, r_n = earth.radii(lat)
    sine, cosine = torch.sin(lat), torch.cos(lat)
    north, east = v_n / (r_m + h), v_e / (r_n + h)
    lon, spin_n, spin_u = east / cosine, earth.OMEGA * cosine, earth.OMEGA * sine
    w = torch.stack([-north, spin_n + east, spin_u + lon * sine], -2)
    c_e, c_n, c_u = -north, 2.0 * spin_n + east, 2.0 * spin_u + lon * sine
    free = [
        v_n * c_u - v_u * c_n,
        v_u * c_e - v_e * c_u,
        v_e * c_n - v_n * c_e - earth.gravity(lat, h),
    ]
    return w, torch.stack(free, -2), torch.stack([north, lon, v_u], -2)


def convert_to_metres(dp: Tensor, pos: Tensor) -> Tensor:
    """Convert INS position errors (rad, rad, m) to metres at the true position.

    Args:
        dp: Position errors, [..., 3, N].
        pos: INS position, [..., 3, N].
    """
    return dp * _metre_scale(pos - dp)


def convert_from_metres(metres: Tensor, pos: Tensor) -> Tensor:
    """Convert position errors in metres to (rad, rad, m) (inverse of `convert_to_metres`).

    Each pass has the error factor 0.01 error / Earth radius: 200 km are correct to a millimetre.

    Args:
        metres: Position errors, [..., 3, N].
        pos: INS position, [..., 3, N].
    """
    dp = metres * metres.new_tensor([[0.0], [0.0], [1.0]])  # the height error needs no iteration
    for _ in range(3):
        dp = metres / _metre_scale(pos - dp)
    return dp


def _metre_scale(pos: Tensor) -> Tensor:
    lat, _, h = pos.unbind(-2)
    r_m, r_n = earth.radii(lat)
    return torch.stack([r_m + h, (r_n + h) * torch.cos(lat), torch.ones_like(h)], -2)


def rotate_vectors(m: Tensor, a: Tensor) -> Tensor:
    """Multiply matrices by vectors.

    Args:
        m: Matrices, [..., 3, 3, N].
        a: Vectors, [..., 3, N].
    """
    return (m * a.unsqueeze(-3)).sum(-2)


def rotation_matrix(q: Tensor) -> Tensor:
    """Compute R(q) [..., 3, 3, N] of unit quaternions [..., 4, N]."""
    return (_MATRIX.to(q) @ _outer(q, q)).unflatten(-2, (3, 3))


def rotate_quaternion(q: Tensor, r: Tensor) -> Tensor:
    """Compute q exp(r) by the series of tan(|r| / 2), correct to 1e-10 at 0.1 rad.

    Args:
        q: Unit quaternions, [..., 4, N].
        r: Rotation vectors, [..., 3, N].
    """
    s = _square(r)
    small = torch.cat([torch.ones_like(s), r * (0.5 + s * (1.0 / 24.0 + s / 240.0))], -2)
    product = _PRODUCT.to(q) @ _outer(q, small)
    return product * torch.rsqrt(_square(product))


def _outer(p: Tensor, q: Tensor) -> Tensor:
    """Return all products of components [..., 16, N]."""
    return (p.unsqueeze(-2) * q.unsqueeze(-3)).flatten(-3, -2)


def _square(a: Tensor) -> Tensor:
    return (a * a).sum(-2, keepdim=True)


def _tables() -> tuple[Tensor, Tensor]:
    """Return rotation matrix [9, 16] and product [4, 16] as maps of products."""
    unit = torch.eye(4, dtype=torch.float64)
    first, second = (a.flatten(0, 1) for a in torch.broadcast_tensors(unit[:, None], unit))
    total, single = (
        attitude.dcm_from_quaternion(first + second),
        (attitude.dcm_from_quaternion(a) for a in (first, second)),
    )
    matrix = 0.5 * (
        total - sum(single, torch.zeros_like(total))
    )  # polarised, since it is quadratic
    return matrix.flatten(1).T.contiguous(), quaternion.quaternion_multiply(
        first, second
    ).T.contiguous()


_MATRIX, _PRODUCT = _tables()
