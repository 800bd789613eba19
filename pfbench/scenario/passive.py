"""An aircraft that locates an emitter by listening alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.chart import wrap
from pfbench.draws import MonteCarlo
from pfbench.model.passive_location import Platform, level_attitude, look, relative
from pfbench.noise.regimes import Regime, step_process
from pfbench.record import Channels, Episode, Record
from pfbench.scenario.first_look import FirstFix, Look, Start

_KINDS = ("angle", "angle", "rate", "rate", "rate")


@dataclass(frozen=True)
class AirborneLocation:
    """Level flight on a straight line past an emitter that wanders on the ground [Pu and Qin, "Application of quasi Monte Carlo
    polymerization re-sampling particle filter algorithm in airborne passive location", section 4].

    The first look, at time 0, gives each run its initial law and is not used again: the record holds the looks after it. [ours]
    Filters are given the aircraft's position as its navigation has it, white errors at each look, and a carrier frequency that
    is wrong by as much throughout a run; its velocity and attitude are exact. The track is the emitter's in the ground frame, and
    the sheet has the horizontal `range` [T] in m that it would have from the aircraft without its random acceleration, the same
    in all runs (of which it is wrong by 0.1 % at most), by which errors become relative.

    Args:
        target_position, target_velocity: of the emitter at time 0, m and m/s [2]; its height is 0.
        aircraft_position, aircraft_velocity: at time 0, m and m/s [3].
        measurement_sd: bearing, elevation rad, their rates rad/s, Doppler rate Hz/s [5].
        own_position_sd: of the aircraft's navigation, m [3].
        carrier, carrier_sd: of the emitter, and of what filters believe of it, Hz.
        acceleration_sd: of the emitter's white acceleration, m/s^2.
        velocity_sd: of the emitter's unknown velocity in the initial law, about 0, m/s per axis.
        range_limits: between which the first range is clipped, m.
        steps: looks after the first.
        interval: s between looks.
        accelerating: the true Doppler rate feels the emitter's acceleration over the interval before (the models never do).
        start: what filters make of the first look: the printed fix, or its moments.
        drawn: each run draws its emitter from what `Moments` believes before the first look: in the direction of
            `target_position` at a horizontal range between the limits, all as likely, with a velocity about 0.

    Raises:
        ValueError: an argument of the wrong length or sign; an aircraft without course; on drawing, a regime that hides the first
            look.
    """

    target_position: Sequence[float]
    target_velocity: Sequence[float]
    aircraft_position: Sequence[float]
    aircraft_velocity: Sequence[float]
    measurement_sd: Sequence[float]
    own_position_sd: Sequence[float]
    carrier: float
    carrier_sd: float
    acceleration_sd: float = 0.1
    velocity_sd: float = 30.0
    range_limits: Sequence[float] = (10e3, 500e3)
    steps: int = 100
    interval: float = 1.0
    accelerating: bool = False
    start: Start = field(default_factory=FirstFix)
    drawn: bool = False

    def __post_init__(self) -> None:
        sizes = {"target_position": 2, "target_velocity": 2, "aircraft_position": 3, "aircraft_velocity": 3}
        sizes |= {"measurement_sd": 5, "own_position_sd": 3, "range_limits": 2}
        for name, size in sizes.items():
            values = getattr(self, name)
            if len(values) != size or not all(map(math.isfinite, values)):
                raise ValueError(f"scenario.{name}={list(values)}: give {size} numbers")
        for name in ("carrier", "velocity_sd", "interval", "measurement_sd"):
            values = getattr(self, name)
            if not min(values if isinstance(values, Sequence) else [values]) > 0.0:
                raise ValueError(f"scenario.{name}={values}: give positive numbers")
        if min(self.carrier_sd, self.acceleration_sd, *self.own_position_sd) < 0.0:
            raise ValueError("scenario.carrier_sd, acceleration_sd and own_position_sd are deviations: give 0 or more")
        if not 0.0 < self.range_limits[0] < self.range_limits[1]:
            raise ValueError(f"scenario.range_limits={list(self.range_limits)}: give [nearest, farthest], 0 < nearest < farthest")
        if not math.hypot(*self.aircraft_velocity[:2]) > 0.0:
            raise ValueError(f"scenario.aircraft_velocity={list(self.aircraft_velocity)}: no course; let the aircraft move")
        if self.steps < 1:
            raise ValueError(f"scenario.steps={self.steps}: give at least 1 step")

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """Worlds of these runs."""
        draws = MonteCarlo(seed, runs)
        time = self.interval * torch.arange(self.steps + 1, dtype=torch.float64)
        target, push = self._wander(noise, draws, time)
        true, told = self._platforms(draws, time)
        y = self._seen(target, push, true) + noise.errors(draws, Channels(_vector(self.measurement_sd), _KINDS, (0,) * 5), time)
        y = torch.cat([wrap(y[..., :1]), y[..., 1:]], -1)
        if bool(torch.isnan(y[:, 0]).any()):
            raise ValueError("noise: the regime hides the first look, from which filters start; let its windows begin after 0 s")
        first = Platform(*(a[:, 0] for a in told))
        limits = self.range_limits[0], self.range_limits[1]
        start, spread, said = self.start.law(Look(y[:, 0], first, _vector(self.measurement_sd), self.velocity_sd, limits))
        record = Record(y[:, 1:], Platform(*(a[:, 1:] for a in told)), start, spread)
        truth = {"position": target[:, 1:, :2], "velocity": target[:, 1:, 2:]}
        track = torch.nn.functional.pad(truth["position"], (0, 1))
        planned = _vector(self.target_position) + time[1:, None] * _vector(self.target_velocity)
        away = (planned - true.position[0, 1:, :2]).norm(dim=-1)
        return Episode(record, time[1:], truth, track, (said,), {} if self.drawn else {"range": away})

    def _wander(self, noise: Regime, draws: MonteCarlo, time: Tensor) -> tuple[Tensor, Tensor]:
        """The emitter [R, T + 1, 4] and its acceleration over the interval before, 0 at the start [R, T + 1, 2]."""
        t = self.interval
        swell = step_process(noise, time[1:]).sqrt()[:, None]
        push = self.acceleration_sd * swell * draws.normal("world.target", self.steps, 2)
        push = torch.nn.functional.pad(push, (0, 0, 1, 0))
        place, motion = self._emitters(draws)
        velocity = motion + t * push.cumsum(1)
        # a step moves it by T v + T^2/2 a from the velocity before, that is by T v - T^2/2 a from the one after
        position = place + (t * velocity - 0.5 * t * t * push)[:, 1:].cumsum(1)
        return torch.cat([torch.cat([place.expand(len(push), 1, 2), position], 1), velocity], -1), push

    def _emitters(self, draws: MonteCarlo) -> tuple[Tensor, Tensor]:
        """Place and velocity at time 0, [2] or [R, 1, 2]."""
        place, motion = _vector(self.target_position), _vector(self.target_velocity)
        if not self.drawn:
            return place, motion
        here = _vector(self.aircraft_position)[:2]
        ahead = (place - here) / (place - here).norm()
        near, far = self.range_limits
        away = near + (far - near) * draws.uniform("world.emitter.range", 1, 1)
        return here + away * ahead, self.velocity_sd * draws.normal("world.emitter.velocity", 1, 2)

    def _platforms(self, draws: MonteCarlo, time: Tensor) -> tuple[Platform, Platform]:
        """The aircraft as it is [1, T + 1, ...], and as filters are given it [R or 1, T + 1, ...]."""
        velocity = _vector(self.aircraft_velocity)
        place = _vector(self.aircraft_position) + time[:, None] * velocity
        attitude = level_attitude(velocity).expand(1, len(time), 3, 3)
        carrier = torch.full((1, len(time)), self.carrier, dtype=torch.float64)
        true = Platform(place.unsqueeze(0), velocity.expand(1, len(time), 3), attitude, carrier)
        slip = _vector(self.own_position_sd) * draws.normal("world.own_position", len(time), 3)
        shift = self.carrier_sd * draws.normal("world.carrier", 1, 1)[:, 0]
        return true, true._replace(position=true.position + slip, carrier=carrier + shift)

    def _seen(self, target: Tensor, push: Tensor, true: Platform) -> Tensor:
        """What would be measured without errors [R, T + 1, 5]; the axis of looks serves as that of particles."""
        at_all = Platform(true.position[0], true.velocity[0], true.attitude[0], true.carrier[0])
        p, v = relative(target.transpose(0, 1), at_all)  # [T + 1, R, 3]
        a = torch.nn.functional.pad(push, (0, 1)).transpose(0, 1) @ at_all.attitude.mT if self.accelerating else None
        return look(p, v, at_all.carrier.unsqueeze(-1), a).transpose(0, 1)


def _vector(values: Sequence[float]) -> Tensor:
    return torch.tensor(list(values), dtype=torch.float64)
