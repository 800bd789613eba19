"""Total-state tightly coupled INS/GNSS for MEMS sensors, with a receiver clock.

Motion and sensor biases are as in the loosely coupled model. Measurements are pseudorange and
range rate of each satellite. Ranges are 2e7 m and their errors metres, so the record contains
ranges minus the ranges from a fixed position near the receiver. The model expands about that
position exactly, and filters can use single precision.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.channels import EACH_SATELLITE
from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.manifold.group_block import LieGroupBlock
from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive, check_tuning
from pfbench.model.base import StateSpaceModel
from pfbench.model.strapdown.total import StrapdownTotal
from pfbench.model.strapdown.tuning import TightTuning
from pfbench.nav.preintegration import PreintegratedImu

_MOTION, _CLOCK = 16, 3
_DRIVEN = StrapdownTotal.noise_dim
_CHART = Chart((QuaternionBlock(), EuclideanBlock(_MOTION - 4 + _CLOCK)))


class TightMemsInputs(NamedTuple):
    """Inputs of a step: preintegrated IMU, and S satellites at its end.

    Geometry is relative to a position that is fixed to the ground.

    Attributes:
        turn, push, shift, jacobian, bias, gravity, duration: See `PreintegratedImu`.
        line: Unit vectors to the satellites, East, North, Up, [R or 1, T, S, 3].
        reach: Distances of the satellites, [R or 1, T, S], m.
        velocity: Velocities of the satellites, East, North, Up, [R or 1, T, S, 3], m/s.
        other_system: 1 for a satellite of a different system than the clock's, else 0, [R or 1, T, S].
        range_sd: Standard deviation stated by the receiver, [R or 1, T, S], m.
        rate_sd: Standard deviation stated by the receiver, [R or 1, T, S], m/s.
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
    other_system: Tensor
    range_sd: Tensor
    rate_sd: Tensor

    @property
    def increments(self) -> PreintegratedImu:
        """The preintegrated IMU data."""
        return PreintegratedImu(*self[: len(PreintegratedImu._fields)])


class StrapdownTight(StateSpaceModel):
    """StrapdownTotal with a receiver clock, measured by pseudoranges and range rates.

    State [19]: the state of StrapdownTotal, then bias m and drift m/s of the receiver clock, and
    the inter-system bias m. Clock states are differences from a nominal course that the record
    subtracts. With x from the fixed position and r = |reach line - x|, a range is r - reach + bias.
    A rate is e.(V - v) - line.V + drift, where e points to the satellite.

    The origin is level, facing North, at rest, without biases. Recorded scenarios provide the start
    of each run.

    Args:
        tuning: Standard deviations and densities.

    Raises:
        ValueError: If a density or standard deviation is not positive.
    """

    channel_names = (
        f"range {EACH_SATELLITE} minus that from the local origin [m]",
        f"range rate {EACH_SATELLITE} minus that from the local origin [m/s]",
    )
    input_type = TightMemsInputs
    p0: Tensor
    other_walk: Tensor
    noise_dim = _DRIVEN + _CLOCK

    def __init__(self, tuning: TightTuning) -> None:
        super().__init__()
        check_tuning(tuning, TightTuning)
        self.motion = StrapdownTotal(tuning.motion)
        self.clock, self.range, self.rate = tuning.clock, tuning.range, tuning.rate
        self.register_buffer("p0", torch.cat([tuning.motion.initial_sd, tuning.clock_sd]))
        self.register_buffer(
            "other_walk", check_positive("tuning.inter_system_walk", [tuning.inter_system_walk])
        )
        first = len(self.motion.names)
        self.names = (*self.motion.names, "clock_bias", "clock_drift", "inter_system_bias")
        self.units = (*self.motion.units, "m", "m/s", "m")
        clocks = {name: (first + i,) for i, name in enumerate(self.names[first:])}
        self.groups = {**self.motion.groups, **clocks}
        self.choices = (
            *self.motion.choices,
            "errors of code and Doppler are modelled as white; multipath is correlated, "
            "so their standard deviations are inflated",
        )

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    def group_chart(self, side: str) -> Chart:
        """Return an invariant chart, that of StrapdownTotal with further Euclidean components.

        Args:
            side: `left` or `right`, see LieGroupBlock.
        """
        return Chart((LieGroupBlock(side=side), EuclideanBlock(6 + _CLOCK)))

    @property
    @override
    def anchor(self) -> Tensor:
        return self.p0

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.motion.origin, self.p0.new_zeros(_CLOCK)])

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: TightMemsInputs, w: Tensor) -> Tensor:
        motion, bias, drift, inter_system = x.split([_MOTION, 1, 1, 1], -1)
        motion = self.motion.propagate(motion, u.increments, w[..., :_DRIVEN])
        clock = torch.cat([bias + drift * u.duration[:, None, None], drift, inter_system], -1)
        return torch.cat([motion, clock + w[..., _DRIVEN:] @ self._clock_gain(u.duration).mT], -1)

    @override
    def noise_gain(self, u: TightMemsInputs) -> Tensor:
        motion, clock = self.motion.noise_gain(u.increments), self._clock_gain(u.duration)
        upper_right = motion.new_zeros(motion.shape[0], motion.shape[1], _CLOCK)
        lower_left = motion.new_zeros(motion.shape[0], _CLOCK, motion.shape[2])
        rows = [[motion, upper_right], [lower_left, clock]]
        return torch.cat([torch.cat(row, -1) for row in rows], -2)

    def _clock_gain(self, duration: Tensor) -> Tensor:
        """Return the noise gain of bias, drift and inter-system bias [R or 1, 3, 3]."""
        walk = (self.other_walk * torch.sqrt(duration))[:, None, None]
        side = torch.zeros_like(walk).expand(-1, 2, 1)
        rows = [[self.clock.noise_gain(duration), side], [side.mT, walk]]
        return torch.cat([torch.cat(row, -1) for row in rows], -2)

    @override
    def observation(self, x: Tensor, u: TightMemsInputs) -> Distribution:
        v, p = x[..., 4:7], x[..., 7:10]
        bias, drift, inter_system = x[..., _MOTION:].split(1, -1)
        reach = u.reach.unsqueeze(1)
        relative = (p.square().sum(-1, keepdim=True) / reach - 2 * p @ u.line.mT) / reach
        root = torch.sqrt(1 + relative)
        difference = reach * relative / (1 + root)  # r - reach, without the cancellation
        r = reach * root
        # (e - line).V and e.v, with e = (reach line - x) / r
        line_rate = (u.line * u.velocity).sum(-1).unsqueeze(1)
        satellite_rate = -(difference * line_rate + p @ u.velocity.mT) / r
        approach = (reach * (v @ u.line.mT) - (v * p).sum(-1, keepdim=True)) / r
        ranges = difference + bias + inter_system * u.other_system.unsqueeze(1)
        rates = satellite_rate - approach + drift
        sd = torch.cat([self.range.sd(u.range_sd), self.rate.sd(u.rate_sd)], -1)
        return independent_normal(torch.cat([ranges, rates], -1), sd.unsqueeze(1))

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        motion = self.motion.assemble(truth)
        missing = motion.new_full((*motion.shape[:-1], 1), torch.nan)
        clocks = [truth.get(name, missing) for name in list(self.groups)[len(self.motion.groups) :]]
        return torch.cat([motion, *clocks], -1)
