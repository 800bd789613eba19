"""A swarm in flight: what it remembers, and how its particles choose their velocities."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws


class Flock(NamedTuple):
    """A swarm in flight: places, velocities, best and worst places so far, chaotic values [R, N, k]; fitness of each [R, N]."""

    q: Tensor
    v: Tensor
    fitness: Tensor
    best: Tensor
    best_fitness: Tensor
    worst: Tensor
    worst_fitness: Tensor
    chaos: Tensor

    def leader(self) -> Tensor:
        """The best place so far [R, 1, k]."""
        return pick(self.best, self.best_fitness.argmax(1))

    def last(self, live: Tensor) -> Tensor:
        """The worst place at present [R, 1, k]."""
        return pick(self.q, torch.where(live, self.fitness, torch.inf).argmin(1))


class Velocity(Protocol):
    """The next velocities [R, N, k]; `phase` goes from 0 to 1 over the iterations."""

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor: ...


@dataclass(frozen=True)
class Gaussian:
    """|n1| (pbest - x) + |n2| (gbest - x), n ~ N(0, 1) [Krohling 2004; Tian et al., eq. 29]. No inertia, nothing to tune."""

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor:
        n, k = flock.q.shape[1:]
        own, common = draws.normal(purpose, n, 2 * k).abs().unflatten(-1, (2, k)).unbind(-2)
        return own * (flock.best - flock.q) + common * (flock.leader() - flock.q)


@dataclass(frozen=True)
class Inertia:
    """w v + c1 r1 (pb - x) + c2 r2 (pg - x) - c3 (r3 (pw - x) + r4 (gw - x)), r ~ U(0, 1) [Tian et al., eqs. 27 and 34].

    c3 = escape (1 - cos(pi it / iterations)), which rises from 0 to twice `escape`: what eq. 35 means. Its print is constant but
    for ripples, and its figure rises.

    Args:
        inertia: w.
        own, common: c1 and c2, which the paper does not give. Mean-square stability asks for c1 + c2 < 24 (1 - w^2) / (7 - 5 w)
            [Poli 2009], 2.88 for w = 0.8; the customary 2 each is unstable. [ours]
        escape: 0 for the plain swarm.

    Raises:
        ValueError: an inertia outside [0, 1), negative numbers.
    """

    inertia: float = 0.8
    own: float = 1.2
    common: float = 1.2
    escape: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.inertia < 1.0:
            raise ValueError(f"velocity.inertia={self.inertia}: give a number from 0 to below 1")
        if min(self.own, self.common, self.escape) < 0.0:
            raise ValueError(f"velocity: own={self.own}, common={self.common}, escape={self.escape}; give 0 or more")

    def escape_factor(self, phase: float) -> float:
        """c3 = c4."""
        return self.escape * (1.0 - math.cos(math.pi * phase))

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor:
        n, k = flock.q.shape[1:]
        pulls = 4 if self.escape else 2
        r = draws.uniform(purpose, n, pulls * k).to(flock.q.dtype).unflatten(-1, (pulls, k)).unbind(-2)
        v = self.inertia * flock.v + self.own * r[0] * (flock.best - flock.q) + self.common * r[1] * (flock.leader() - flock.q)
        if self.escape:
            away = r[2] * (flock.worst - flock.q) + r[3] * (flock.last(live) - flock.q)
            v = v - self.escape_factor(phase) * away
        return v


def laid(a: Tensor, like: Tensor) -> Tensor:
    """a in memory as `like` of the same shape is: loops over both are several times as fast."""
    return torch.empty_like(like, dtype=a.dtype).copy_(a)


def pick(q: Tensor, i: Tensor) -> Tensor:
    """q [R, N, k], i [R] -> [R, 1, k]."""
    return q.gather(1, i[:, None, None].expand(-1, 1, q.shape[-1]))


def where(active: Tensor, new: Flock, old: Flock) -> Flock:
    """Run by run."""
    return Flock(*(torch.where(active.reshape(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(new, old, strict=True)))
