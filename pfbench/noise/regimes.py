"""Noise regimes: what the world does to the measurements and to the process. The filter is not told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.record import Channels


class Regime(Protocol):
    """What a world does beyond the nominal."""

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        """Errors of the measurements at times [T] in seconds: [R, T, Dy], NaN where unseen."""

    def process(self, time: Tensor) -> Tensor:
        """Factor on the variance of the process noise (of the inertial sensors' white noise) at times [T]: [T]."""


class _Calm:
    """A regime that leaves the process alone."""

    def process(self, time: Tensor) -> Tensor:
        return torch.ones_like(time)


@dataclass(frozen=True)
class Nominal(_Calm):
    """White and normal, as the filter believes."""

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        return channels.sd * draws.normal("world.receiver", len(time), len(channels.sd))


@dataclass(frozen=True)
class StudentT(_Calm):
    """Heavy tails: Student's t with `dof` degrees of freedom, scaled so that the middle is that of the nominal law.

    Not scaled to the nominal variance, which would make the bulk of the errors smaller than the filter expects. [ours]

    Raises:
        ValueError: dof below 3, for which the variance is infinite.
    """

    dof: int = 4

    def __post_init__(self) -> None:
        if self.dof < 3:
            raise ValueError(f"noise.dof={self.dof}: give at least 3 degrees of freedom (the variance is infinite below)")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        t, k = len(time), len(channels.sd)
        z = draws.normal("world.receiver", t, k)
        chi2 = draws.normal("world.tails", t, k * self.dof).square().reshape(-1, t, k, self.dof).sum(-1)
        return channels.sd * z / torch.sqrt(chi2 / self.dof)


@dataclass(frozen=True)
class Outliers(_Calm):
    """Impulsive errors: with `probability` an epoch's errors are `size` times as large, all components at once.

    Raises:
        ValueError: probability outside [0, 1], size below 1.
    """

    probability: float = 0.05
    size: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.probability <= 1.0:
            raise ValueError(f"noise.probability={self.probability}: give a probability between 0 and 1")
        if not self.size >= 1.0:
            raise ValueError(f"noise.size={self.size}: give a factor of at least 1 on the nominal standard deviation")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        hit = draws.uniform("world.outliers", len(time), 1) < self.probability
        return torch.where(hit, self.size, 1.0).to(channels.sd) * Nominal().errors(draws, channels, time)


@dataclass(frozen=True)
class Outage(_Calm):
    """The receiver is silent in some windows; nominal outside them.

    Args:
        windows: pairs of seconds (from, to), from inclusive, to exclusive.

    Raises:
        ValueError: a window that ends before it starts.
    """

    windows: Sequence[Sequence[float]] = ((100.0, 130.0),)

    def __post_init__(self) -> None:
        for window in self.windows:
            if len(window) != 2 or not window[0] < window[1]:
                raise ValueError(f"noise.windows: {list(window)} is not a window; give [from, to] in seconds with from < to")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        silent = torch.zeros_like(time, dtype=torch.bool)
        for start, end in self.windows:
            silent |= (time >= start) & (time < end)
        return torch.where(silent[:, None], torch.nan, Nominal().errors(draws, channels, time))
