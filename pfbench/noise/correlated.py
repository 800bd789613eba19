"""Errors that remember: Gauss-Markov noise, reflected signals, and blocks of a real receiver's record."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.noise import laws
from pfbench.noise.laws import Law
from pfbench.noise.regimes import Nominal, Regime, untold
from pfbench.record import Channels


@dataclass(frozen=True)
class GaussMarkov:
    """A first-order Gauss-Markov process on top of each component's errors, exact at any spacing of the times.

    Args:
        ratio: its stationary standard deviation in nominal ones.
        correlation_time: s, after which the correlation is 1/e.
        of: the errors that it is added to.

    Raises:
        ValueError: a ratio below 0, a correlation time that is not positive; a filter that is to be told.
    """

    ratio: float = 1.0
    correlation_time: float = 30.0
    of: Regime = field(default_factory=Nominal)

    def __post_init__(self) -> None:
        if not self.ratio >= 0.0:
            raise ValueError(f"noise.ratio={self.ratio}: give a size in nominal standard deviations, 0 or more")
        if not self.correlation_time > 0.0:
            raise ValueError(f"noise.correlation_time={self.correlation_time}: give a positive number of seconds")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        driver = draws.normal("world.correlated", len(time), len(channels.sd))
        kept = torch.exp(-torch.diff(time) / self.correlation_time).tolist()
        x = [driver[:, 0]]
        for t, rho in enumerate(kept, 1):
            x.append(rho * x[-1] + math.sqrt(1.0 - rho * rho) * driver[:, t])
        return self.of.errors(draws, channels, time) + self.ratio * channels.sd * torch.stack(x, 1)

    def process(self, time: Tensor) -> Tensor:
        return self.of.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        raise untold("gauss_markov", "its errors remember those before")


@dataclass(frozen=True)
class NonLineOfSight:
    """Reflected signals: a source is out of sight with `probability`, and its measurement then too long by an exponential bias.

    Which components are concerned: ranges; in a scenario without ranges the positions; without these, all. All of one source
    are hit together, each with a bias of its own, which is added to the measurement as it is handed out. [ours]

    Args:
        probability: of being out of sight, at any time.
        mean: of the bias, in nominal standard deviations of the component.
        dwell: mean seconds out of sight. None draws each epoch anew; else a two-state Markov chain in continuous time that
            starts in its stationary law, and a bias that lasts as long as the source is out of sight. [ours]
        of: the errors that the bias is added to.

    Raises:
        ValueError: a probability that is none (or 1, with `dwell`), a mean or dwell that is not positive; a filter that is to be
            told of what has no law step by step.
    """

    probability: float = 0.2
    mean: float = 5.0
    dwell: float | None = None
    of: Regime = field(default_factory=Nominal)

    def __post_init__(self) -> None:
        if not 0.0 <= self.probability <= 1.0 or (self.dwell is not None and self.probability == 1.0):
            raise ValueError(f"noise.probability={self.probability}: give a probability, below 1 where noise.dwell is set")
        for key, value in (("mean", self.mean), ("dwell", self.dwell)):
            if value is not None and not 0.0 < value < math.inf:
                raise ValueError(f"noise.{key}={value}: give a positive number")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        sources, of_source = torch.unique(torch.tensor(channels.source), return_inverse=True)
        u = draws.uniform("world.sight", len(time), len(sources))[..., of_source]
        lag = -self.mean * torch.log(draws.uniform("world.reflection", len(time), len(channels.sd)))
        if self.dwell is None:
            bias = torch.where(u < self.probability, lag, 0.0)
        else:
            bias = self._stays(u, lag, time, self.dwell)
        concerned = torch.tensor(_concerned(channels)).to(bias)
        return self.of.errors(draws, channels, time) + bias * concerned * channels.sd

    def _stays(self, u: Tensor, lag: Tensor, time: Tensor, dwell: float) -> Tensor:
        """Bias [R, T, Dy] of a chain that stays out of sight for `dwell` and is so with `probability`."""
        p = self.probability
        kept = torch.exp(-torch.diff(time) / (dwell * (1.0 - p))).tolist()  # what is left of where it was
        hidden = u[:, 0] < p
        held = torch.where(hidden, lag[:, 0], 0.0)
        biases = [held]
        for t, rho in enumerate(kept, 1):
            was, hidden = hidden, u[:, t] < p * (1.0 - rho) + rho * hidden
            held = torch.where(hidden, torch.where(was, held, lag[:, t]), 0.0)
            biases.append(held)
        return torch.stack(biases, 1)

    def process(self, time: Tensor) -> Tensor:
        return self.of.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        family, shift, scale = self.of.law(channels, time)
        hit = _concerned(channels)
        hits = [source for source, wrong in zip(channels.source, hit, strict=True) if wrong]
        if self.dwell is not None:
            raise untold("nlos", "its biases last")
        if len(set(hits)) < len(hits):
            raise untold("nlos", "it hits several components of one source together")
        if family is not laws.normal or not bool((scale == 1.0).all()):
            raise untold("nlos", "the errors below the bias are not nominal")
        return Law(laws.one_sided(self.probability * torch.tensor(hit).to(scale), self.mean), shift, scale)


def _concerned(channels: Channels) -> list[bool]:
    """Ranges; where there are none, positions; where there are none either, everything."""
    for kind in ("range", "position"):
        if kind in channels.kind:
            return [kind == own for own in channels.kind]
    return [True] * len(channels.kind)
