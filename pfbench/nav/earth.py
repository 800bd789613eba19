"""The WGS-84 Earth: radii, normal gravity, rates of the level frame, coordinates; also with components before particles."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core import chart
from pfbench.nav import attitude

# Positions are pos [..., 3] = (latitude, longitude, height) in rad, rad, m. Velocities are
# v [..., 3] = (East, North, Up) in m/s. Every function broadcasts over leading axes.

A = 6378137.0  # semi-major axis [m]
F_E = 1 / 298.257223563  # flattening
E2 = F_E * (2 - F_E)  # first eccentricity squared
OMEGA = 7.292115e-5  # angular rate [rad/s]
GM = 3.986004418e14  # gravitational constant of the Earth with its atmosphere [m^3/s^2]
G_EQUATOR = 9.7803253359  # normal gravity on the ellipsoid at the equator [m/s^2]
G_SOMIGLIANA = 0.00193185265241
M_RATIO = OMEGA**2 * A**3 * (1 - F_E) / GM  # m of the height formula


def radii(lat: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the radii of curvature along the meridian and across it.

    Returns (R_M, R_N), [...] each, m. Shapes: lat [...].
    """
    w = 1 - E2 * torch.sin(lat) ** 2
    r_n = A / torch.sqrt(w)
    return (1 - E2) * r_n / w, r_n


def gravity(lat: Tensor, h: Tensor) -> Tensor:
    """Compute the magnitude of normal gravity.

    The vector is (0, 0, -g) in East, North, Up. Somigliana's formula on the ellipsoid, second
    order in height [WGS-84, NIMA TR8350.2, eqs 4-1 and 4-3].

    Returns gravity, [...], m/s^2. Shapes: lat [...], h [...].
    """
    s2 = torch.sin(lat) ** 2
    ellipsoid = G_EQUATOR * (1 + G_SOMIGLIANA * s2) / torch.sqrt(1 - E2 * s2)
    return ellipsoid * (1 - 2 * h / A * (1 + F_E + M_RATIO - 2 * F_E * s2) + 3 * (h / A) ** 2)


def inverse_radii_and_gravity(s2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute inverse radii and gravity together from sin^2 of the latitude.

    The terms are shared, and the number of operations is small, for the inner loop of an INS.

    Returns 1 / (R_M + h), 1 / (R_N + h), gravity, [...] each. Shapes: s2 [...], h [...].
    """
    w = torch.rsub(s2, 1.0, alpha=E2)
    root = torch.rsqrt(w)
    r_n = root * A
    g0 = root * (s2 * (G_EQUATOR * G_SOMIGLIANA) + G_EQUATOR)
    linear = s2 * (4 * F_E / A) - 2 / A * (1 + F_E + M_RATIO)
    g = g0 * (1 + h * torch.add(linear, h, alpha=3 / A**2))
    return (
        torch.reciprocal(torch.addcdiv(h, r_n, w, value=1 - E2)),
        torch.reciprocal(r_n + h),
        g,
    )


def earth_rate(lat: Tensor) -> Tensor:
    """Compute the rotation rate of the Earth in East, North, Up, [..., 3], rad/s."""
    return OMEGA * torch.stack([torch.zeros_like(lat), torch.cos(lat), torch.sin(lat)], dim=-1)


def transport_rate(lat: Tensor, h: Tensor, v: Tensor) -> Tensor:
    """Compute the rate of the level frame relative to the Earth due to vehicle motion.

    Returns rate in East, North, Up, [..., 3], rad/s. Shapes: lat [...], h [...], v [..., 3].
    """
    r_m, r_n = radii(lat)
    east = v[..., 0] / (r_n + h)
    return torch.stack([-v[..., 1] / (r_m + h), east, east * torch.tan(lat)], dim=-1)


def position_rate(pos: Tensor, v: Tensor) -> Tensor:
    """Compute the time derivative of a position.

    Returns derivative, [..., 3], rad/s, rad/s, m/s. Shapes: pos [..., 3], v [..., 3].
    """
    return torch.stack([v[..., 1], v[..., 0], v[..., 2]], dim=-1) / metre_scale(pos)


def metre_scale(pos: Tensor) -> Tensor:
    """Compute metres per (rad, rad, m): (R_M + h, (R_N + h) cos L, 1), [..., 3].

    (dL, dlam, dh) * metre_scale(pos) = (dN, dE, dU). North comes first, like latitude.
    """
    lat, h = pos[..., 0], pos[..., 2]
    r_m, r_n = radii(lat)
    return torch.stack([r_m + h, (r_n + h) * torch.cos(lat), torch.ones_like(h)], dim=-1)


def ecef(pos: Tensor) -> Tensor:
    """Convert a position to Earth-centred Earth-fixed x, y, z, [..., 3], m."""
    lat, lon, h = pos.unbind(-1)
    _, r_n = radii(lat)
    across = (r_n + h) * torch.cos(lat)
    z = (r_n * (1 - E2) + h) * torch.sin(lat)
    return torch.stack([across * torch.cos(lon), across * torch.sin(lon), z], dim=-1)


def geodetic(xyz: Tensor, passes: int = 6) -> Tensor:
    """Convert Earth-centred Earth-fixed points to positions (inverse of `ecef`).

    Iterates on the reduced latitude [Bowring 1976]. Six passes reach double precision from 10 km
    below the ground to 1000 km above it.

    Returns positions, [..., 3], rad, rad, m. Shapes: xyz [..., 3].
    """
    x, y, z = xyz.unbind(-1)
    across = torch.hypot(x, y)
    b, second = A * (1 - F_E), E2 / (1 - E2)
    reduced = torch.atan2(z, (1 - F_E) * across)
    lat = reduced
    for _ in range(passes):
        lat = torch.atan2(
            z + second * b * torch.sin(reduced) ** 3, across - E2 * A * torch.cos(reduced) ** 3
        )
        reduced = torch.atan2((1 - F_E) * torch.sin(lat), torch.cos(lat))
    _, r_n = radii(lat)
    # the projection on the vertical is well conditioned everywhere, division by cos L is not
    h = across * torch.cos(lat) + z * torch.sin(lat) - A**2 / r_n
    return torch.stack([lat, torch.atan2(y, x), h], dim=-1)


def local_axes(origin: Tensor) -> Tensor:
    """Compute rotations [..., 3, 3] from Earth-fixed axes to East, North, Up.

    Shapes: origin [..., 3].
    """
    sl, cl = torch.sin(origin[..., 0]), torch.cos(origin[..., 0])
    so, co = torch.sin(origin[..., 1]), torch.cos(origin[..., 1])
    rows = [-so, co, torch.zeros_like(so), -sl * co, -sl * so, cl, cl * co, cl * so, sl]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def local_enu(pos: Tensor, origin: Tensor) -> Tensor:
    """Convert positions to East, North, Up offsets from an origin.

    The conversion is exact, through Earth-fixed axes. A level flight therefore sinks below the
    tangent plane, by 8 m at 10 km.

    Returns offsets, [..., 3], m. Shapes: pos [..., 3], origin [..., 3].
    """
    return (local_axes(origin) @ (ecef(pos) - ecef(origin)).unsqueeze(-1)).squeeze(-1)


def from_local_enu(enu: Tensor, origin: Tensor) -> Tensor:
    """Convert East, North, Up offsets to positions (inverse of `local_enu`).

    Returns positions, [..., 3], rad, rad, m. Shapes: enu [..., 3], origin [..., 3].
    """
    return geodetic(
        ecef(origin) + (local_axes(origin).transpose(-1, -2) @ enu.unsqueeze(-1)).squeeze(-1)
    )


# --------------------------------------------------------------------------------------------------
# Quaternions and Earth quantities with components before particles.
#
# Tensors are [..., k, N], the order in memory of particles. N may be 1.


def earth_quantities(pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute quantities that depend on position and velocity only.

    Returns rate of the level frame in inertial space, rad/s, gravity with Coriolis acceleration,
    m/s^2, and rate of the position, (rad/s, rad/s, m/s), [..., 3, N] each. Shapes: pos [..., 3, N],
    vel [..., 3, N].
    """
    (lat, _, h), (v_e, v_n, v_u) = pos.unbind(-2), vel.unbind(-2)
    r_m, r_n = radii(lat)
    sine, cosine = torch.sin(lat), torch.cos(lat)
    north, east = v_n / (r_m + h), v_e / (r_n + h)
    lon, spin_n, spin_u = east / cosine, OMEGA * cosine, OMEGA * sine
    w = torch.stack([-north, spin_n + east, spin_u + lon * sine], -2)
    c_e, c_n, c_u = -north, 2.0 * spin_n + east, 2.0 * spin_u + lon * sine
    free = [
        v_n * c_u - v_u * c_n,
        v_u * c_e - v_e * c_u,
        v_e * c_n - v_n * c_e - gravity(lat, h),
    ]
    return w, torch.stack(free, -2), torch.stack([north, lon, v_u], -2)


def convert_to_metres(dp: Tensor, pos: Tensor) -> Tensor:
    """Convert INS position errors (rad, rad, m) to metres at the true position.

    Shapes: dp [..., 3, N], pos [..., 3, N].
    """
    return dp * _metre_scale(pos - dp)


def convert_from_metres(metres: Tensor, pos: Tensor) -> Tensor:
    """Convert position errors in metres to (rad, rad, m) (inverse of `convert_to_metres`).

    Each pass has the error factor 0.01 error / Earth radius: 200 km are correct to a millimetre.

    Shapes: metres [..., 3, N], pos [..., 3, N].
    """
    dp = metres * metres.new_tensor([[0.0], [0.0], [1.0]])  # the height error needs no iteration
    for _ in range(3):
        dp = metres / _metre_scale(pos - dp)
    return dp


def _metre_scale(pos: Tensor) -> Tensor:
    lat, _, h = pos.unbind(-2)
    r_m, r_n = radii(lat)
    return torch.stack([r_m + h, (r_n + h) * torch.cos(lat), torch.ones_like(h)], -2)


def rotate_vectors(m: Tensor, a: Tensor) -> Tensor:
    """Multiply matrices by vectors.

    Shapes: m [..., 3, 3, N], a [..., 3, N].
    """
    return (m * a.unsqueeze(-3)).sum(-2)


def rotation_matrix(q: Tensor) -> Tensor:
    """Compute R(q) [..., 3, 3, N] of unit quaternions [..., 4, N]."""
    return (_MATRIX.to(q) @ _outer(q, q)).unflatten(-2, (3, 3))


def rotate_quaternion(q: Tensor, r: Tensor) -> Tensor:
    """Compute q exp(r) by the series of tan(|r| / 2), correct to 1e-10 at 0.1 rad.

    Shapes: q [..., 4, N], r [..., 3, N].
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
    return matrix.flatten(1).T.contiguous(), chart.quaternion_multiply(first, second).T.contiguous()


_MATRIX, _PRODUCT = _tables()
