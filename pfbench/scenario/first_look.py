"""How a filter that listens starts: the law of an emitter given the first look at it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from pfbench.model.passive_location import SPEED_OF_LIGHT, Platform, look, relative

_COARSE = 2000  # ranges among which the likely ones are sought: 20 m apart at 10 km, where an elevation tells 80 m
_RUNS = 25  # at a time
_UNLIKELY = 20.0  # log likelihood below the highest at which a range is left out


class Look(NamedTuple):
    """A first look and what is known beside it.

    Attributes:
        z: bearing, elevation, their rates, Doppler rate [R, 5].
        own: the aircraft as it is given at that time [R or 1, ...].
        sd: of the measurement [5].
        velocity_sd: of the emitter's velocity about 0, m/s per axis.
        limits: of its range, m.
    """

    z: Tensor
    own: Platform
    sd: Tensor
    velocity_sd: float
    limits: tuple[float, float]


class Start(Protocol):
    """A law of [x, y, vx, vy] in the ground frame."""

    def law(self, first: Look) -> tuple[Tensor, Tensor, str]:
        """Mean [R, 4], Cholesky factor of the covariance [R, 4, 4], and what is worth saying of them."""


@dataclass(frozen=True)
class FirstFix:
    """The printed start: the range that the look gives, and its deviation to first order; see `first_fix`."""

    def law(self, first: Look) -> tuple[Tensor, Tensor, str]:
        """See `Start`."""
        start, spread, clipped = first_fix(*first)
        return start, spread, f"range of the first look clipped in {int(clipped.sum())} of {len(clipped)} runs"


@dataclass(frozen=True)
class Moments:
    """Mean and covariance of the emitter given the first look, by quadrature [ours].

    Before the look all horizontal ranges between the limits are as likely, so are all bearings, and the velocity is normal about
    0. What the printed start leaves out counts here: the elevation, which tells the range of an emitter on the ground; the
    emitter's own velocity, which the rates cannot be told from; and that the range's law is not normal, of which the first two
    moments are taken as they are and not at the look. If emitters are drawn from that law, then the normalised error of the
    start is 1 per degree of freedom on average, whatever its shape.

    Args:
        ranges, bearings, velocities: nodes; bearings and each component of the velocity by Gauss and Hermite.
    """

    ranges: int = 120
    bearings: int = 5
    velocities: int = 5

    def law(self, first: Look) -> tuple[Tensor, Tensor, str]:
        """See `Start`; some runs at a time, since a run's nodes are many."""
        own = Platform(*(part.expand(len(first.z), *part.shape[1:]) for part in first.own))
        batches = zip(first.z.split(_RUNS), *(part.split(_RUNS) for part in own), strict=True)
        found = [self._of(first._replace(z=z, own=Platform(*parts))) for z, *parts in batches]
        mean, covariance = (torch.cat(parts) for parts in zip(*found, strict=True))
        low, high = first.limits
        said = f"filters start from the mean and covariance that the first look leaves of ranges from {low:g} to {high:g} m"
        return mean, torch.linalg.cholesky(covariance), said

    def _of(self, first: Look) -> tuple[Tensor, Tensor]:
        """Mean [R, 4] and covariance [R, 4, 4]."""
        low, high = first.limits
        coarse = torch.exp(torch.linspace(math.log(low), math.log(high), _COARSE, dtype=torch.float64))
        likely = _Place.seen(first, coarse.expand(len(first.z), -1), first.z[:, :1]).log_weight
        kept, step = likely > likely.amax(1, keepdim=True) - _UNLIKELY, coarse[1] / coarse[0]
        near, far = (torch.where(kept, coarse, edge) for edge in (torch.inf, -torch.inf))
        begin, end = (near.amin(1) / step).clamp(min=low), (far.amax(1) * step).clamp(max=high)
        middles = (torch.arange(self.ranges, dtype=torch.float64) + 0.5) / self.ranges
        nodes, weight = _hermite(self.bearings)
        ranges = begin[:, None] + (end - begin)[:, None] * middles
        place = _Place.seen(first, ranges, first.z[:, :1] + first.sd[0] * nodes)
        x, log_weight = place.with_velocities(first, *_hermite(self.velocities))
        log_weight = log_weight + weight.log().repeat_interleave(self.ranges)[:, None]
        share, x = torch.softmax(log_weight.flatten(1), 1).unsqueeze(-1), x.flatten(1, 2)
        mean = (share * x).sum(1)
        away = x - mean.unsqueeze(1)
        return mean, (share * away).mT @ away


class _Place(NamedTuple):
    """Where emitters may be, N places of each run, and what its look says of the velocity there.

    Attributes:
        ground: x, y [R, N, 2] m.
        log_weight: of elevation and angular rates [R, N].
        velocity: mean of the velocity given the angular rates [R, N, 2].
        root: Cholesky factor of its covariance [R, N, 2, 2].
    """

    ground: Tensor
    log_weight: Tensor
    velocity: Tensor
    root: Tensor

    @classmethod
    def seen(cls, first: Look, ranges: Tensor, bearings: Tensor) -> _Place:
        """Places at all ranges [R, n] and bearings [R, m], the ranges running faster: N = m n."""
        own, z, sd, prior = first.own, first.z.unsqueeze(1), first.sd, first.velocity_sd**2
        ahead = torch.stack([torch.sin(bearings), torch.cos(bearings), torch.zeros_like(bearings)], -1)
        level = (ahead @ own.attitude)[..., :2]
        ground = own.position[:, None, :2] + (level.unsqueeze(2) * ranges[:, None, :, None]).flatten(1, 2)
        still, eye = torch.cat([ground, torch.zeros_like(ground)], -1), torch.eye(4, dtype=sd.dtype)
        base, east, north = (_looked(still + move, own) for move in (0.0 * eye[0], eye[2], eye[3]))
        gain = torch.stack([(moved - base)[..., 2:4] for moved in (east, north)], -1)  # angular rates are linear in the velocity
        spread = prior * gain @ gain.mT + torch.diag(sd[2:4].square())
        off = (z[..., 2:4] - base[..., 2:4]).unsqueeze(-1)
        back = prior * torch.linalg.solve(spread, gain).mT
        left = prior * (eye[:2, :2] - back @ gain)
        chance = ((z[..., 1] - base[..., 1]) / sd[1]).square() + torch.logdet(spread)
        chance = chance + (off.mT @ torch.linalg.solve(spread, off)).flatten(-3)
        return cls(ground, -0.5 * chance, (back @ off).squeeze(-1), torch.linalg.cholesky((left + left.mT) / 2))

    def with_velocities(self, first: Look, nodes: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """States [R, N, V, 4] and log weights [R, N, V], the Doppler rate among what was seen."""
        velocity = self.velocity.unsqueeze(2) + torch.cartesian_prod(nodes, nodes) @ self.root.mT
        x = torch.cat([self.ground.unsqueeze(2).expand_as(velocity), velocity], -1)
        doppler = _looked(x.flatten(1, 2), first.own)[..., 4].unflatten(1, velocity.shape[1:3])
        seen = -0.5 * ((first.z[:, 4, None, None] - doppler) / first.sd[4]).square()
        return x, self.log_weight.unsqueeze(-1) + torch.outer(weight, weight).flatten().log() + seen


def first_fix(
    z: Tensor, own: Platform, sd: Tensor, velocity_sd: float, limits: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor]:
    """The initial law of a run from its first look [Pu and Qin, section 3.2; the covariance is in words there].

    The range follows from the Doppler rate and the rates of the angles, r = -lambda fd' / (eps'^2 + beta'^2 cos^2 eps); it is
    clipped to the limits. Along the horizontal line of sight the deviation is the range's to first order, at most a quarter of
    the limits' distance; across it, range times that of the bearing. Velocity 0. [ours]

    Args:
        z: first look [R, 5].
        own: the aircraft as it is given at that time [R or 1, ...].
        sd: of the measurement [5].
        velocity_sd: m/s.
        limits: of the range, m.

    Returns:
        start [R, 4], Cholesky factor of the covariance [R, 4, 4], runs whose range was clipped [R].
    """
    bearing, elevation, turning, rising, doppler = z.unbind(-1)
    length = SPEED_OF_LIGHT / own.carrier
    cos = torch.cos(elevation)
    rate2 = rising.square() + (turning * cos).square()
    raw = -length * doppler / rate2
    r = raw.clamp(*limits)
    slope = (length / rate2).square()
    variance = slope * (sd[4] ** 2 + (2.0 * doppler / rate2).square() * ((turning * sd[2]).square() + (rising * sd[3]).square()))
    along = cos * variance.sqrt().clamp(max=(limits[1] - limits[0]) / 4.0)
    ahead = torch.stack([torch.sin(bearing), torch.cos(bearing), torch.zeros_like(bearing)], -1)
    sight = torch.cat([ahead[..., :2] * cos.unsqueeze(-1), torch.sin(elevation).unsqueeze(-1)], -1)
    fix = own.position + r.unsqueeze(-1) * (sight.unsqueeze(-2) @ own.attitude).squeeze(-2)
    start = torch.cat([fix[..., :2], torch.zeros_like(fix[..., :2])], -1)
    u = (ahead.unsqueeze(-2) @ own.attitude).squeeze(-2)[..., :2]
    axes = torch.stack([u, torch.stack([-u[..., 1], u[..., 0]], -1)], -1)  # columns along and across
    root = axes * torch.stack([along, r * cos * sd[0]], -1).unsqueeze(-2)
    spread = torch.zeros(len(z), 4, 4, dtype=z.dtype) + velocity_sd * torch.eye(4, dtype=z.dtype)
    spread[:, :2, :2] = torch.linalg.cholesky(root @ root.mT)
    return start, spread, raw != r


def _looked(x: Tensor, own: Platform) -> Tensor:
    """What each run's aircraft would measure of emitters x [R, N, 4] without errors [R, N, 5]."""
    return look(*relative(x, own), own.carrier.unsqueeze(-1))


def _hermite(n: int) -> tuple[Tensor, Tensor]:
    """Nodes [n] and weights [n] of the standard normal law."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(n)
    return torch.from_numpy(nodes), torch.from_numpy(weights / weights.sum())
