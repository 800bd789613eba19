"""Lines of sight to satellites, and exact range differences without cancellation.

Ranges are 2e7 m and their errors are metres, so the difference of two ranges loses seven
digits. `SatelliteGeometry` expands exactly about the INS position, which also suits float32.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import earth


class SatelliteGeometry(NamedTuple):
    """Ranging geometry at the INS, in Earth-fixed axes rotated to the INS meridian.

    The axes point away from the Earth's axis, East, and along the Earth's axis.

    Attributes:
        sine: Sine of the latitude, [...].
        cosine: Cosine of the latitude, [...].
        height: [...], m.
        vel: Velocity of the INS, East, North, Up, [..., 3], m/s.
        distance: Distance of the satellites, [..., S], m.
        line: Unit vectors from the satellites to the INS, [..., S, 3].
        closing: Velocity of the INS relative to the satellites, [..., S, 3], m/s.
    """

    sine: Tensor
    cosine: Tensor
    height: Tensor
    vel: Tensor
    distance: Tensor
    line: Tensor
    closing: Tensor

    def range_differences(self, dp: Tensor, dv: Tensor) -> tuple[Tensor, Tensor]:
        """Compute range and rate at the INS minus their values at the truth.

        The result is exact, without the cancellation of two ranges, and without the clock. The line
        is e, the distance is r, and D is truth minus INS in position. Then the ranges differ by
        r s / (1 + sqrt(1 + s)) with s = (2 e.D + |D|^2 / r) / r.

        Args:
            dp: Position errors North, East, Up, [R, N, 3], m, INS minus truth, in metres at
                the true position.
            dv: Velocity errors East, North, Up, [R, N, 3], m/s.

        Returns:
            Differences of range and rate, [R, N, S] each, m and m/s.
        """
        shift, shift1 = self._displacement(dp, dv)
        r, e, w = self.distance.unsqueeze(-1), self.line, self.closing
        square, mixed = ((shift * a).sum(-1, keepdim=True) for a in (shift, shift1))
        terms = torch.cat([shift, square], -1)
        r_s = _product(terms, torch.cat([2 * e, 1 / r], -1))
        root = torch.sqrt(1 - _product(terms, torch.cat([-2 * e, -1 / r], -1) / r))
        g = r_s / (1 - -root)
        rate = _product(torch.cat([shift, shift1, mixed], -1), torch.cat([w / r, e, 1 / r], -1))
        return -g, (g * ((e * w).sum(-1) / self.distance).unsqueeze(-2) - rate) / root

    def _constants(self) -> Tensor:
        """Return the quantities of the INS position and velocity that `_displacement` uses."""
        w = 1 - earth.E2 * self.sine**2
        across = earth.A / torch.sqrt(w)
        inside = (1 - earth.E2) * across
        scalars = [
            self.sine,
            self.cosine,
            2 * self.sine,
            self.height,
            across,
            inside,
            inside / w,
            earth.E2 / w,
        ]
        return torch.cat([torch.stack(scalars, -1), self.vel], -1).unsqueeze(-2)

    def _displacement(self, dp: Tensor, dv: Tensor) -> tuple[Tensor, Tensor]:
        """Compute truth minus INS in meridian axes: position and velocity [R, N, 3]."""
        # Forward-mode AD is 100 times faster if the constants have tangents, even zero ones.
        # Python numbers have none, so the code below contains few.
        constants = self._constants() + (dp[..., :1] - dp[..., :1])
        s, c, twice_s, h, r_n, r_p, r_m, flat, v_e, v_n, v_u = constants.unbind(-1)
        (north, east, up), (dv_e, dv_n, dv_u) = dp.unbind(-1), dv.unbind(-1)
        h_t, radius = h - up, r_m
        for _ in range(2):  # uses the meridian radius at the true position
            sine, versine = _sine_versine(-north / (radius + h_t))
            ds, dc = c * sine - s * versine, -s * sine - c * versine
            u = flat * ds * (twice_s + ds)
            t = torch.sqrt(1 - u)  # R_N varies as 1 / t, R_M as its cube
            radius = r_m / (t * t * t)
        grown = u / (t + t * t)
        s_t, c_t, wider = s + ds, c + dc, r_n * grown
        parallel = (r_n + wider + h_t) * c_t
        sine, versine = _sine_versine(-east / parallel)
        outwards = (r_n + h) * dc + (wider - up) * c_t - parallel * versine
        along = (r_p + h) * ds + (r_p * grown - up) * s_t
        fall = dc * v_u - ds * v_n + s_t * dv_n - c_t * dv_u  # velocity away from the axis
        off, east_t = c * v_u - s * v_n + fall, v_e - dv_e
        rise = dc * v_n + ds * v_u - c_t * dv_n - s_t * dv_u
        motion = [fall - versine * off - sine * east_t, sine * off - dv_e - versine * east_t, rise]
        return torch.stack([outwards, parallel * sine, along], -1), torch.stack(motion, -1)


def _sine_versine(angle: Tensor) -> tuple[Tensor, Tensor]:
    """Compute sin a, and 1 - cos a without cancellation."""
    sine = torch.sin(angle)
    return sine, sine * sine / (1 - -torch.cos(angle))


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply a [R, N, k] by b [R or 1, S, k]^T: [R, N, S]."""
    # matmul takes 20 times as long in forward-mode differentiation
    return torch.bmm(a, b.mT.expand(a.shape[0], -1, -1))


def predict_ranges(
    pos: Tensor, vel: Tensor, satellite: Tensor, satellite_vel: Tensor
) -> SatelliteGeometry:
    """Compute the ranging geometry at the INS. All arguments are float64.

    Args:
        pos: Positions, [..., 3], rad, rad, m.
        vel: Velocities East, North, Up, [..., 3], m/s.
        satellite: Earth-fixed positions of satellites, [..., S, 3], m.
        satellite_vel: Earth-fixed velocities of satellites, [..., S, 3], m/s.

    Returns:
        Geometry.
    """
    position, velocity = convert_to_earth_fixed(pos, vel)
    line = position.unsqueeze(-2) - satellite
    closing = velocity.unsqueeze(-2) - satellite_vel
    distance = torch.linalg.vector_norm(line, dim=-1)
    sine, cosine = torch.sin(pos[..., 1]), torch.cos(pos[..., 1])

    def rotate(a: Tensor) -> Tensor:
        x, y, z = a.unbind(-1)
        so, co = sine.unsqueeze(-1), cosine.unsqueeze(-1)
        return torch.stack([co * x + so * y, co * y - so * x, z], -1)

    unit = rotate(line / distance.unsqueeze(-1))
    latitude = pos[..., 0]
    return SatelliteGeometry(
        torch.sin(latitude), torch.cos(latitude), pos[..., 2], vel, distance, unit, rotate(closing)
    )


def convert_to_earth_fixed(pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor]:
    """Convert position and velocity to Earth-fixed axes.

    Args:
        pos: Positions, [..., 3], rad, rad, m.
        vel: Velocities East, North, Up, [..., 3], m/s.

    Returns:
        Position and velocity, [..., 3] each, m and m/s.
    """
    return earth.ecef(pos), (earth.local_axes(pos).mT @ vel.unsqueeze(-1)).squeeze(-1)
