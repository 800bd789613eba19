"""Trajectories from manoeuvres, and what ideal inertial sensors report along them.

Three scalar profiles define the motion: speed, climb (flight-path) angle, heading. A segment changes each of them by a
given amount: speed linearly (or smoothly), the angles by the quintic u^3 (10 - 15 u + 6 u^2), so that angular rate and angular
acceleration are continuous and vanish at the joints. Roll follows from coordinated turns. Everything is closed form or
Gauss-Legendre quadrature, vectorised over time [ours].

Manoeuvres speak degrees where their argument names say so, because they are written in yaml; a Segment is in SI and
radians.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor

from pfbench.nav import attitude, earth

G_TURN = 9.80665  # gravity of the coordinated turn [m/s^2]: fixed, so that the bank does not depend on the place
NODES = torch.tensor([0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6)], dtype=torch.float64)
_WEIGHTS = torch.tensor([5.0, 8.0, 5.0], dtype=torch.float64) / 18


@dataclass(frozen=True)
class Segment:
    """A stretch of motion and what changes along it.

    Args:
        duration: s.
        speed: change of speed, m/s.
        climb: change of flight-path angle, rad.
        heading: change of heading (clockwise from North), rad.
        smooth: let the speed change by the quintic too, without a step in acceleration; linear in time otherwise.

    Raises:
        ValueError: duration not positive.
    """

    duration: float
    speed: float = 0.0
    climb: float = 0.0
    heading: float = 0.0
    smooth: bool = False

    def __post_init__(self) -> None:
        if not self.duration > 0:
            raise ValueError(f"duration={self.duration}: give every segment a positive number of seconds")


Manoeuvre: TypeAlias = tuple[Segment, ...]


@dataclass(frozen=True)
class Start:
    """Where and how a trajectory begins: degrees, metres, m/s; heading clockwise from North."""

    lat_deg: float
    lon_deg: float
    height: float
    speed: float = 0.0
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        if not -89.0 <= self.lat_deg <= 89.0:
            raise ValueError(f"lat_deg={self.lat_deg}: East and North lose their meaning near a pole; stay within +-89")


class Flight(NamedTuple):
    """The truth and the ideal sensors; n samples.

    Attributes:
        time: [n + 1] s.
        pos: latitude, longitude, height [n + 1, 3] rad, rad, m.
        vel: East, North, Up [n + 1, 3] m/s.
        dcm: body to level [n + 1, 3, 3].
        dtheta: angle increments of ideal gyros, body axes, from time k to k + 1 [n, 3] rad.
        dv: velocity increments of ideal accelerometers [n, 3] m/s.
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor
    dtheta: Tensor
    dv: Tensor


def accelerate(acceleration: float, duration: float, smooth: bool = False) -> Manoeuvre:
    """Acceleration along the track, m/s^2, negative to brake: constant, or of this mean and without steps where `smooth`."""
    return (Segment(duration, speed=acceleration * duration, smooth=smooth),)


def cruise(duration: float) -> Manoeuvre:
    """Straight on at the present speed and climb angle."""
    return (Segment(duration),)


def climb(angle_deg: float, pitch_duration: float, hold_duration: float) -> Manoeuvre:
    """Pitch to a climb angle, hold it, pitch back; a negative angle descends."""
    angle = math.radians(angle_deg)
    return (Segment(pitch_duration, climb=angle), Segment(hold_duration), Segment(pitch_duration, climb=-angle))


def turn(angle_deg: float, duration: float) -> Manoeuvre:
    """Coordinated turn; a positive angle turns right."""
    return (Segment(duration, heading=math.radians(angle_deg)),)


def fly(segments: Iterable[Segment | Iterable[Segment]], start: Start, rate: float) -> Flight:
    """Fly the segments one after the other.

    Args:
        segments: manoeuvres (tuples of segments) and single segments, in order.
        start: initial position, speed and heading; the climb angle starts at 0.
        rate: samples per second.

    Returns:
        Truth and ideal increments, float64.

    Raises:
        ValueError: no segment; a segment does not last a whole number of samples; speed would become negative.
    """
    plan = [s for part in segments for s in ([part] if isinstance(part, Segment) else part)]
    counts = _sample_counts(plan, rate)
    at_samples = _profile(plan, counts, start, rate, torch.zeros(1, dtype=torch.float64))
    last = _profile(plan[-1:], counts[-1:], _reached(plan[:-1], start), rate, torch.ones(1, dtype=torch.float64))
    samples = Motion(*(torch.cat([a[:, 0], b[-1:, 0]]) for a, b in zip(at_samples, last, strict=True)))
    return follow(samples, _profile(plan, counts, start, rate, NODES), start, rate)


class Motion(NamedTuple):
    """Speed, climb angle, heading (m/s, rad) and their time derivatives on some grid of instants."""

    speed: Tensor
    speed1: Tensor
    climb: Tensor
    climb1: Tensor
    heading: Tensor
    heading1: Tensor
    heading2: Tensor


class Path(Protocol):
    """A motion that can be sampled at any rate."""

    def fly(self, rate: float) -> Flight:
        """Truth and ideal sensors at `rate` samples per second."""


@dataclass(frozen=True)
class Manoeuvres:
    """Segments flown one after the other; see `fly`."""

    segments: Sequence[Any]
    start: Start

    def fly(self, rate: float) -> Flight:
        return fly(self.segments, self.start, rate)


@dataclass(frozen=True)
class Cosine:
    """A change between two times by half a cosine, 1/2 - 1/2 cos(pi u): its rate is continuous, its second derivative jumps.

    Args: begin, end: s; change: in the unit of what changes.
    """

    begin: float
    end: float
    change: float

    def __post_init__(self) -> None:
        _check_order(self)

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value and two time derivatives."""
        k = math.pi / (self.end - self.begin)
        a = k * (t.clamp(self.begin, self.end) - self.begin)
        inside = ((t > self.begin) & (t < self.end)).to(t)
        c = 0.5 * self.change
        return c * (1 - torch.cos(a)), c * k * torch.sin(a) * inside, c * k * k * torch.cos(a) * inside


@dataclass(frozen=True)
class Cycloid:
    """A change whose rate is one period of a raised cosine, u - sin(2 pi u) / 2 pi: two continuous derivatives.

    Args: begin, end: s; change: in the unit of what changes.
    """

    begin: float
    end: float
    change: float

    def __post_init__(self) -> None:
        _check_order(self)

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Value and two time derivatives."""
        length = self.end - self.begin
        u = (t.clamp(self.begin, self.end) - self.begin) / length
        turn = 2 * math.pi * u
        value = self.change * (u - torch.sin(turn) / (2 * math.pi))
        rate = self.change / length * (1 - torch.cos(turn))
        return value, rate, self.change * 2 * math.pi / length**2 * torch.sin(turn)


@dataclass(frozen=True)
class Ramps:
    """A motion whose speed, angles and climb rate are sums of ramps (Cosine or Cycloid).

    Args:
        start: initial position, speed, heading.
        duration: s.
        speed: changes of speed m/s; of the horizontal speed where `rise` is given.
        climb_deg: changes of the flight-path angle; not together with `rise`.
        heading_deg: changes of heading, clockwise.
        rise: changes of the vertical speed m/s.

    Raises:
        ValueError: `climb_deg` and `rise` together; on flying, a negative speed, a duration of no whole number of samples, or a
            Cosine that begins or ends between two of them.
    """

    start: Start
    duration: float
    speed: Sequence[Cosine | Cycloid] = ()
    climb_deg: Sequence[Cosine | Cycloid] = ()
    heading_deg: Sequence[Cosine | Cycloid] = ()
    rise: Sequence[Cosine | Cycloid] = ()

    def __post_init__(self) -> None:
        if self.climb_deg and self.rise:
            raise ValueError("path.climb_deg and path.rise both say how steeply to climb: give one of them")

    def fly(self, rate: float) -> Flight:
        n = round(self.duration * rate)
        if n < 1 or abs(n - self.duration * rate) > 1e-6:
            raise ValueError(f"path.duration={self.duration}: at rate={rate} that is no whole number of samples")
        for ramp in (*self.speed, *self.climb_deg, *self.heading_deg, *self.rise):
            if isinstance(ramp, Cosine):
                _check_on_samples(ramp, self.duration, rate)
        at = torch.arange(n + 1, dtype=torch.float64)
        return follow(self.motion(at / rate), self.motion((at[:-1, None] + NODES) / rate), self.start, rate)

    def motion(self, t: Tensor) -> Motion:
        """The motion at times t s."""
        speed, speed1, _ = _total(self.speed, t, self.start.speed)
        heading, heading1, heading2 = _total(self.heading_deg, t, self.start.heading_deg)
        turned = (torch.deg2rad(a) for a in (heading, heading1, heading2))
        if not self.rise:
            climb, climb1, _ = _total(self.climb_deg, t, 0.0)
            return Motion(speed, speed1, torch.deg2rad(climb), torch.deg2rad(climb1), *turned)
        if speed.min() < 0:  # not seen in the length of the velocity
            raise ValueError(f"horizontal speed falls to {speed.min():.3f} m/s: brake less, or start faster")
        up, up1, _ = _total(self.rise, t, 0.0)
        along = torch.hypot(speed, up)
        safe = along.clamp(min=1e-9)
        along1, steepen = (speed * speed1 + up * up1) / safe, (speed * up1 - up * speed1) / safe.square()
        return Motion(along, torch.where(along > 0, along1, speed1), torch.atan2(up, speed), steepen, *turned)


def _check_order(ramp: Cosine | Cycloid) -> None:
    if not ramp.end > ramp.begin:
        raise ValueError(f"begin={ramp.begin}, end={ramp.end}: a ramp must end after it begins")


def _check_on_samples(ramp: Cosine, duration: float, rate: float) -> None:
    for name, time in (("begin", ramp.begin), ("end", ramp.end)):
        samples = time * rate
        # the jump of its second derivative, a jump of the roll rate, would be integrated wrongly inside a sample
        if 0 < time < duration and abs(samples - round(samples)) > 1e-6:
            raise ValueError(
                f"a Cosine's {name}={time} lies between two samples at rate={rate}: make it a multiple of {1 / rate:.6g} s, "
                "or use a Cycloid"
            )


def _total(ramps: Sequence[Cosine | Cycloid], t: Tensor, start: float) -> tuple[Tensor, Tensor, Tensor]:
    """Sum of ramps from a start value, and its derivatives."""
    value, rate, second = torch.full_like(t, start), torch.zeros_like(t), torch.zeros_like(t)
    for ramp in ramps:
        parts = ramp.at(t)
        value, rate, second = value + parts[0], rate + parts[1], second + parts[2]
    return value, rate, second


def follow(samples: Motion, nodes: Motion, start: Start, rate: float) -> Flight:
    """The flight with this motion at its n + 1 samples and, `NODES` of the way from each to the next, at n x 3 nodes.

    Raises:
        ValueError: speed becomes negative.
    """
    if samples.speed.min() < 0:
        raise ValueError(f"speed falls to {samples.speed.min():.3f} m/s: brake less, or start faster")
    pos, node_pos = _positions(samples, nodes, start, 1 / rate)
    w, f = _sensed(nodes, node_pos)
    weights = _WEIGHTS[:, None] / rate
    time = torch.arange(len(samples.speed), dtype=torch.float64) / rate
    dcm = attitude.dcm_from_euler(_euler(samples))
    return Flight(time, pos, _velocity(samples), dcm, (weights * w).sum(1), (weights * f).sum(1))


class _Reached(NamedTuple):
    """Speed, climb angle and heading (rad) at the start of a segment."""

    speed: float
    climb: float
    heading: float


def _sample_counts(plan: list[Segment], rate: float) -> list[int]:
    if not plan:
        raise ValueError("segments is empty: give at least one manoeuvre")
    for k, segment in enumerate(plan):
        samples = segment.duration * rate
        # a step of acceleration inside a sample would be integrated wrongly, and without a word
        if abs(samples - round(samples)) > 1e-6 or round(samples) < 1:
            raise ValueError(
                f"segment {k} lasts {segment.duration} s, {samples:.4f} samples at rate={rate}: "
                f"make every duration a whole number of samples of {1 / rate:.6g} s"
            )
    return [round(segment.duration * rate) for segment in plan]


def _reached(plan: list[Segment], start: Start | _Reached) -> _Reached:
    if isinstance(start, Start):
        start = _Reached(start.speed, 0.0, math.radians(start.heading_deg))
    return _Reached(
        start.speed + math.fsum(s.speed for s in plan),
        start.climb + math.fsum(s.climb for s in plan),
        start.heading + math.fsum(s.heading for s in plan),
    )


def _profile(plan: list[Segment], counts: list[int], start: Start | _Reached, rate: float, offsets: Tensor) -> Motion:
    """The motion at every sample plus `offsets` [m] of a sample: tensors [n, m]."""
    rows = []
    for k, (segment, count) in enumerate(zip(plan, counts, strict=True)):
        begin = _reached(plan[:k], start)
        length = count / rate
        u = (torch.arange(count, dtype=torch.float64)[:, None] + offsets) / count
        s = u**3 * (10 - 15 * u + 6 * u**2)
        s1 = 30 * u**2 * (1 - u) ** 2 / length
        s2 = 60 * u * (1 - u) * (1 - 2 * u) / length**2
        v, v1 = (s, s1) if segment.smooth else (u, torch.full_like(u, 1 / length))
        speed = (begin.speed + segment.speed * v, segment.speed * v1)
        angles = (begin.climb + segment.climb * s, segment.climb * s1)
        rows.append((*speed, *angles, begin.heading + segment.heading * s, segment.heading * s1, segment.heading * s2))
    return Motion(*(torch.cat(column) for column in zip(*rows, strict=True)))


def _velocity(m: Motion) -> Tensor:
    """East, North, Up [..., 3]."""
    level, up = m.speed * torch.cos(m.climb), m.speed * torch.sin(m.climb)
    return torch.stack([level * torch.sin(m.heading), level * torch.cos(m.heading), up], dim=-1)


def _acceleration(m: Motion) -> Tensor:
    """Time derivative of the velocity's components [..., 3]."""
    sg, cg, sc, cc = torch.sin(m.climb), torch.cos(m.climb), torch.sin(m.heading), torch.cos(m.heading)
    along, across = m.speed1 * cg - m.speed * sg * m.climb1, m.speed * cg * m.heading1
    up = m.speed1 * sg + m.speed * cg * m.climb1
    return torch.stack([along * sc + across * cc, along * cc - across * sc, up], dim=-1)


def _bank(m: Motion) -> Tensor:
    return m.speed * torch.cos(m.climb) * m.heading1 / G_TURN


def _euler(m: Motion) -> Tensor:
    return torch.stack([m.climb, torch.atan(_bank(m)), -m.heading], dim=-1)


def _body_rate(m: Motion) -> Tensor:
    """Rate of the body against the level frame, body axes [..., 3]."""
    bank = _bank(m)
    roll, sg, cg = torch.atan(bank), torch.sin(m.climb), torch.cos(m.climb)
    bank1 = ((m.speed1 * cg - m.speed * sg * m.climb1) * m.heading1 + m.speed * cg * m.heading2) / G_TURN
    roll1, yaw1 = bank1 / (1 + bank**2), -m.heading1
    x = torch.cos(roll) * m.climb1 - torch.sin(roll) * cg * yaw1
    z = torch.sin(roll) * m.climb1 + torch.cos(roll) * cg * yaw1
    return torch.stack([x, roll1 + sg * yaw1, z], dim=-1)


def _positions(samples: Motion, nodes: Motion, start: Start, d: float) -> tuple[Tensor, Tensor]:
    """Positions at the samples [n + 1, 3] and at the quadrature nodes [n, 3, 3]."""
    v, node_v = _velocity(samples), _velocity(nodes)

    def integral(rate_at_nodes: Tensor, begin: float) -> Tensor:
        steps = (rate_at_nodes * _WEIGHTS).sum(-1) * d
        return torch.cat([torch.tensor([begin], dtype=torch.float64), begin + torch.cumsum(steps, 0)])

    h = integral(node_v[..., 2], start.height)
    node_h = _hermite(h, v[:, 2], d)
    lat = torch.full_like(h, math.radians(start.lat_deg))
    node_lat = lat[0].expand_as(node_h)
    for _ in range(4):  # Picard: each pass gains the factor (distance / Earth radius)
        lat = integral(node_v[..., 1] / (earth.radii(node_lat)[0] + node_h), math.radians(start.lat_deg))
        node_lat = _hermite(lat, v[:, 1] / (earth.radii(lat)[0] + h), d)

    def lon_rate(lat: Tensor, h: Tensor, east: Tensor) -> Tensor:
        return east / ((earth.radii(lat)[1] + h) * torch.cos(lat))

    lon = integral(lon_rate(node_lat, node_h, node_v[..., 0]), math.radians(start.lon_deg))
    node_lon = _hermite(lon, lon_rate(lat, h, v[:, 0]), d)
    return torch.stack([lat, lon, h], dim=-1), torch.stack([node_lat, node_lon, node_h], dim=-1)


def _hermite(y: Tensor, y1: Tensor, d: float) -> Tensor:
    """Cubic through samples [n + 1] and their derivatives, at the quadrature nodes [n, 3]."""
    u, (a, b) = NODES, (y[:-1, None], y[1:, None])
    return a + (b - a) * u**2 * (3 - 2 * u) + d * u * (1 - u) * ((1 - u) * y1[:-1, None] - u * y1[1:, None])


def _sensed(m: Motion, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Angular rate and specific force, body axes [n, 3 nodes, 3 axes]: strapdown equations solved for the sensors."""
    v, lat, h = _velocity(m), pos[..., 0], pos[..., 2]
    to_body = attitude.dcm_from_euler(_euler(m)).transpose(-1, -2)
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, v)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    f = _acceleration(m) + torch.linalg.cross(2 * w_ie + w_en, v) + earth.gravity(lat, h)[..., None] * up
    w = _body_rate(m) + (to_body @ (w_ie + w_en)[..., None]).squeeze(-1)
    return w, (to_body @ f[..., None]).squeeze(-1)
