"""Navigation satellites: orbital motion, nominal constellations, received signals.

Positions and velocities are Earth-fixed [m, m/s], velocities relative to the rotating Earth.
Time is in seconds from the start of the scenario.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.nav import earth

LIGHT = 299792458.0  # m/s
GPS_OMEGA = 7.2921151467e-5  # Earth rate of the ephemerides [rad/s]
_TYPICAL_FLIGHT = 0.075  # s


class Constellation(Protocol):
    """Satellites with computable positions."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the S satellites, for example G05 or E31."""

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and velocities at times [T] s: [T, S, 3] m and m/s.

        NaN marks a satellite without a valid position.
        """


class OrbitalElements(NamedTuple):
    """Positions of satellites in their orbits and the time derivatives, [...] each.

    Attributes:
        radius: Distance from the Earth's centre, m.
        argument: Argument of latitude, rad.
        inclination: Inclination, rad.
        node: Earth-fixed longitude of the ascending node, rad.
        radius1: Derivative of `radius`, m/s.
        argument1: Derivative of `argument`, rad/s.
        inclination1: Derivative of `inclination`, rad/s.
        node1: Derivative of `node`, rad/s.
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
        """Compute position and velocity, [..., 3] each."""
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
class WalkerConstellation(Constellation):
    """Circular orbits in evenly spaced planes, i: T/P/F.

    [Walker 1984, "Satellite constellations"]. The defaults are close to GPS [ours].

    Attributes:
        satellites: Number T.
        planes: Number P.
        phasing: F. Satellites of neighbouring planes are F 360/T degrees apart.
        inclination_deg: Inclination of all planes.
        semi_major_axis: m.
        node_deg: Angle West of Greenwich of the first plane's node at t = 0.
        argument_deg: Argument of latitude of the first satellite at t = 0.

    Raises:
        ValueError: If satellites do not fill the planes, or the orbit is inside the Earth.
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
            raise ValueError(
                f"satellites must be a positive multiple of planes={self.planes}, "
                f"got {self.satellites}. Give the same number for each plane."
            )
        if not self.semi_major_axis > earth.A:
            raise ValueError(
                f"semi_major_axis must be more than the Earth's radius {earth.A} m, "
                f"got {self.semi_major_axis}. Give metres from the centre of the Earth."
            )

    @property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(f"W{i + 1:02d}" for i in range(self.satellites))

    @property
    def motion(self) -> float:
        """Mean motion, rad/s."""
        return math.sqrt(earth.GM / self.semi_major_axis**3)

    @override
    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        t = time.to(torch.float64).unsqueeze(-1)
        number = torch.arange(self.satellites, dtype=torch.float64, device=t.device)
        slots = self.satellites // self.planes
        plane, slot = torch.div(number, slots, rounding_mode="floor"), number % slots
        ahead = (
            360.0 / slots * slot
            + 360.0 * self.phasing / self.satellites * plane
            + self.argument_deg
        )
        argument = torch.deg2rad(ahead) + self.motion * t
        node = torch.deg2rad(360.0 / self.planes * plane - self.node_deg) - earth.OMEGA * t
        ones, zeros = torch.ones_like(argument), torch.zeros_like(argument)
        radius, inclination = ones * self.semi_major_axis, ones * math.radians(self.inclination_deg)
        rates = (zeros, ones * self.motion, zeros, -ones * earth.OMEGA)
        return OrbitalElements(radius, argument, inclination, node, *rates).earth_fixed()


def eccentric_anomaly(mean: Tensor, e: Tensor, passes: int = 8) -> tuple[Tensor, Tensor]:
    """Solve Kepler's equation E - e sin E = M by Newton's method.

    Exact to rounding for e below 0.5.

    Args:
        mean: Mean anomaly M, [...], rad.
        e: Eccentricity, [...].
        passes: Number of iterations.

    Returns:
        E and 1 - e cos E, [...] each.
    """
    anomaly = mean + e * torch.sin(mean)
    for _ in range(passes):
        anomaly = anomaly - (anomaly - e * torch.sin(anomaly) - mean) / (1 - e * torch.cos(anomaly))
    return anomaly, 1 - e * torch.cos(anomaly)


def sagnac(satellite: Tensor, flight_time: Tensor) -> Tensor:
    """Rotate vectors from Earth-fixed axes of transmission to axes of reception.

    Args:
        satellite: Positions or velocities, [..., 3].
        flight_time: Time of flight, [...], s.

    Returns:
        Rotated vectors, [..., 3].
    """
    angle = GPS_OMEGA * flight_time
    s, c = torch.sin(angle), torch.cos(angle)
    x, y, z = satellite.unbind(-1)
    return torch.stack([c * x + s * y, c * y - s * x, z.expand_as(c * x)], -1)


class ReceivedSignal(NamedTuple):
    """Signals at a receiver, in the Earth-fixed axes of reception.

    With u the unit vector from receiver to satellite, the range rate is
    u . (vel - velocity of the receiver), to a relative accuracy of 1e-6.

    Attributes:
        pos: Positions of the satellites at transmission, [..., T, S, 3], m.
        vel: Velocities of the satellites at transmission, [..., T, S, 3], m/s.
        range: [..., T, S], m.
    """

    pos: Tensor
    vel: Tensor
    range: Tensor

    @property
    def flight_time(self) -> Tensor:
        """Time of flight, [..., T, S], s."""
        return self.range / LIGHT


def receive_signals(
    constellation: Constellation, time: Tensor, receiver: Tensor, passes: int = 4
) -> ReceivedSignal:
    """Compute the signals that arrive at given times and positions.

    The constellation is evaluated once, at a typical time of flight before reception. The
    satellites fall freely over the remaining 0.02 s. [ours]

    Args:
        constellation: Satellites.
        time: Times of reception, [T], s.
        receiver: Earth-fixed positions, [..., T, 3], m.
        passes: Number of iterations for the time of flight.

    Returns:
        Signals.
    """
    position, velocity = constellation.at(time - _TYPICAL_FLIGHT)
    acceleration = _fall(position, velocity)
    flight = position.new_tensor(_TYPICAL_FLIGHT)
    for _ in range(passes):
        later = (_TYPICAL_FLIGHT - flight).unsqueeze(-1)
        pos = sagnac(position + (velocity + 0.5 * acceleration * later) * later, flight)
        distance = torch.linalg.vector_norm(pos - receiver.unsqueeze(-2), dim=-1)
        flight = distance / LIGHT
    return ReceivedSignal(pos, sagnac(velocity + acceleration * later, flight), distance)


def _fall(position: Tensor, velocity: Tensor) -> Tensor:
    """Compute free-fall acceleration in Earth-fixed axes [..., 3], spherical Earth."""
    rate = position.new_tensor([0.0, 0.0, earth.OMEGA]).expand_as(position)
    pull = earth.GM * position / torch.linalg.vector_norm(position, dim=-1, keepdim=True) ** 3
    return -pull - torch.linalg.cross(rate, 2 * velocity + torch.linalg.cross(rate, position))


def azimuth_elevation(receiver: Tensor, satellite: Tensor) -> tuple[Tensor, Tensor]:
    """Compute azimuth and elevation of satellites.

    Args:
        receiver: Latitude, longitude, height, [..., 3], rad, rad, m.
        satellite: Earth-fixed positions, [..., S, 3], m.

    Returns:
        Azimuth, clockwise from North in [0, 2 pi), and elevation, [..., S] each, rad.
    """
    sight = satellite - earth.ecef(receiver).unsqueeze(-2)
    east, north, up = (sight @ earth.local_axes(receiver).mT).unbind(-1)
    return torch.atan2(east, north) % (2 * torch.pi), torch.atan2(up, torch.hypot(east, north))
