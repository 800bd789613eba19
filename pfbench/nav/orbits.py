"""Navigation satellites: orbital motion, nominal constellations, lines of sight, range differences without cancellation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.nav import earth

# Positions and velocities are Earth-fixed [m, m/s], velocities relative to the rotating Earth.
# Time is in seconds from the start of the scenario.

LIGHT = 299792458.0  # m/s
GPS_OMEGA = 7.2921151467e-5  # Earth rate of the ephemerides [rad/s]
TYPICAL_FLIGHT = 0.075  # s; from a satellite to a receiver


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
        require(
            not min(self.satellites, self.planes) < 1 and (not self.satellites % self.planes),
            "satellites",
            f"be a positive multiple of planes={self.planes}",
            self.satellites,
            "Give the same number for each plane.",
        )
        require(
            self.semi_major_axis > earth.A,
            "semi_major_axis",
            f"be more than the Earth's radius {earth.A} m",
            self.semi_major_axis,
            "Give metres from the centre of the Earth.",
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

    Returns e and 1 - e cos E, [...] each. Shapes: mean [...], e [...].
    """
    anomaly = mean + e * torch.sin(mean)
    for _ in range(passes):
        anomaly = anomaly - (anomaly - e * torch.sin(anomaly) - mean) / (1 - e * torch.cos(anomaly))
    return anomaly, 1 - e * torch.cos(anomaly)


def sagnac(satellite: Tensor, flight_time: Tensor) -> Tensor:
    """Rotate vectors from Earth-fixed axes of transmission to axes of reception.

    Returns rotated vectors, [..., 3]. Shapes: satellite [..., 3], flight_time [...].
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

    Shapes: time [T], receiver [..., T, 3].
    """
    position, velocity = constellation.at(time - TYPICAL_FLIGHT)
    acceleration = free_fall(position, velocity)
    flight = position.new_tensor(TYPICAL_FLIGHT)
    for _ in range(passes):
        later = (TYPICAL_FLIGHT - flight).unsqueeze(-1)
        pos = sagnac(position + (velocity + 0.5 * acceleration * later) * later, flight)
        distance = torch.linalg.vector_norm(pos - receiver.unsqueeze(-2), dim=-1)
        flight = distance / LIGHT
    return ReceivedSignal(pos, sagnac(velocity + acceleration * later, flight), distance)


def free_fall(position: Tensor, velocity: Tensor) -> Tensor:
    """Compute free-fall acceleration in Earth-fixed axes [..., 3], spherical Earth."""
    rate = position.new_tensor([0.0, 0.0, earth.OMEGA]).expand_as(position)
    pull = earth.GM * position / torch.linalg.vector_norm(position, dim=-1, keepdim=True) ** 3
    return -pull - torch.linalg.cross(rate, 2 * velocity + torch.linalg.cross(rate, position))


def azimuth_elevation(receiver: Tensor, satellite: Tensor) -> tuple[Tensor, Tensor]:
    """Compute azimuth and elevation of satellites.

    Returns azimuth, clockwise from North in [0, 2 pi), and elevation, [..., S] each, rad. Shapes:
    receiver [..., 3], satellite [..., S, 3].
    """
    sight = satellite - earth.ecef(receiver).unsqueeze(-2)
    east, north, up = (sight @ earth.local_axes(receiver).mT).unbind(-1)
    return torch.atan2(east, north) % (2 * torch.pi), torch.atan2(up, torch.hypot(east, north))


# Ranges are 2e7 m and their errors are metres, so the difference of two ranges loses seven
# digits. `SatelliteGeometry` expands exactly about the INS position, which also suits float32.


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

        Returns differences of range and rate, [R, N, S] each, m and m/s. Shapes: dp [R, N, 3], dv
        [R, N, 3].
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

    Shapes: pos [..., 3], vel [..., 3], satellite [..., S, 3], satellite_vel [..., S, 3].
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

    Returns position and velocity, [..., 3] each, m and m/s. Shapes: pos [..., 3], vel [..., 3].
    """
    return earth.ecef(pos), (earth.local_axes(pos).mT @ vel.unsqueeze(-1)).squeeze(-1)
