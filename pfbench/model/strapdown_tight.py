"""Total-state tightly coupled INS/GNSS for MEMS sensors: motion and sensor biases as in the loosely coupled model, and a clock.

What is seen is the pseudorange and the range rate of each satellite. Ranges are 2e7 m and their errors metres, so the record
hands over ranges less those from a fixed place near the receiver, and the model expands about that place exactly; a filter can
then work in single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart, Euclidean, Quaternion
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch, positive
from pfbench.model.strapdown_total import Believed, Increments, StrapdownTotal
from pfbench.nav.ranging import Clock
from pfbench.record import Record

_MOTION, _CLOCK = 16, 3
_DRIVEN = StrapdownTotal.noise_dim
_CHART = Chart((Quaternion(), Euclidean(_MOTION - 4 + _CLOCK)))


class Sighted(NamedTuple):
    """Inputs of a step: what the IMU says of it, and the S satellites at its end, seen from a place fixed to the ground.

    Attributes:
        turn, push, shift, jacobian, bias, gravity, duration: see `Increments`.
        line: unit vectors from the place to the satellites, East, North, Up [R or 1, T, S, 3].
        reach: distances of the satellites from it [R or 1, T, S] m.
        velocity: of the satellites, East, North, Up [R or 1, T, S, 3] m/s.
        other: 1 for a satellite of another system than the clock's own, else 0 [R or 1, T, S].
        range_sd, rate_sd: as the receiver states them [R or 1, T, S] m, m/s.
    """

    turn: Tensor
    push: Tensor
    shift: Tensor
    jacobian: Tensor
    bias: Tensor
    gravity: Tensor
    duration: Tensor
    line: Tensor
    reach: Tensor
    velocity: Tensor
    other: Tensor
    range_sd: Tensor
    rate_sd: Tensor

    @property
    def increments(self) -> Increments:
        """The IMU's part."""
        return Increments(*self[: len(Increments._fields)])


@dataclass(frozen=True)
class Scatter:
    """How far measurements of one kind scatter: sd^2 = floor^2 + (factor stated)^2 + added^2. [ours]

    Args:
        floor: what the receiver does not know of, multipath and atmosphere; m or m/s.
        factor: on what it states of each satellite.
        added: what a regime adds to the recorded measurements.

    Raises:
        ValueError: a floor that is not positive, or a negative factor or addition.
    """

    floor: float
    factor: float = 1.0
    added: float = 0.0

    def __post_init__(self) -> None:
        positive("believed.floor", [self.floor])
        if not (self.factor >= 0.0 and self.added >= 0.0):
            raise ValueError(f"believed.factor={self.factor}, believed.added={self.added}: give numbers that are not negative")

    def sd(self, stated: Tensor) -> Tensor:
        """Of measurements with stated standard deviations [...]."""
        return torch.sqrt(self.floor**2 + self.added**2 + (self.factor * stated) ** 2)


@dataclass(frozen=True)
class BelievedTight:
    """What filters are told.

    Args:
        motion: of sensors and start; what it says of fixes is not used.
        clock: the receiver's, about its nominal course.
        range, rate: scatter of the measurements.
        inter_system_sd: of the other system's clock against the first one's, about its nominal value, initially, m.
        inter_system_walk: of the same, m/sqrt(s).
    """

    motion: Believed
    clock: Clock
    range: Scatter
    rate: Scatter
    inter_system_sd: float = 3.0
    inter_system_walk: float = 0.02

    @property
    def clock_sd(self) -> Tensor:
        """Initial, of bias m, drift m/s and inter-system bias m [3].

        Raises:
            ValueError: one that is not positive.
        """
        other = positive("believed.inter_system_sd", [self.inter_system_sd])
        return torch.cat([other.new_tensor([self.clock.bias_sd, self.clock.drift_sd]), other])


class StrapdownTight(StateSpaceModel):
    """State [19]: that of StrapdownTotal, then bias m and drift m/s of the receiver's clock, and the inter-system bias m.

    Clocks are told as differences from a nominal course that the record has taken off. With x from the fixed place and
    r = |reach line - x|, a range is r - reach + bias, and a rate is e.(V - v) - line.V + drift, where e points to the satellite.

    Args:
        believed: standard deviations and densities.

    Raises:
        ValueError: a density or standard deviation that is not positive.
    """

    p0: Tensor
    other_walk: Tensor
    noise_dim = _DRIVEN + _CLOCK

    def __init__(self, believed: BelievedTight) -> None:
        super().__init__()
        self.motion = StrapdownTotal(believed.motion)
        self.clock, self.range, self.rate = believed.clock, believed.range, believed.rate
        self.register_buffer("p0", torch.cat([believed.motion.initial_sd, believed.clock_sd]))
        self.register_buffer("other_walk", positive("believed.inter_system_walk", [believed.inter_system_walk]))
        first = len(self.motion.names)
        self.names = (*self.motion.names, "clock_bias", "clock_drift", "inter_system_bias")
        self.units = (*self.motion.units, "m", "m/s", "m")
        clocks = {name: (first + i,) for i, name in enumerate(self.names[first:])}
        self.groups = {**self.motion.groups, **clocks}
        self.choices = (
            *self.motion.choices,
            "errors of code and Doppler are taken for white; multipath is not, so their standard deviations are inflated",
        )

    @property
    def chart(self) -> Chart:
        return _CHART

    @property
    def anchor(self) -> Tensor:
        return self.p0

    @property
    def origin(self) -> Tensor:
        """Level, facing North, at rest, without biases; a recorded world hands over each run's own start instead."""
        return torch.cat([self.motion.origin, self.p0.new_zeros(_CLOCK)])

    def prepare(self, record: Record) -> Record:
        """The record as it is.

        Raises:
            ValueError: inputs of another kind.
        """
        if not isinstance(record.u, Sighted):
            kind = type(record.u).__name__
            raise ValueError(f"record.u is {kind}: StrapdownTight needs Sighted; choose a scenario with raw ranges (walk)")
        return record

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Sighted, w: Tensor) -> Tensor:
        motion, bias, drift, other = x.split([_MOTION, 1, 1, 1], -1)
        moved = self.motion.propagate(motion, u.increments, w[..., :_DRIVEN])
        clock = torch.cat([bias + drift * u.duration[:, None, None], drift, other], -1)
        return torch.cat([moved, clock + w[..., _DRIVEN:] @ self._clock_gain(u.duration).mT], -1)

    def noise_gain(self, u: Sighted) -> Tensor:
        motion, clock = self.motion.noise_gain(u.increments), self._clock_gain(u.duration)
        beside = motion.new_zeros(motion.shape[0], motion.shape[1], _CLOCK)
        below = motion.new_zeros(motion.shape[0], _CLOCK, motion.shape[2])
        return torch.cat([torch.cat([motion, beside], -1), torch.cat([below, clock], -1)], -2)

    def _clock_gain(self, duration: Tensor) -> Tensor:
        """Of bias, drift and inter-system bias [R or 1, 3, 3]."""
        walk = (self.other_walk * torch.sqrt(duration))[:, None, None]
        side = torch.zeros_like(walk).expand(-1, 2, 1)
        return torch.cat([torch.cat([self.clock.gain(duration), side], -1), torch.cat([side.mT, walk], -1)], -2)

    def observation(self, x: Tensor, u: Sighted) -> Distribution:
        v, p = x[..., 4:7], x[..., 7:10]
        bias, drift, other = x[..., _MOTION:].split(1, -1)
        reach = u.reach.unsqueeze(1)
        farther = (p.square().sum(-1, keepdim=True) / reach - 2 * p @ u.line.mT) / reach
        root = torch.sqrt(1 + farther)
        longer = reach * farther / (1 + root)  # r - reach, without the cancellation
        r = reach * root
        # (e - line).V and e.v, with e = (reach line - x) / r
        turned = -(longer * (u.line * u.velocity).sum(-1).unsqueeze(1) + p @ u.velocity.mT) / r
        approach = (reach * (v @ u.line.mT) - (v * p).sum(-1, keepdim=True)) / r
        ranges = longer + bias + other * u.other.unsqueeze(1)
        rates = turned - approach + drift
        sd = torch.cat([self.range.sd(u.range_sd), self.rate.sd(u.rate_sd)], -1)
        return independent_normal(torch.cat([ranges, rates], -1), sd.unsqueeze(1))

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """True state of an Episode; NaN where a group has no truth. Raises as `StrapdownTotal.assemble`."""
        motion = self.motion.assemble(truth)
        missing = motion.new_full((*motion.shape[:-1], 1), torch.nan)
        clocks = [truth.get(name, missing) for name in list(self.groups)[len(self.motion.groups) :]]
        return torch.cat([motion, *clocks], -1)
