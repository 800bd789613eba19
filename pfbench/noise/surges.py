"""What changes the size or the middle of errors for a while: surges of the noise, steps of a bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.noise.laws import Law
from pfbench.noise.regimes import Nominal, Regime
from pfbench.noise.windows import Windows, checked, within
from pfbench.record import Channels


@dataclass(frozen=True)
class Surge:
    """In each window the variances of the measurement noise and of the process noise are multiplied.

    The errors outside the windows are those without a surge, number for number; inside they are larger by the root of the
    factor. The process noise is a simulated sensor's own (see `Regime.process`), and the driving noise of a model's world.

    Args:
        windows: pairs of seconds (from, to), from inclusive, to exclusive, in order; a `to` of None is the record's end.
        r_factors: on R in each window.
        q_factors: on Q in each window.
        span: seconds of the record that the windows are written for, to have them stretched to the record at hand; None takes
            them as they are.
        of: the errors that surge.

    Raises:
        ValueError: a faulty window, not as many factors as windows, a factor that is not positive.
    """

    windows: Windows
    r_factors: Sequence[float]
    q_factors: Sequence[float]
    span: float | None = None
    of: Regime = field(default_factory=Nominal)

    def __post_init__(self) -> None:
        checked(self.windows, self.span)
        for key, factors in (("r_factors", self.r_factors), ("q_factors", self.q_factors)):
            if len(factors) != len(self.windows) or not all(0.0 < f < float("inf") for f in factors):
                raise ValueError(f"noise.{key}={list(factors)}: give a positive factor on the variance for each of the windows")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        return self._at(self.r_factors, time).sqrt()[:, None] * self.of.errors(draws, channels, time)

    def process(self, time: Tensor) -> Tensor:
        return self._at(self.q_factors, time) * self.of.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        family, shift, scale = self.of.law(channels, time)
        root = self._at(self.r_factors, time).sqrt()[:, None]
        return Law(family, root * shift, root * scale)

    def _at(self, factors: Sequence[float], time: Tensor) -> Tensor:
        """[T]."""
        return time.new_tensor([*factors, 1.0])[within(self.windows, time, self.span)]  # -1, outside, is the last


@dataclass(frozen=True)
class BiasStep:
    """From some time on, one component or all of them are wrong by a constant.

    Args:
        size: in nominal standard deviations of each component, with its sign.
        time: seconds from which on.
        component: of the measurement, counted from 0; None for all.
        span: seconds of the record that `time` is written for, to have it stretched; None takes it as it is.
        of: the errors that the bias is added to.

    Raises:
        ValueError: a component that the measurement does not have; a time after the record's end.
    """

    size: float = 5.0
    time: float = 700.0
    component: int | None = None
    span: float | None = None
    of: Regime = field(default_factory=Nominal)

    def __post_init__(self) -> None:
        checked(((self.time, None),), self.span)

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        return self.of.errors(draws, channels, time) + self._bias(channels, time) * channels.sd

    def process(self, time: Tensor) -> Tensor:
        return self.of.process(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        family, shift, scale = self.of.law(channels, time)
        return Law(family, shift + self._bias(channels, time), scale)

    def _bias(self, channels: Channels, time: Tensor) -> Tensor:
        """In nominal standard deviations [T, Dy]."""
        n = len(channels.sd)
        if self.component is not None and not 0 <= self.component < n:
            raise ValueError(f"noise.component={self.component}: the scenario measures {n} components, 0 to {n - 1}")
        wrong = torch.tensor([self.component in (None, i) for i in range(n)])
        late = within(((self.time, None),), time, self.span) == 0
        return torch.where(late[:, None] & wrong, self.size, 0.0).to(time)
