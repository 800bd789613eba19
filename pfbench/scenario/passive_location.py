"""Passive location of an emitter from an aircraft."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import wrap_angle
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.model.passive_location import (
    PassiveLocation,
    PlatformInputs,
    compute_level_attitude,
    predict_bearing,
    relative_motion,
)
from pfbench.noise.base import NoiseRegime, process_variance_factors
from pfbench.scenario.base import Scenario
from pfbench.scenario.emitter_prior import EmitterPrior, FirstMeasurement, LinearisedEmitterPrior
from pfbench.scenario.recording_regime import regime_name

_KINDS = ("angle", "angle", "rate", "rate", "rate")


@dataclass(frozen=True)
class PassiveLocationScenario(Scenario):
    """Straight level flight past a manoeuvring emitter on the ground.

    The scenario is from Pu and Qin, "Application of quasi Monte Carlo polymerization re-sampling
    particle filter algorithm in airborne passive location", section 4. The first measurement, at
    time 0, defines the initial distribution of each run. The record contains the later measurements
    only. [ours]

    Filters receive the aircraft position of the navigation system, with a white error at each step.
    The assumed carrier frequency has an error that is constant during a run. Velocity and attitude
    of the aircraft are exact. The track is the emitter position in the ground frame.

    The datasheet contains the horizontal `range`, m, [T], of an emitter without random
    acceleration. It is common to all runs, is accurate to 0.1 %, and defines relative errors.

    Attributes:
        target_position: Emitter position at time 0, m, [2]. The height is 0.
        target_velocity: Emitter velocity at time 0, m/s, [2].
        aircraft_position: Aircraft position at time 0, m, [3].
        aircraft_velocity: Aircraft velocity, m/s, [3].
        measurement_sd: Standard deviations of bearing and elevation, rad; their rates, rad/s; and
            Doppler rate, Hz/s, [5].
        ownship_position_sd: Position error of the aircraft's navigation, m, [3].
        carrier_frequency: Carrier frequency of the emitter, Hz.
        carrier_frequency_sd: Error of the carrier frequency assumed by the filters, Hz.
        acceleration_sd: White acceleration of the emitter, m/s^2.
        velocity_sd: Emitter velocity about 0 in the initial distribution, m/s per axis.
        range_limits: Smallest and largest range of the first measurement, m, [2].
        steps: Measurements after the first.
        interval_s: Time between measurements, s.
        doppler_includes_acceleration: Whether the true Doppler rate includes the acceleration of
            the emitter over the previous interval. The models neglect it.
        emitter_prior: Initial distribution of the filters, given the first measurement.
        randomise_emitter: Whether each run draws its emitter from the prior of
            `QuadratureEmitterPrior`. The range is uniform between its limits, in the direction of
            `target_position`. The velocity is normal about 0.

    Raises:
        ValueError: If an argument has the wrong length or sign, or the aircraft is without horizontal
            velocity. `draw` raises it if the regime removes the first measurement.
    """

    target_position: Sequence[float]
    target_velocity: Sequence[float]
    aircraft_position: Sequence[float]
    aircraft_velocity: Sequence[float]
    measurement_sd: Sequence[float]
    ownship_position_sd: Sequence[float]
    carrier_frequency: float
    carrier_frequency_sd: float
    acceleration_sd: float = 0.1
    velocity_sd: float = 30.0
    range_limits: Sequence[float] = (10e3, 500e3)
    steps: int = 100
    interval_s: float = 1.0
    doppler_includes_acceleration: bool = False
    emitter_prior: EmitterPrior = field(default_factory=LinearisedEmitterPrior)
    randomise_emitter: bool = False
    channel_names, input_type = PassiveLocation.channel_names, PlatformInputs

    def __post_init__(self) -> None:
        sizes = {
            "target_position": 2,
            "target_velocity": 2,
            "aircraft_position": 3,
            "aircraft_velocity": 3,
        }
        sizes |= {"measurement_sd": 5, "ownship_position_sd": 3, "range_limits": 2}
        for name, size in sizes.items():
            values = getattr(self, name)
            if len(values) != size or not all(map(math.isfinite, values)):
                raise ValueError(
                    f"scenario.{name} must have {size} finite numbers, got {list(values)}. "
                    "Correct the list."
                )
        for name in ("carrier_frequency", "velocity_sd", "interval_s", "measurement_sd"):
            values = getattr(self, name)
            if not min(values if isinstance(values, Sequence) else [values]) > 0.0:
                raise ValueError(
                    f"scenario.{name} must be positive, got {values}. Increase scenario.{name}."
                )
        for name in ("carrier_frequency_sd", "acceleration_sd", "ownship_position_sd"):
            values = getattr(self, name)
            if min(values if isinstance(values, Sequence) else [values]) < 0.0:
                raise ValueError(
                    f"scenario.{name} must be at least 0, got {values}. Use 0 for no error."
                )
        if not 0.0 < self.range_limits[0] < self.range_limits[1]:
            raise ValueError(
                "scenario.range_limits must be [nearest, farthest] with 0 < nearest < farthest, "
                f"got {list(self.range_limits)}. Correct the limits."
            )
        if not math.hypot(*self.aircraft_velocity[:2]) > 0.0:
            raise ValueError(
                "scenario.aircraft_velocity must have a horizontal component, "
                f"got {list(self.aircraft_velocity)}. Set an East or North velocity."
            )
        if self.steps < 1:
            raise ValueError(
                f"scenario.steps must be at least 1, got {self.steps}. Increase scenario.steps."
            )

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        draws = PhiloxStream(seed, runs)
        time = self.interval_s * torch.arange(self.steps + 1, dtype=torch.float64)
        target, acceleration = self._simulate_emitter(noise, draws, time)
        true, assumed = self._simulate_platform(draws, time)
        y = self._predict(target, acceleration, true) + noise.draw_errors(
            draws, MeasurementChannels(_vector(self.measurement_sd), _KINDS, (0,) * 5), time
        )
        y = torch.cat([wrap_angle(y[..., :1]), y[..., 1:]], -1)
        if bool(torch.isnan(y[:, 0]).any()):
            raise ValueError(
                "noise must not remove the first measurement, from which filters start, "
                f"got {regime_name(noise)}. Start the windows after 0 s."
            )
        first = PlatformInputs(*(a[:, 0] for a in assumed))
        limits = self.range_limits[0], self.range_limits[1]
        start, spread, note = self.emitter_prior.initial_moments(
            FirstMeasurement(y[:, 0], first, _vector(self.measurement_sd), self.velocity_sd, limits)
        )
        record = Record(y[:, 1:], PlatformInputs(*(a[:, 1:] for a in assumed)), start, spread)
        truth = {"position": target[:, 1:, :2], "velocity": target[:, 1:, 2:]}
        track = torch.nn.functional.pad(truth["position"], (0, 1))
        nominal = _vector(self.target_position) + time[1:, None] * _vector(self.target_velocity)
        nominal_range = (nominal - true.position[0, 1:, :2]).norm(dim=-1)
        return Episode(
            record,
            time[1:],
            truth,
            track,
            (note,),
            {} if self.randomise_emitter else {"range": nominal_range},
        )

    def _simulate_emitter(
        self, noise: NoiseRegime, draws: PhiloxStream, time: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Simulate the emitter [R, T + 1, 4] and its acceleration [R, T + 1, 2].

        The acceleration applies to the previous interval. It is 0 at the start.
        """
        t = self.interval_s
        factor = process_variance_factors(noise, time[1:]).sqrt()[:, None]
        acceleration = self.acceleration_sd * factor * draws.normal("world.target", self.steps, 2)
        acceleration = torch.nn.functional.pad(acceleration, (0, 0, 1, 0))
        initial_position, initial_velocity = self._initial_emitter(draws)
        velocity = initial_velocity + t * acceleration.cumsum(1)
        # a step adds T v + T^2/2 a with its first velocity v, so T v - T^2/2 a with its last velocity v
        position = initial_position + (t * velocity - 0.5 * t * t * acceleration)[:, 1:].cumsum(1)
        return torch.cat(
            [torch.cat([initial_position.expand(len(acceleration), 1, 2), position], 1), velocity],
            -1,
        ), acceleration

    def _initial_emitter(self, draws: PhiloxStream) -> tuple[Tensor, Tensor]:
        """Return position and velocity at time 0, [2] or [R, 1, 2]."""
        position, velocity = _vector(self.target_position), _vector(self.target_velocity)
        if not self.randomise_emitter:
            return position, velocity
        aircraft = _vector(self.aircraft_position)[:2]
        direction = (position - aircraft) / (position - aircraft).norm()
        near, far = self.range_limits
        distance = near + (far - near) * draws.uniform("world.emitter.range", 1, 1)
        velocity = self.velocity_sd * draws.normal("world.emitter.velocity", 1, 2)
        return aircraft + distance * direction, velocity

    def _simulate_platform(
        self, draws: PhiloxStream, time: Tensor
    ) -> tuple[PlatformInputs, PlatformInputs]:
        """Simulate the true aircraft [1, T + 1, ...] and the filter input [R, T + 1, ...]."""
        velocity = _vector(self.aircraft_velocity)
        position = _vector(self.aircraft_position) + time[:, None] * velocity
        attitude = compute_level_attitude(velocity).expand(1, len(time), 3, 3)
        carrier = torch.full((1, len(time)), self.carrier_frequency, dtype=torch.float64)
        true = PlatformInputs(
            position.unsqueeze(0), velocity.expand(1, len(time), 3), attitude, carrier
        )
        position_error = _vector(self.ownship_position_sd) * draws.normal(
            "world.own_position", len(time), 3
        )
        carrier_error = self.carrier_frequency_sd * draws.normal("world.carrier", 1, 1)[:, 0]
        return true, true._replace(
            position=true.position + position_error, carrier=carrier + carrier_error
        )

    def _predict(self, target: Tensor, acceleration: Tensor, true: PlatformInputs) -> Tensor:
        """Compute the measurements without errors, [R, T + 1, 5]."""
        # the axis of runs takes the place of the axis of particles
        platform = PlatformInputs(
            true.position[0], true.velocity[0], true.attitude[0], true.carrier[0]
        )
        p, v = relative_motion(target.transpose(0, 1), platform)  # [T + 1, R, 3]
        a = (
            torch.nn.functional.pad(acceleration, (0, 1)).transpose(0, 1) @ platform.attitude.mT
            if self.doppler_includes_acceleration
            else None
        )
        return predict_bearing(p, v, platform.carrier.unsqueeze(-1), a).transpose(0, 1)


def _vector(values: Sequence[float]) -> Tensor:
    return torch.tensor(list(values), dtype=torch.float64)
