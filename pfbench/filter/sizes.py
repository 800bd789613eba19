"""How many particles a cloud should have."""

from __future__ import annotations

from dataclasses import dataclass
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
class EssStep:
    """One step up where ESS < threshold N, else one step down, within bounds [COFM-AMSSRCPF 2024, Measurement and Control].

    ESS is that of the weights handed out, before any preference: what is decided at t - 1 holds for the draws at t, so that
    the evidence stays unbiased. The source computes it before the new weights, where it is N always and N would only fall.
    ESS / N hardly depends on N, so that the number comes to rest at one of its bounds.

    Args:
        step: up and down; 0 keeps the number at `start`.
        threshold: of ESS / N.
        least, most, start: bounds, which the source leaves open [ours], and the number to begin with [ours].

    Raises:
        ValueError: arguments that are out of order; at the start, fewer slots than `most`.
    """

    step: int = 10
    threshold: float = 0.5
    least: int = 100
    most: int = 200
    start: int = 150

    def __post_init__(self) -> None:
        _check_bounds(self.least, self.start, self.most)
        if self.step < 0 or not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"size.step={self.step}, threshold={self.threshold}: give a step of 0 or more, a ratio from 0 to 1")

    def first(self, slots: int) -> int:
        return _first(self.start, self.most, slots)

    def __call__(self, cloud: Cloud) -> Tensor:
        n = _occupied(cloud)
        if self.step == 0:
            return torch.full_like(n, self.start)
        wanted = torch.where(ess(cloud.log_w).unsqueeze(1) < self.threshold * n, n + self.step, n - self.step)
        return wanted.clamp(self.least, self.most)


@dataclass(frozen=True)
class EssTarget:
    """As many particles as would have had the effective size asked for, N target / ESS, within bounds [ours].

    Args:
        target: effective sample size.
        least, most, start: bounds, and the number to begin with.

    Raises:
        ValueError: arguments that are out of order; at the start, fewer slots than `most`.
    """

    target: float = 100.0
    least: int = 100
    most: int = 1000
    start: int = 150

    def __post_init__(self) -> None:
        _check_bounds(self.least, self.start, self.most)
        if not self.target > 0.0:
            raise ValueError(f"size.target={self.target}: give a positive effective sample size")

    def first(self, slots: int) -> int:
        return _first(self.start, self.most, slots)

    def __call__(self, cloud: Cloud) -> Tensor:
        wanted = _occupied(cloud) * self.target / ess(cloud.log_w).unsqueeze(1)
        return wanted.round().clamp(self.least, self.most)


def _occupied(cloud: Cloud) -> Tensor:
    """Particles that weigh anything [R, 1], a whole number."""
    return (cloud.log_w > -torch.inf).sum(1, keepdim=True).to(cloud.log_w)


def _first(start: int, most: int, slots: int) -> int:
    if most > slots:
        raise ValueError(f"size.most={most}: there are {slots} slots; raise filter.particles or lower most and start")
    return start


def _check_bounds(least: int, start: int, most: int) -> None:
    if not 2 <= least <= start <= most:
        raise ValueError(f"size.least={least}, start={start}, most={most}: give 2 <= least <= start <= most")
