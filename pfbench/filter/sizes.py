"""How many particles a cloud should have."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud, ess


class Size(Protocol):
    """A cloud -> the number of particles wanted in each run, float [R, 1], at most the number of slots."""

    def first(self, slots: int) -> int:
        """The number to begin with, of so many slots."""

    def __call__(self, cloud: Cloud) -> Tensor: ...


@dataclass(frozen=True)
class Fixed:
    """All slots, always."""

    def first(self, slots: int) -> int:
        return slots

    def __call__(self, cloud: Cloud) -> Tensor:
        runs, slots = cloud.log_w.shape
        return torch.full((runs, 1), slots, dtype=torch.float64, device=cloud.log_w.device).to(cloud.log_w.dtype)


@dataclass(frozen=True)
class Bounds:
    """Numbers of particles between which a cloud grows and shrinks, and the one to begin with.

    Raises:
        ValueError: numbers that are out of order; at the start, fewer slots than `most`.
    """

    least: int
    most: int
    start: int

    def __post_init__(self) -> None:
        if not 2 <= self.least <= self.start <= self.most:
            raise ValueError(
                f"size.bounds: least={self.least}, start={self.start}, most={self.most}; give 2 <= least <= start <= most"
            )

    def first(self, slots: int) -> int:
        """The number to begin with, of so many slots."""
        if self.most > slots:
            raise ValueError(
                f"size.bounds.most={self.most}: there are {slots} slots; raise filter.particles or lower most and start"
            )
        return self.start


@dataclass(frozen=True)
class EssStep:
    """One step up where ESS < threshold N, else one step down, within bounds [COFM-AMSSRCPF 2024, Measurement and Control].

    ESS is that of the weights handed out, before any preference: what is decided at t - 1 holds for the draws at t, so that
    the evidence stays unbiased. The source computes it before the new weights, where it is N always and N would only fall.
    ESS / N hardly depends on N, so that the number comes to rest at one of its bounds.

    Args:
        step: up and down; 0 keeps the number at `bounds.start`.
        threshold: of ESS / N.
        bounds: the source leaves them open [ours].

    Raises:
        ValueError: a negative step, a threshold outside [0, 1].
    """

    step: int = 10
    threshold: float = 0.5
    bounds: Bounds = field(default_factory=lambda: Bounds(100, 200, 150))

    def __post_init__(self) -> None:
        if self.step < 0 or not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"size.step={self.step}, threshold={self.threshold}: give a step of 0 or more, a ratio from 0 to 1")

    def first(self, slots: int) -> int:
        return self.bounds.first(slots)

    def __call__(self, cloud: Cloud) -> Tensor:
        n = _occupied(cloud)
        if self.step == 0:
            return torch.full_like(n, self.bounds.start)
        wanted = torch.where(ess(cloud.log_w).unsqueeze(1) < self.threshold * n, n + self.step, n - self.step)
        return wanted.clamp(self.bounds.least, self.bounds.most)


@dataclass(frozen=True)
class EssTarget:
    """As many particles as would have had the effective size asked for, N target / ESS, within bounds [ours].

    Raises:
        ValueError: a target that is not positive.
    """

    target: float = 100.0
    bounds: Bounds = field(default_factory=lambda: Bounds(100, 1000, 150))

    def __post_init__(self) -> None:
        if not self.target > 0.0:
            raise ValueError(f"size.target={self.target}: give a positive effective sample size")

    def first(self, slots: int) -> int:
        return self.bounds.first(slots)

    def __call__(self, cloud: Cloud) -> Tensor:
        wanted = _occupied(cloud) * self.target / ess(cloud.log_w).unsqueeze(1)
        return wanted.round().clamp(self.bounds.least, self.bounds.most)


def _occupied(cloud: Cloud) -> Tensor:
    """Particles that weigh anything [R, 1], a whole number."""
    return (cloud.log_w > -torch.inf).sum(1, keepdim=True).to(cloud.log_w)
