"""Navigation satellites: how they move, nominal constellations, and what a receiver makes of where they are.

Positions and velocities are Earth-fixed [m, m/s], velocities as seen from the rotating Earth. Time is seconds from the
beginning of a scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.nav import earth

LIGHT = 299792458.0  # m/s
GPS_OMEGA = 7.2921151467e-5  # rate of the Earth that ephemerides are made with [rad/s]
_TYPICAL_FLIGHT = 0.075  # s


class Constellation(Protocol):
    """Satellites whose places are known."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the S satellites: G05, E31 ..."""

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities at times [T] s: [T, S, 3] m and m/s; NaN where a satellite's place is not known."""


class Elements(NamedTuple):
    """Where satellites are in their orbits, and the time derivatives of that, each [...].

    Attributes:
        radius, argument, inclination, node: m; argument of latitude, inclination and Earth-fixed longitude of the ascending
            node, rad.
        radius1, argument1, inclination1, node1: per second.
    """

    radius: Tensor
    argument: Tensor
    inclination: Tensor
    node: Tensor
    radius1: Tensor
    argument1: Tensor
    inclination1: Tensor
    node1: Tensor

    def earth_fixed(self) -> tuple[Tensor, Tensor]:
        """Position and velocity [..., 3]."""
        (su, cu), (si, ci), (so, co) = ((torch.sin(a), torch.cos(a)) for a in self[1:4])
        along, across = self.radius * cu, self.radius * su
        along1 = self.radius1 * cu - across * self.argument1
        across1 = self.radius1 * su + along * self.argument1
        level, level1 = across * ci, across1 * ci - across * si * self.inclination1
        x, y = along * co - level * so, along * so + level * co
        x1 = along1 * co - level1 * so - y * self.node1
        y1 = along1 * so + level1 * co + x * self.node1
        z1 = across1 * si + across * ci * self.inclination1
        return torch.stack([x, y, across * si], -1), torch.stack([x1, y1, z1], -1)


@dataclass(frozen=True)
class Walker:
    """Circular orbits in evenly spaced planes, i: T/P/F [Walker 1984, "Satellite constellations"]; defaults near GPS [ours].

    Args:
        satellites, planes, phasing: T, P and F; satellites of neighbouring planes are F 360/T degrees apart.
        inclination_deg: of all planes.
        semi_major_axis: m.
        node_deg: the first plane's node lies so far West of Greenwich at t = 0.
        argument_deg: argument of latitude of the first satellite at t = 0.

    Raises:
        ValueError: satellites that do not fill the planes, or an orbit inside the Earth.
    """

    satellites: int = 24
    planes: int = 6
    phasing: int = 1
    inclination_deg: float = 55.0
    semi_major_axis: float = 26559710.0
    node_deg: float = 40.0
    argument_deg: float = 40.0

    def __post_init__(self) -> None:
        if min(self.satellites, self.planes) < 1 or self.satellites % self.planes:
            raise ValueError(f"satellites={self.satellites}, planes={self.planes}: give a whole number of satellites per plane")
        if not self.semi_major_axis > earth.A:
            raise ValueError(f"semi_major_axis={self.semi_major_axis}: give metres from the centre of the Earth")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"W{i + 1:02d}" for i in range(self.satellites))

    @property
    def motion(self) -> float:
        """Mean motion, rad/s."""
        return math.sqrt(earth.GM / self.semi_major_axis**3)

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        t = time.to(torch.float64).unsqueeze(-1)
        number, slots = torch.arange(self.satellites, dtype=torch.float64, device=t.device), self.satellites // self.planes
        plane, slot = torch.div(number, slots, rounding_mode="floor"), number % slots
        ahead = 360.0 / slots * slot + 360.0 * self.phasing / self.satellites * plane + self.argument_deg
        argument = torch.deg2rad(ahead) + self.motion * t
        node = torch.deg2rad(360.0 / self.planes * plane - self.node_deg) - earth.OMEGA * t
        one, zero = torch.ones_like(argument), torch.zeros_like(argument)
        where = (one * self.semi_major_axis, argument, one * math.radians(self.inclination_deg), node)
        return Elements(*where, zero, one * self.motion, zero, -one * earth.OMEGA).earth_fixed()


def eccentric_anomaly(mean: Tensor, e: Tensor, passes: int = 8) -> tuple[Tensor, Tensor]:
    """E with E - e sin E = mean anomaly, and 1 - e cos E, [...] each; Newton's method, exact to rounding for e below 0.5."""
    anomaly = mean + e * torch.sin(mean)
    for _ in range(passes):
        anomaly = anomaly - (anomaly - e * torch.sin(anomaly) - mean) / (1 - e * torch.cos(anomaly))
    return anomaly, 1 - e * torch.cos(anomaly)


def sagnac(satellite: Tensor, flight_time: Tensor) -> Tensor:
    """Earth-fixed vectors of the instant of transmission [..., 3] in the Earth-fixed axes of reception.

    Args:
        satellite: positions or velocities [..., 3].
        flight_time: [...] s.
    """
    angle = GPS_OMEGA * flight_time
    s, c = torch.sin(angle), torch.cos(angle)
    x, y, z = satellite.unbind(-1)
    return torch.stack([c * x + s * y, c * y - s * x, z.expand_as(c * x)], -1)


class Signal(NamedTuple):
    """What arrives at a receiver, in the Earth-fixed axes of reception.

    Attributes:
        pos, vel: of the satellites at transmission [..., T, S, 3] m, m/s. The range's rate is
            u . (vel - velocity of the receiver), u from receiver to satellite, but for a millionth of itself.
        range: [..., T, S] m.
    """

    pos: Tensor
    vel: Tensor
    range: Tensor

    @property
    def flight_time(self) -> Tensor:
        """[..., T, S] s."""
        return self.range / LIGHT


def transmit(constellation: Constellation, time: Tensor, receiver: Tensor, passes: int = 4) -> Signal:
    """Signals that arrive at times [T] s at Earth-fixed places [..., T, 3] m.

    The satellites are asked once, a typical time of flight earlier, and fall freely over the remaining 0.02 s. [ours]
    """
    place, velocity = constellation.at(time - _TYPICAL_FLIGHT)
    acceleration = _fall(place, velocity)
    flight = torch.full((), _TYPICAL_FLIGHT, dtype=place.dtype, device=place.device)
    for _ in range(passes):
        later = (_TYPICAL_FLIGHT - flight).unsqueeze(-1)
        pos = sagnac(place + (velocity + 0.5 * acceleration * later) * later, flight)
        distance = torch.linalg.vector_norm(pos - receiver.unsqueeze(-2), dim=-1)
        flight = distance / LIGHT
    return Signal(pos, sagnac(velocity + acceleration * later, flight), distance)


def _fall(place: Tensor, velocity: Tensor) -> Tensor:
    """Acceleration in Earth-fixed axes [..., 3] m/s^2 of a satellite of a round Earth."""
    turn = torch.tensor([0.0, 0.0, earth.OMEGA], dtype=place.dtype, device=place.device).expand_as(place)
    pull = earth.GM * place / torch.linalg.vector_norm(place, dim=-1, keepdim=True) ** 3
    return -pull - torch.linalg.cross(turn, 2 * velocity + torch.linalg.cross(turn, place))


def azimuth_elevation(receiver: Tensor, satellite: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth, clockwise from North in [0, 2 pi), and elevation [..., S] in rad.

    Args:
        receiver: latitude, longitude, height [..., 3] rad, rad, m.
        satellite: Earth-fixed [..., S, 3] m.
    """
    sight = satellite - earth.ecef(receiver).unsqueeze(-2)
    east, north, up = (sight @ earth.local_axes(receiver).mT).unbind(-1)
    return torch.atan2(east, north) % (2 * torch.pi), torch.atan2(up, torch.hypot(east, north))
