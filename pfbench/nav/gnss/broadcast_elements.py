"""Orbital elements of broadcast ephemerides [IS-GPS-200, table 20-IV]."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from pfbench.nav.gnss.orbits import GPS_OMEGA, OrbitalElements, eccentric_anomaly


def mean_motion(eph: Mapping[str, Tensor]) -> Tensor:
    """Compute the corrected mean motion of ephemerides, rad/s, [...]."""
    return torch.sqrt(eph["gm"]) / eph["sqrtA"] ** 3 + eph["deltan"]


def broadcast_elements(eph: Mapping[str, Tensor]) -> OrbitalElements:
    """Evaluate the user algorithm and its derivatives.

    Args:
        eph: Parameters by RINEX name, [...] each, with `tk`, the time from `toe` in s, `sow`, the
            `toe` in seconds of the week, and `gm`.

    Returns:
        The elements, [...] each.
    """
    e, tk, n = eph["e"], eph["tk"], mean_motion(eph)
    anomaly, near = eccentric_anomaly(eph["M0"] + n * tk, e)
    anomaly1, root = n / near, torch.sqrt(1 - e * e)
    turn = torch.atan2(root * torch.sin(anomaly), torch.cos(anomaly) - e) + eph["omega"]
    turn1 = root * anomaly1 / near
    s2, c2 = torch.sin(2 * turn), torch.cos(2 * turn)

    def harmonic(sine: str, cosine: str) -> tuple[Tensor, Tensor]:
        derivative = 2 * turn1 * (eph[sine] * c2 - eph[cosine] * s2)
        return eph[sine] * s2 + eph[cosine] * c2, derivative

    du, du1 = harmonic("cus", "cuc")
    dr, dr1 = harmonic("crs", "crc")
    di, di1 = harmonic("cis", "cic")
    size, node1 = eph["sqrtA"] ** 2, eph["Omegadot"] - GPS_OMEGA
    node = eph["Omega0"] + node1 * tk - GPS_OMEGA * eph["sow"]
    radius1 = size * e * torch.sin(anomaly) * anomaly1 + dr1
    inclination = eph["i0"] + eph["idot"] * tk + di
    rates = (radius1, turn1 + du1, eph["idot"] + di1, node1)
    return OrbitalElements(size * near + dr, turn + du, inclination, node, *rates)
