"""A GNSS receiver that aids an INS by ranges: pseudorange and range rate to each satellite, and the clock behind them.

A filter compares what the INS expects with what the receiver measures. Ranges are 2e7 m and their errors metres, so the
difference of two of them loses seven digits; `Sight` expands exactly about the INS's place instead, and serves float32.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.nav import earth
from pfbench.nav.aiding import Aided, Flown
from pfbench.nav.orbits import Constellation, azimuth_elevation, transmit
from pfbench.nav.strapdown import Intervals
from pfbench.record import Channels


@dataclass(frozen=True)
class Clock:
    """A receiver's clock in metres: bias b' = d + white noise, drift d' = white noise [Brown and Hwang 2012, section 9.3].

    Args:
        bias_sd: initial bias, one sigma, m.
        drift_sd: initial drift, m/s.
        bias_walk: root density of the bias's own noise, m/sqrt(s).
        drift_walk: of the drift's, (m/s)/sqrt(s).

    Raises:
        ValueError: a size that is not positive.
    """

    bias_sd: float = 30.0
    drift_sd: float = 1.0
    bias_walk: float = 0.3
    drift_walk: float = 0.03

    def __post_init__(self) -> None:
        for part in fields(self):
            if not getattr(self, part.name) > 0.0:
                raise ValueError(f"receiver.clock.{part.name}={getattr(self, part.name)}: give a positive number")

    def gain(self, duration: Tensor) -> Tensor:
        """Lower triangular root of the noise of (bias, drift) over durations [...] s: [..., 2, 2]."""
        q_b, q_d = self.bias_walk**2, self.drift_walk**2
        bias = torch.sqrt(q_b * duration + q_d * duration**3 / 3)
        cross = torch.where(bias > 0, 0.5 * q_d * duration**2 / torch.where(bias > 0, bias, 1.0), 0.0)
        drift = torch.sqrt((q_d * duration - cross**2).clamp(min=0))
        return torch.stack([bias, torch.zeros_like(bias), cross, drift], -1).unflatten(-1, (2, 2))

    def run(self, duration: Tensor, process: Tensor, draws: Draws) -> Tensor:
        """Bias and drift at the ends of intervals [R, T, 2], exact at any duration.

        Args:
            duration: of the intervals [T] s.
            process: factor on the variance of the noise [T].
            draws: decides the runs; purposes "world.clock*".
        """
        start = draws.normal("world.clock.start", 1, 2)
        noise = draws.normal("world.clock", len(duration), 2).unsqueeze(-1)
        noise = (self.gain(duration) @ noise).squeeze(-1) * process.sqrt()[:, None]
        drift = self.drift_sd * start[..., 1] + torch.cumsum(noise[..., 1], -1)
        before = torch.cat([self.drift_sd * start[..., 1], drift[:, :-1]], -1)
        bias = self.bias_sd * start[..., 0] + torch.cumsum(before * duration + noise[..., 0], -1)
        return torch.stack([bias, drift], -1)


class Tracked(NamedTuple):
    """Inputs of a tightly coupled filter: the INS's intervals, as `strapdown.Intervals`, and the satellites at their ends.

    Attributes:
        dcm, dcm_end, pos, pos_start, pos_end, vel, vel_end, w_in, f, duration: see `strapdown.Intervals`.
        satellite: Earth-fixed positions of S satellites [1, T, S, 3] m; one that is not known is put at the Earth's centre.
        satellite_vel: velocities [1, T, S, 3] m/s.
    """

    dcm: Tensor
    dcm_end: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    vel: Tensor
    vel_end: Tensor
    w_in: Tensor
    f: Tensor
    duration: Tensor
    satellite: Tensor
    satellite_vel: Tensor

    @property
    def intervals(self) -> Intervals:
        """The INS's own part."""
        return Intervals(*self[: len(Intervals._fields)])

    @property
    def sight(self) -> Sight:
        """What the INS expects to see at the end of each interval."""
        return look(self.pos_end, self.vel_end, self.satellite, self.satellite_vel)


@dataclass(frozen=True)
class TightReceiver:
    """A receiver that gives pseudorange and range rate to every satellite above a mask, and has a clock.

    Measurements are INS minus receiver: r(INS) - (r(truth) + b) for each satellite, then the rates likewise with d; NaN for a
    satellite below the mask, so satellites come and go. Atmosphere, ephemeris errors and satellites' clocks are left out: in a
    simulation, what both sides know cancels. [ours]

    Args:
        constellation: the satellites.
        pseudorange_sd: one sigma, m.
        rate_sd: m/s.
        clock: the receiver's.
        mask_deg: smallest elevation.
        satellites: names of those with a channel; None is all of the constellation.
        sagnac: signals take their time: satellites are where they transmitted, in the Earth-fixed axes of reception; else
            they are seen at once.

    Raises:
        ValueError: a size that is not positive, a mask outside [-90, 90], an unknown satellite.
    """

    constellation: Constellation
    pseudorange_sd: float = 10.0
    rate_sd: float = 0.1
    clock: Clock = Clock()
    mask_deg: float = 10.0
    satellites: Sequence[str] | None = None
    sagnac: bool = False

    def __post_init__(self) -> None:
        for name, size in (("pseudorange_sd", self.pseudorange_sd), ("rate_sd", self.rate_sd)):
            if not size > 0.0:
                raise ValueError(f"receiver.{name}={size}: give a positive standard deviation")
        if not -90.0 <= self.mask_deg <= 90.0:
            raise ValueError(f"receiver.mask_deg={self.mask_deg}: give an elevation between -90 and 90 degrees")
        if self.satellites is not None and (not self.satellites or len(set(self.satellites)) < len(self.satellites)):
            raise ValueError(f"receiver.satellites={list(self.satellites)}: give each satellite once, or null for all of them")

    @property
    def names(self) -> tuple[str, ...]:
        """Satellites with a channel, S of them."""
        return self.constellation.names if self.satellites is None else tuple(self.satellites)

    @property
    def sd(self) -> Tensor:
        """Of the measurement vector: S ranges, then S rates [2 S]."""
        count = len(self.names)
        return torch.tensor([self.pseudorange_sd] * count + [self.rate_sd] * count, dtype=torch.float64)

    @property
    def channels(self) -> Channels:
        count = len(self.names)
        return Channels(self.sd, ("range",) * count + ("rate",) * count, tuple(range(count)) * 2)

    def aid(self, flown: Flown, draws: Draws, process: Tensor) -> Aided:
        """INS minus receiver."""
        place, motion = _earth_fixed(flown.pos, flown.vel)
        satellite, velocity = self._satellites(flown.time, place)
        duration = flown.ins.duration[0]
        clock = self.clock.run(duration, process, draws)
        seen = _ranges(place, motion, satellite, velocity)
        expected = _ranges(*_earth_fixed(flown.ins.pos_end, flown.ins.vel_end), satellite, velocity)
        differences = [e - s - c.unsqueeze(-1) for e, s, c in zip(expected, seen, clock.unbind(-1), strict=True)]
        azimuth, elevation = azimuth_elevation(flown.pos, satellite)
        hidden = ~(elevation >= math.radians(self.mask_deg))
        y = torch.where(hidden.repeat(1, 2), torch.nan, torch.cat(differences, -1))
        known = (torch.nan_to_num(a).unsqueeze(0) for a in (satellite, velocity))
        sky = {name: torch.where(elevation >= 0, a, torch.nan) for name, a in (("azimuth", azimuth), ("elevation", elevation))}
        return Aided(y, Tracked(*flown.ins, *known), {"clock": clock}, sky)

    def _satellites(self, time: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities [T, S, 3] of the satellites with a channel, for a receiver at places [T, 3]."""
        names = self.constellation.names
        unknown = sorted(set(self.names) - set(names))
        if unknown:
            raise ValueError(f"receiver.satellites: no {', '.join(unknown)} among {', '.join(names)}")
        if self.sagnac:
            signal = transmit(self.constellation, time, place)
            both = signal.pos, signal.vel
        else:
            both = self.constellation.at(time)
        chosen = [names.index(name) for name in self.names]
        return both[0][:, chosen], both[1][:, chosen]


class Sight(NamedTuple):
    """What the INS expects to see, in Earth-fixed axes turned to its own meridian: off the axis, East, along the axis.

    Attributes:
        sine, cosine: of the latitude [...].
        height: m [...].
        vel: of the INS, East, North, Up [..., 3] m/s.
        distance: of the satellites [..., S] m.
        line: unit vectors from the satellites to the INS [..., S, 3].
        closing: velocity of the INS against the satellites [..., S, 3] m/s.
    """

    sine: Tensor
    cosine: Tensor
    height: Tensor
    vel: Tensor
    distance: Tensor
    line: Tensor
    closing: Tensor

    def differences(self, dp: Tensor, dv: Tensor) -> tuple[Tensor, Tensor]:
        """Range and rate at the INS minus those at the truth, clock left out: [R, N, S] m, m/s.

        Exact, and without the cancellation of two ranges: with e, r, w the line, distance and closing velocity, D and V truth
        minus INS in place and velocity, the truth's range exceeds by g = r s / (1 + sqrt(1 + s)), s = (2 e.D + |D|^2 / r) / r.

        Args:
            dp: position errors North, East, Up [R, N, 3] m, INS minus truth, in metres at the true place.
            dv: velocity errors East, North, Up [R, N, 3] m/s.
        """
        place, motion = self._displaced(dp, dv)
        r, e, w = self.distance.unsqueeze(-1), self.line, self.closing
        length, faster = ((place * a).sum(-1, keepdim=True) for a in (place, motion))
        twice = _product(torch.cat([place, length], -1), torch.cat([2 * e, 1 / r], -1))  # r s
        root = torch.sqrt(1 - _product(torch.cat([place, length], -1), torch.cat([-2 * e, -1 / r], -1) / r))
        g = twice / (1 - -root)
        turning = _product(torch.cat([place, motion, faster], -1), torch.cat([w / r, e, 1 / r], -1))
        return -g, (g * ((e * w).sum(-1) / self.distance).unsqueeze(-2) - turning) / root

    def _displaced(self, dp: Tensor, dv: Tensor) -> tuple[Tensor, Tensor]:
        """Truth minus INS, in the meridian's axes: place [R, N, 3] m and velocity [R, N, 3] m/s."""
        w = 1 - earth.E2 * self.sine**2
        across = earth.A / torch.sqrt(w)
        inside = (1 - earth.E2) * across
        known = [self.sine, self.cosine, 2 * self.sine, self.height, across, inside, inside / w, earth.E2 / w]
        constants = torch.cat([torch.stack(known, -1), self.vel], -1).unsqueeze(-2)
        # with forward-mode tangents of their own, even zero, constants cost a hundredth; numbers have none, so few stand below
        s, c, twice_s, h, r_n, r_p, r_m, flat, v_e, v_n, v_u = (constants + (dp[..., :1] - dp[..., :1])).unbind(-1)
        (north, east, up), (dv_e, dv_n, dv_u) = dp.unbind(-1), dv.unbind(-1)
        h_t, radius = h - up, r_m
        for _ in range(2):  # the meridian's radius is that of the true place
            sine, less = _turn(-north / (radius + h_t))
            ds, dc = c * sine - s * less, -s * sine - c * less
            u = flat * ds * (twice_s + ds)
            t = torch.sqrt(1 - u)  # R_N goes with 1 / t, R_M with its cube
            radius = r_m / (t * t * t)
        grown = u / (t + t * t)
        s_t, c_t, wider = s + ds, c + dc, r_n * grown
        parallel = (r_n + wider + h_t) * c_t
        sine, less = _turn(-east / parallel)
        outwards = (r_n + h) * dc + (wider - up) * c_t - parallel * less
        along = (r_p + h) * ds + (r_p * grown - up) * s_t
        fall = dc * v_u - ds * v_n + s_t * dv_n - c_t * dv_u  # of the velocity away from the axis
        off, east_t = c * v_u - s * v_n + fall, v_e - dv_e
        rise = dc * v_n + ds * v_u - c_t * dv_n - s_t * dv_u
        motion = [fall - less * off - sine * east_t, sine * off - dv_e - less * east_t, rise]
        return torch.stack([outwards, parallel * sine, along], -1), torch.stack(motion, -1)


def _turn(angle: Tensor) -> tuple[Tensor, Tensor]:
    """sin a, and 1 - cos a without cancellation."""
    sine = torch.sin(angle)
    return sine, sine * sine / (1 - -torch.cos(angle))


def _product(a: Tensor, b: Tensor) -> Tensor:
    """a [R, N, k] with b [R or 1, S, k]: [R, N, S]; `matmul` takes twenty times as long in forward-mode differentiation."""
    return torch.bmm(a, b.mT.expand(a.shape[0], -1, -1))


def look(pos: Tensor, vel: Tensor, satellite: Tensor, satellite_vel: Tensor) -> Sight:
    """What is expected at places pos [..., 3] rad, rad, m and velocities [..., 3] of satellites [..., S, 3], all float64."""
    place, motion = _earth_fixed(pos, vel)
    towards, against = place.unsqueeze(-2) - satellite, motion.unsqueeze(-2) - satellite_vel
    distance = torch.linalg.vector_norm(towards, dim=-1)
    sine, cosine = torch.sin(pos[..., 1]), torch.cos(pos[..., 1])

    def turned(a: Tensor) -> Tensor:
        x, y, z = a.unbind(-1)
        so, co = sine.unsqueeze(-1), cosine.unsqueeze(-1)
        return torch.stack([co * x + so * y, co * y - so * x, z], -1)

    line = turned(towards / distance.unsqueeze(-1))
    return Sight(torch.sin(pos[..., 0]), torch.cos(pos[..., 0]), pos[..., 2], vel, distance, line, turned(against))


def _earth_fixed(pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor]:
    """Position and velocity [..., 3] in Earth-fixed axes."""
    return earth.ecef(pos), (earth.local_axes(pos).mT @ vel.unsqueeze(-1)).squeeze(-1)


def _ranges(place: Tensor, motion: Tensor, satellite: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Ranges and rates [..., S] between a receiver [..., 3] and satellites [..., S, 3]."""
    towards = place.unsqueeze(-2) - satellite
    distance = torch.linalg.vector_norm(towards, dim=-1)
    return distance, (towards * (motion.unsqueeze(-2) - velocity)).sum(-1) / distance
