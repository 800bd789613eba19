"""Antenna with a receiver clock, measured by pseudoranges and range rates, without other sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive, check_three_positive, check_tuning
from pfbench.model.base import StateSpaceModel
from pfbench.model.relative_ranges import RAW_CHANNELS, predict_raw
from pfbench.model.strapdown import block_diagonal
from pfbench.model.strapdown_tuning import RangeErrorModel
from pfbench.nav.ranging import ReceiverClock


class RawGnssInputs(NamedTuple):
    """Inputs of a step: its duration, and S satellites at its end.

    Geometry is relative to a position that is fixed to the ground.

    Attributes:
        duration: [R or 1, T], s.
        line: Unit vectors to the satellites, East, North, Up, [R or 1, T, S, 3].
        reach: Distances of the satellites, [R or 1, T, S], m.
        velocity: Velocities of the satellites, East, North, Up, [R or 1, T, S, 3], m/s.
        other_system: 1 for a satellite of a different system than the clock's, else 0, [R or 1, T, S].
        range_sd: Stated standard deviation, [R or 1, T, S], m.
        rate_sd: Stated standard deviation, [R or 1, T, S], m/s.
    """

    duration: Tensor
    line: Tensor
    reach: Tensor
    velocity: Tensor
    other_system: Tensor
    range_sd: Tensor
    rate_sd: Tensor


@dataclass(frozen=True)
class RawGnssTuning:
    """Parameters that filters assume.

    Attributes:
        acceleration_density: Root density of the white acceleration, East, North, Up, m/s^2/sqrt(Hz). A car
            that brakes needs 1 to 3, a standing antenna 0.01.
        initial_velocity_sd: East, North, Up, m/s.
        initial_position_sd: East, North, Up, m.
        clock: Receiver clock, relative to its nominal course.
        range: Error model of the ranges.
        rate: Error model of the rates.
        inter_system_sd: Initial standard deviation of the second system's clock relative to the first system's, about
            its nominal value, m.
        inter_system_walk: Random walk of the inter-system bias, m/sqrt(s).
    """

    acceleration_density: Sequence[float]
    initial_velocity_sd: Sequence[float]
    initial_position_sd: Sequence[float]
    clock: ReceiverClock
    range: RangeErrorModel
    rate: RangeErrorModel
    inter_system_sd: float = 3.0
    inter_system_walk: float = 0.02

    @property
    def initial_sd(self) -> Tensor:
        """Standard deviations of the initial state, SI units, [9].

        Raises:
            ValueError: If a number is not positive, or a list does not have three.
        """
        blocks = [
            check_three_positive(f"tuning.{name}", getattr(self, name))
            for name in ("initial_position_sd", "initial_velocity_sd")
        ]
        clock = [self.clock.bias_sd, self.clock.drift_sd, self.inter_system_sd]
        return torch.cat([*blocks, check_positive("tuning.inter_system_sd", clock)])


class RawGnss(StateSpaceModel):
    """An antenna that moves with white acceleration, and a receiver clock.

    State [9]: position and velocity (East, North, Up), bias m and drift m/s of the receiver clock, and the
    inter-system bias m. A step has duration T, and n is the integral of the acceleration. Then v' = v + n and
    p' = p + v T + n T / 2 + m. The part m of the position, of variance q T^3 / 12, is independent of n.
    Clock states are differences from a nominal course that the record subtracts.

    The origin is the fixed position, at rest. Recorded scenarios provide the start of each run.

    Args:
        tuning: Standard deviations and densities.

    Raises:
        ValueError: If a density or standard deviation is not positive.
    """

    channel_names = RAW_CHANNELS
    input_type = RawGnssInputs
    noise_dim = 9
    acceleration_density: Tensor
    other_walk: Tensor
    p0: Tensor
    choices = (
        "errors of code and Doppler are modelled as white; multipath is correlated, so their standard deviations are "
        "inflated",
    )

    def __init__(self, tuning: RawGnssTuning) -> None:
        super().__init__()
        check_tuning(tuning, RawGnssTuning)
        self.clock, self.range, self.rate = tuning.clock, tuning.range, tuning.rate
        density = check_three_positive("tuning.acceleration_density", tuning.acceleration_density)
        walk = check_positive("tuning.inter_system_walk", [tuning.inter_system_walk])
        self.register_buffer("acceleration_density", density)
        self.register_buffer("other_walk", walk)
        self.register_buffer("p0", tuning.initial_sd)
        axes = [f"{group}_{axis}" for group in ("position", "velocity") for axis in ("E", "N", "U")]
        self.names = (*axes, "clock_bias", "clock_drift", "inter_system_bias")
        self.units = ("m",) * 3 + ("m/s",) * 3 + ("m", "m/s", "m")
        clocks = {name: (6 + i,) for i, name in enumerate(self.names[6:])}
        self.groups = {"position": (0, 1, 2), "velocity": (3, 4, 5), **clocks}

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: RawGnssInputs, w: Tensor) -> Tensor:
        position, velocity, bias, drift, inter_system = x.split([3, 3, 1, 1, 1], -1)
        duration = u.duration[:, None, None]
        parts = [
            position + velocity * duration,
            velocity,
            bias + drift * duration,
            drift,
            inter_system,
        ]
        return torch.cat(parts, -1) + w @ self.noise_gain(u).mT

    @override
    def noise_gain(self, u: RawGnssInputs) -> Tensor:
        duration = u.duration
        push = torch.diag_embed(self.acceleration_density * torch.sqrt(duration)[:, None])
        half = 0.5 * push * duration[:, None, None]
        rows = [half, half / 3.0**0.5], [push, torch.zeros_like(push)]
        motion = torch.cat([torch.cat(row, -1) for row in rows], -2)
        walk = (self.other_walk * torch.sqrt(duration))[:, None, None]
        clock = block_diagonal(self.clock.noise_gain(duration), walk)
        return block_diagonal(motion, clock)

    @override
    def observation(self, x: Tensor, u: RawGnssInputs) -> Distribution:
        ranges, rates = predict_raw(x[..., :3], x[..., 3:6], u)
        bias, drift, inter_system = x[..., 6:].split(1, -1)
        mean = torch.cat(
            [ranges + bias + inter_system * u.other_system.unsqueeze(1), rates + drift], -1
        )
        sd = torch.cat([self.range.sd(u.range_sd), self.rate.sd(u.rate_sd)], -1)
        return independent_normal(mean, sd.unsqueeze(1))
