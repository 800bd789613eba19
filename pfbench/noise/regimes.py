"""Noise regimes: what the world does to the measurements and to the process.

A regime that changes the errors of another one holds that one as `of`: an outage of a receiver with heavy tails is
Outage(windows, of=StudentT(4)). What is nominal in a regime has the same numbers as in the nominal world, so that filters are
compared across regimes on common random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.noise import laws
from pfbench.noise.laws import Law
from pfbench.noise.windows import Windows, checked, within
from pfbench.record import Channels

_PIECES = 20  # of the interval over which a step's process noise is averaged


class Regime(Protocol):
    """What a world does beyond the nominal."""

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        """Errors of the measurements at times [T] in seconds: [R, T, Dy], NaN where unseen."""

    def process(self, time: Tensor) -> Tensor:
        """Factor on the variance of the process noise (of the inertial sensors' white noise) at times [T]: [T]."""

    def law(self, channels: Channels, time: Tensor) -> Law:
        """What a filter that is told the regime knows of the errors at times [T].

        Raises:
            ValueError: the errors have no law step by step.
        """


def step_process(noise: Regime, time: Tensor) -> Tensor:
    """Factor on the variance of the noise that drives each step [T]: the mean over the interval that ends at its time [T].

    The first interval is as long as the second.
    """
    spans = torch.diff(time, prepend=2 * time[:1] - time[1:2]) if len(time) > 1 else time
    inside = 1.0 - (torch.arange(_PIECES, dtype=time.dtype) + 0.5) / _PIECES
    middles = (time[:, None] - spans[:, None] * inside).flatten()
    factors = noise.process(torch.cat([middles, time[-1:]]))[:-1]  # the end of the record stays where it is
    return factors.unflatten(0, (-1, _PIECES)).mean(1)


def untouched_process(noise: Regime, time: Tensor) -> None:
    """For worlds whose motion was recorded.

    Raises:
        ValueError: a regime that swells the process noise.
    """
    if bool((noise.process(time) != 1.0).any()):
        raise ValueError(
            "noise: the sensors of this scenario were recorded, and a regime cannot swell their noise; "
            "give noise.q_factors of 1, or choose a simulated scenario"
        )


def untold(noise: str, why: str) -> ValueError:
    """What a regime raises that has no law step by step."""
    return ValueError(f"noise={noise}: a filter cannot be told of it ({why}); give told=false")


class _Calm:
    """A regime that leaves the process alone."""

    def process(self, time: Tensor) -> Tensor:
        return torch.ones_like(time)


def _steady(family: laws.Family, channels: Channels, time: Tensor) -> Law:
    """The same law at all steps."""
    shape = len(time), len(channels.sd)
    return Law(family, time.new_zeros(shape), time.new_ones(shape))


@dataclass(frozen=True)
class Nominal(_Calm):
    """White and normal, as the filter believes."""

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        return channels.sd * draws.normal("world.receiver", len(time), len(channels.sd))

    def law(self, channels: Channels, time: Tensor) -> Law:
        return _steady(laws.normal, channels, time)


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

    def law(self, channels: Channels, time: Tensor) -> Law:
        return _steady(laws.student(self.dof), channels, time)


@dataclass(frozen=True)
class Laplace(_Calm):
    """Double exponential errors of the nominal variance, so that what a Kalman filter believes of them is right but their shape.

    The larger nominal error becomes the larger one here. [ours]
    """

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        return channels.sd * laws.to_laplace(draws.normal("world.receiver", len(time), len(channels.sd)))

    def law(self, channels: Channels, time: Tensor) -> Law:
        return _steady(laws.laplace, channels, time)


@dataclass(frozen=True)
class Outliers(_Calm):
    """Impulsive errors: with `probability` they are `size` times as large, a contaminated normal [Tukey 1960; Huber 1964].

    Args:
        probability: of an epoch, or of each component of it.
        size: factor on the nominal errors.
        together: all components of an epoch at once, or each for itself.

    Raises:
        ValueError: probability outside [0, 1], size below 1.
    """

    probability: float = 0.05
    size: float = 10.0
    together: bool = True

    def __post_init__(self) -> None:
        _contamination(self.probability, self.size)

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        hit = draws.uniform("world.outliers", len(time), 1 if self.together else len(channels.sd)) < self.probability
        return torch.where(hit, self.size, 1.0).to(channels.sd) * Nominal().errors(draws, channels, time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        return _steady(laws.contaminated(self.probability, self.size, self.together, laws.normal), channels, time)


@dataclass(frozen=True)
class Glint(_Calm):
    """Radar glint: normal errors, and with `probability` Laplace ones of `size` times the deviation [Wu 1993, "Target tracking
    with glint noise"]. Glint of a wide normal is `Outliers` with together=false.

    Args:
        probability: of an epoch, or of each component of it.
        size: standard deviation of a glint spike in nominal ones.
        together: all components of an epoch at once, or each for itself.

    Raises:
        ValueError: probability outside [0, 1], size below 1.
    """

    probability: float = 0.1
    size: float = 10.0
    together: bool = False

    def __post_init__(self) -> None:
        _contamination(self.probability, self.size)

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        hit = draws.uniform("world.outliers", len(time), 1 if self.together else len(channels.sd)) < self.probability
        spike = self.size * Laplace().errors(draws, channels, time)
        return torch.where(hit, spike, Nominal().errors(draws, channels, time))

    def law(self, channels: Channels, time: Tensor) -> Law:
        return _steady(laws.contaminated(self.probability, self.size, self.together, laws.laplace), channels, time)


def _contamination(probability: float, size: float) -> None:
    if not 0.0 <= probability <= 1.0:
        raise ValueError(f"noise.probability={probability}: give a probability between 0 and 1")
    if not size >= 1.0:
        raise ValueError(f"noise.size={size}: give a factor of at least 1 on the nominal standard deviation")


@dataclass(frozen=True)
class Outage:
    """The receiver is silent in some windows, or hears only a few sources.

    Args:
        windows: pairs of seconds (from, to), from inclusive, to exclusive, in order.
        keep: so many sources stay: those of the lowest numbers, the same in all runs, so that worlds stay paired. [ours]
        span: seconds of the record that the windows are written for, to have them stretched; None takes them as they are.
        of: the errors of what is heard.

    Raises:
        ValueError: a window that ends before it starts, or begins after the record's end; no source that would be silent.
    """

    windows: Windows = ((100.0, 130.0),)
    keep: int = 0
    span: float | None = None
    of: Regime = field(default_factory=Nominal)

    def __post_init__(self) -> None:
        checked(self.windows, self.span)
        if self.keep < 0:
            raise ValueError(f"noise.keep={self.keep}: give the number of sources that are still heard, 0 or more")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        sources: Sequence[int] = sorted(set(channels.source))
        if self.keep >= len(sources):
            raise ValueError(f"noise.keep={self.keep}: the scenario has {len(sources)} sources; keep fewer, or nothing is silent")
        deaf = torch.tensor([source in sources[self.keep :] for source in channels.source])
        silent = (within(self.windows, time, self.span) >= 0)[:, None] & deaf
        return torch.where(silent, torch.nan, self.of.errors(draws, channels, time))

    def process(self, time: Tensor) -> Tensor:
        return self.of.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        """That of what is heard: silence is known from the record, and says nothing."""
        return self.of.law(channels, time)
