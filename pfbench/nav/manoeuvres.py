"""Trajectories from manoeuvres: a sequence of segments, or sums of smooth ramps."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.nav.trajectory import (
    NODES,
    MotionProfile,
    TrajectoryData,
    TrajectorySource,
    TrajectoryStart,
    integrate_motion,
)

# A segment changes speed, climb angle and heading by a given amount. Speed changes linearly (or
# smoothly). Angles change by the quintic u^3 (10 - 15 u + 6 u^2), so angular rate and angular
# acceleration are continuous and zero at the joints [ours].
#
# Manoeuvres, which are written in YAML, use degrees where an argument name ends in `_deg`. A
# `ManoeuvreSegment` is in SI units and radians.


@dataclass(frozen=True)
class ManoeuvreSegment:
    """A section of motion and the changes along it.

    Attributes:
        duration_s: Duration, s.
        speed: Change of speed, m/s.
        climb: Change of flight-path angle, rad.
        heading: Change of heading (clockwise from North), rad.
        smooth: Whether the speed changes by the quintic too, without a step in acceleration.
            Otherwise it is linear in time.
    """

    duration_s: float
    speed: float = 0.0
    climb: float = 0.0
    heading: float = 0.0
    smooth: bool = False

    def __post_init__(self) -> None:
        require_ranges("", self, duration_s="(0, inf]")


Manoeuvre: TypeAlias = tuple[ManoeuvreSegment, ...]


@dataclass(frozen=True)
class ManoeuvreTrajectory(TrajectorySource):
    """Segments in sequence.

    Attributes:
        segments: Manoeuvres and single segments, see `generate_manoeuvres`.
        start: Initial position, speed and heading.
    """

    segments: Sequence[Any]
    start: TrajectoryStart

    @property
    def duration_s(self) -> float:
        """Duration of all segments, s."""
        return sum(segment.duration_s for segment in _list_segments(self.segments))

    @override
    def generate(self, rate: float) -> TrajectoryData:
        return generate_manoeuvres(self.segments, self.start, rate)


def accelerate(acceleration: float, duration_s: float, smooth: bool = False) -> Manoeuvre:
    """Accelerate along the track, or brake if the acceleration is negative.

    Args:
        acceleration: Mean acceleration, m/s^2.
        duration_s: Duration, s.
        smooth: Whether the acceleration is continuous. Otherwise it is constant.
    """
    return (ManoeuvreSegment(duration_s, speed=acceleration * duration_s, smooth=smooth),)


def cruise(duration_s: float) -> Manoeuvre:
    """Fly straight at the present speed and climb angle."""
    return (ManoeuvreSegment(duration_s),)


def climb(angle_deg: float, pitch_duration_s: float, hold_duration_s: float) -> Manoeuvre:
    """Pitch to a climb angle, hold it, pitch back. A negative angle descends.

    Args:
        angle_deg: Climb angle.
        pitch_duration_s: Duration of each pitch change, s.
        hold_duration_s: Duration at the climb angle, s.
    """
    angle = math.radians(angle_deg)
    return (
        ManoeuvreSegment(pitch_duration_s, climb=angle),
        ManoeuvreSegment(hold_duration_s),
        ManoeuvreSegment(pitch_duration_s, climb=-angle),
    )


def turn(angle_deg: float, duration_s: float) -> Manoeuvre:
    """Fly a coordinated turn.

    Args:
        angle_deg: Change of heading, positive to the right.
        duration_s: Duration, s.
    """
    return (ManoeuvreSegment(duration_s, heading=math.radians(angle_deg)),)


def generate_manoeuvres(
    segments: Iterable[ManoeuvreSegment | Iterable[ManoeuvreSegment]],
    start: TrajectoryStart,
    rate: float,
) -> TrajectoryData:
    """Fly segments in sequence.

    Returns truth and ideal increments, float64.
    """
    plan = _list_segments(segments)
    counts = _sample_counts(plan, rate)
    at_samples = _profile(plan, counts, start, rate, torch.zeros(1, dtype=torch.float64))
    last = _profile(
        plan[-1:],
        counts[-1:],
        _state_after(plan[:-1], start),
        rate,
        torch.ones(1, dtype=torch.float64),
    )
    samples = MotionProfile(
        *(torch.cat([a[:, 0], b[-1:, 0]]) for a, b in zip(at_samples, last, strict=True))
    )
    return integrate_motion(samples, _profile(plan, counts, start, rate, NODES), start, rate)


def _list_segments(items: Iterable[Any]) -> list[ManoeuvreSegment]:
    """List the segments of manoeuvres and single segments."""
    return [s for item in items for s in ([item] if isinstance(item, ManoeuvreSegment) else item)]


class _ProfileState(NamedTuple):
    """Speed, climb angle and heading (rad) at the start of a segment."""

    speed: float
    climb: float
    heading: float


def _sample_counts(plan: list[ManoeuvreSegment], rate: float) -> list[int]:
    if not plan:
        raise ValueError("segments must not be empty. Give at least one manoeuvre.")
    for k, segment in enumerate(plan):
        samples = segment.duration_s * rate
        # a step of acceleration inside a sample would be integrated wrongly without a message
        if abs(samples - round(samples)) > 1e-6 or round(samples) < 1:
            raise ValueError(
                f"the duration of segment {k} must be a multiple of {1 / rate:.6g} s "
                f"at rate={rate}, got {segment.duration_s} s ({samples:.4f} samples). Change it."
            )
    return [round(segment.duration_s * rate) for segment in plan]


def _state_after(
    plan: list[ManoeuvreSegment], start: TrajectoryStart | _ProfileState
) -> _ProfileState:
    if isinstance(start, TrajectoryStart):
        start = _ProfileState(start.speed, 0.0, math.radians(start.heading_deg))
    return _ProfileState(
        start.speed + math.fsum(s.speed for s in plan),
        start.climb + math.fsum(s.climb for s in plan),
        start.heading + math.fsum(s.heading for s in plan),
    )


def _profile(
    plan: list[ManoeuvreSegment],
    counts: list[int],
    start: TrajectoryStart | _ProfileState,
    rate: float,
    offsets: Tensor,
) -> MotionProfile:
    """Compute the motion [n, m] at every sample plus `offsets` [m] of a sample."""
    rows = []
    for k, (segment, count) in enumerate(zip(plan, counts, strict=True)):
        begin = _state_after(plan[:k], start)
        length = count / rate
        u = (torch.arange(count, dtype=torch.float64)[:, None] + offsets) / count
        s = u**3 * (10 - 15 * u + 6 * u**2)
        s1 = 30 * u**2 * (1 - u) ** 2 / length
        s2 = 60 * u * (1 - u) * (1 - 2 * u) / length**2
        v, v1 = (s, s1) if segment.smooth else (u, torch.full_like(u, 1 / length))
        speed = (begin.speed + segment.speed * v, segment.speed * v1)
        angles = (begin.climb + segment.climb * s, segment.climb * s1)
        rows.append(
            (
                *speed,
                *angles,
                begin.heading + segment.heading * s,
                segment.heading * s1,
                segment.heading * s2,
            )
        )
    return MotionProfile(*(torch.cat(column) for column in zip(*rows, strict=True)))


# --------------------------------------------------------------------------------------------------
# Trajectories from ramps: sums of smooth changes of speed, angles and climb rate.


@dataclass(frozen=True)
class _Ramp(ABC):
    """A smooth change between two times.

    Attributes:
        start_s: Start time, s.
        end_s: End time, s.
        change: In the unit of the changing quantity.
    """

    start_s: float
    end_s: float
    change: float

    def __post_init__(self) -> None:
        require(
            self.end_s > self.start_s,
            "end_s",
            f"be later than start_s = {self.start_s}",
            self.end_s,
            "Change one of them.",
        )

    @abstractmethod
    def evaluate(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return value and two time derivatives at times t s."""


@dataclass(frozen=True)
class CosineRamp(_Ramp):
    """A change by half a cosine, 1/2 - 1/2 cos(pi u), between two times.

    The rate is continuous and the second derivative is not.
    """

    @override
    def evaluate(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        k = math.pi / (self.end_s - self.start_s)
        a = k * (t.clamp(self.start_s, self.end_s) - self.start_s)
        inside = ((t > self.start_s) & (t < self.end_s)).to(t)
        c = 0.5 * self.change
        return (
            c * (1 - torch.cos(a)),
            c * k * torch.sin(a) * inside,
            c * k * k * torch.cos(a) * inside,
        )


@dataclass(frozen=True)
class CycloidRamp(_Ramp):
    """A change with a raised-cosine rate, u - sin(2 pi u) / 2 pi, between two times.

    Two derivatives are continuous.
    """

    @override
    def evaluate(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        length = self.end_s - self.start_s
        u = (t.clamp(self.start_s, self.end_s) - self.start_s) / length
        turn = 2 * math.pi * u
        value = self.change * (u - torch.sin(turn) / (2 * math.pi))
        rate = self.change / length * (1 - torch.cos(turn))
        return value, rate, self.change * 2 * math.pi / length**2 * torch.sin(turn)


@dataclass(frozen=True)
class RampTrajectory(TrajectorySource):
    """A motion with speed, angles and climb rate as sums of ramps.

    Attributes:
        start: Initial position, speed, heading.
        duration_s: Duration, s.
        speed: Changes of speed, m/s. Changes of the horizontal speed with `climb_rate_changes`.
        climb_deg: Changes of the flight-path angle. Not together with `climb_rate_changes`.
        heading_deg: Changes of heading, clockwise.
        climb_rate_changes: Changes of the vertical speed, m/s.

    Raises:
        ValueError: If `climb_deg` and `climb_rate_changes` are both given. On `generate`, if the
            speed is negative, the duration is not a whole number of samples, or a CosineRamp begins
            or ends between two samples.
    """

    start: TrajectoryStart
    duration_s: float
    speed: Sequence[_Ramp] = ()
    climb_deg: Sequence[_Ramp] = ()
    heading_deg: Sequence[_Ramp] = ()
    climb_rate_changes: Sequence[_Ramp] = ()

    def __post_init__(self) -> None:
        require(
            not self.climb_deg or not self.climb_rate_changes,
            "trajectory.climb_deg and trajectory.climb_rate_changes",
            "not both be set",
            "both",
            "Give one of them.",
        )

    @override
    def generate(self, rate: float) -> TrajectoryData:
        n = round(self.duration_s * rate)
        require(
            not n < 1 and (not abs(n - self.duration_s * rate) > 1e-06),
            "trajectory.duration_s",
            f"be a whole number of samples at rate={rate}",
            self.duration_s,
            "Change it.",
        )
        for ramp in (*self.speed, *self.climb_deg, *self.heading_deg, *self.climb_rate_changes):
            if isinstance(ramp, CosineRamp):
                _check_on_samples(ramp, self.duration_s, rate)
        steps = torch.arange(n + 1, dtype=torch.float64)
        nodes = self.compute_motion((steps[:-1, None] + NODES) / rate)
        return integrate_motion(self.compute_motion(steps / rate), nodes, self.start, rate)

    def compute_motion(self, t: Tensor) -> MotionProfile:
        """Compute the motion at times t s."""
        speed, speed1, _ = _total(self.speed, t, self.start.speed)
        heading, heading1, heading2 = _total(self.heading_deg, t, self.start.heading_deg)
        angles = (torch.deg2rad(a) for a in (heading, heading1, heading2))
        if not self.climb_rate_changes:
            climb, climb1, _ = _total(self.climb_deg, t, 0.0)
            return MotionProfile(
                speed, speed1, torch.deg2rad(climb), torch.deg2rad(climb1), *angles
            )
        if speed.min() < 0:  # the length of the velocity does not show it
            raise ValueError(
                f"horizontal speed must not be negative, got {speed.min():.3f} m/s. "
                "Brake less, or start faster."
            )
        up, up1, _ = _total(self.climb_rate_changes, t, 0.0)
        along = torch.hypot(speed, up)
        safe = along.clamp(min=1e-9)
        along1 = torch.where(along > 0, (speed * speed1 + up * up1) / safe, speed1)
        climb1 = (speed * up1 - up * speed1) / safe.square()
        return MotionProfile(along, along1, torch.atan2(up, speed), climb1, *angles)


def _check_on_samples(ramp: CosineRamp, duration: float, rate: float) -> None:
    for name, time in (("start_s", ramp.start_s), ("end_s", ramp.end_s)):
        samples = time * rate
        # the second derivative, and with it the roll rate, jumps: quadrature over it is wrong
        if 0 < time < duration and abs(samples - round(samples)) > 1e-6:
            raise ValueError(
                f"{name} of a CosineRamp must be a multiple of {1 / rate:.6g} s at rate={rate}, "
                f"got {time}. Change it, or use a CycloidRamp."
            )


def _total(ramps: Sequence[_Ramp], t: Tensor, start: float) -> tuple[Tensor, Tensor, Tensor]:
    """Sum ramps from a start value, with derivatives."""
    value, rate, second = torch.full_like(t, start), torch.zeros_like(t), torch.zeros_like(t)
    for ramp in ramps:
        change, change1, change2 = ramp.evaluate(t)
        value, rate, second = value + change, rate + change1, second + change2
    return value, rate, second
