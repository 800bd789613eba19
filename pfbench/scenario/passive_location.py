"""Passive location of an emitter from an aircraft."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import wrap_angle
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.model.passive_location import (
    SPEED_OF_LIGHT,
    PassiveLocation,
    PlatformInputs,
    compute_level_attitude,
    predict_bearing,
    relative_motion,
)
from pfbench.noise.base import NoiseRegime, process_variance_factors
from pfbench.scenario.base import Scenario, regime_name


class FirstMeasurement(NamedTuple):
    """First measurement of an emitter, with the prior information.

    Attributes:
        z: Bearing and elevation, rad; their rates, rad/s; Doppler rate, Hz/s, [R, 5].
        platform: Aircraft at that time, as given to the filters, [R or 1, ...].
        sd: Standard deviations of the measurement, [5].
        velocity_sd: Standard deviation of the emitter velocity about 0, m/s per axis.
        limits: Smallest and largest range, m.
    """

    z: Tensor
    platform: PlatformInputs
    sd: Tensor
    velocity_sd: float
    limits: tuple[float, float]


class EmitterPrior(Protocol):
    """Distribution of an emitter [x, y, vx, vy] in the ground frame."""

    def initial_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor, str]:
        """Compute the distribution given the first measurement.

        Args:
            first: First measurement, with the prior information.

        Returns:
            Mean, [R, 4], Cholesky factor of the covariance, [R, 4, 4], and a note for the report.
        """


@dataclass(frozen=True)
class LinearisedEmitterPrior(EmitterPrior):
    """Prior as printed: the measured range, with its standard deviation to first order.

    `first_fix` contains the equations.
    """

    @override
    def initial_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor, str]:
        start, spread, clipped = first_fix(*first)
        note = (
            "range of the first measurement clipped to its limits in "
            f"{int(clipped.sum())} of {len(clipped)} runs"
        )
        return start, spread, note


def first_fix(
    z: Tensor, platform: PlatformInputs, sd: Tensor, velocity_sd: float, limits: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the initial distribution of each run from its first measurement.

    The method is from Pu and Qin, section 3.2, where the covariance is given only in words. The
    range follows from the Doppler rate and the angular rates,
    r = -lambda fd' / (eps'^2 + beta'^2 cos^2 eps), clipped to the limits. The standard deviation
    along the horizontal line of sight is the first-order value for the range. It is at most a
    quarter of the interval between the limits. Across the line of sight it is range times bearing
    standard deviation. The mean velocity is 0. [ours]

    Returns mean, [R, 4], Cholesky factor of the covariance, [R, 4, 4], and a mask of runs with
    clipped range, [R]. Shapes: z [R, 5], platform [R or 1, ...].
    """
    bearing, elevation, turning, rising, doppler = z.unbind(-1)
    wavelength = SPEED_OF_LIGHT / platform.carrier
    cos = torch.cos(elevation)
    rate2 = rising.square() + (turning * cos).square()
    measured_range = -wavelength * doppler / rate2
    r = measured_range.clamp(*limits)
    slope = (wavelength / rate2).square()
    variance = slope * (
        sd[4] ** 2
        + (2.0 * doppler / rate2).square()
        * ((turning * sd[2]).square() + (rising * sd[3]).square())
    )
    along = cos * variance.sqrt().clamp(max=(limits[1] - limits[0]) / 4.0)
    ahead = torch.stack([torch.sin(bearing), torch.cos(bearing), torch.zeros_like(bearing)], -1)
    sight = torch.cat([ahead[..., :2] * cos.unsqueeze(-1), torch.sin(elevation).unsqueeze(-1)], -1)
    fix = platform.position + r.unsqueeze(-1) * (sight.unsqueeze(-2) @ platform.attitude).squeeze(
        -2
    )
    start = torch.cat([fix[..., :2], torch.zeros_like(fix[..., :2])], -1)
    u = (ahead.unsqueeze(-2) @ platform.attitude).squeeze(-2)[..., :2]
    axes = torch.stack(
        [u, torch.stack([-u[..., 1], u[..., 0]], -1)], -1
    )  # columns along and across
    root = axes * torch.stack([along, r * cos * sd[0]], -1).unsqueeze(-2)
    spread = torch.zeros(len(z), 4, 4, dtype=z.dtype) + velocity_sd * torch.eye(4, dtype=z.dtype)
    spread[:, :2, :2] = torch.linalg.cholesky(root @ root.mT)
    return start, spread, measured_range != r


_KINDS = ("angle", "angle", "rate", "rate", "rate")


@dataclass(frozen=True)
class EmitterPass:
    """Straight level flight past an emitter that moves on the ground.

    Attributes:
        target_position: Emitter position at time 0, m, [2]. The height is 0.
        target_velocity: Emitter velocity at time 0, m/s, [2].
        aircraft_position: Aircraft position at time 0, m, [3].
        aircraft_velocity: Aircraft velocity, m/s, [3].
    """

    target_position: Sequence[float]
    target_velocity: Sequence[float]
    aircraft_position: Sequence[float]
    aircraft_velocity: Sequence[float]

    def __post_init__(self) -> None:
        _require_lengths(
            self, target_position=2, target_velocity=2, aircraft_position=3, aircraft_velocity=3
        )
        require(
            math.hypot(*self.aircraft_velocity[:2]) > 0.0,
            "scenario.aircraft_velocity",
            "have a horizontal component",
            list(self.aircraft_velocity),
            "Set an East or North velocity.",
        )


def _require_lengths(scenario: EmitterPass, **lengths: int) -> None:
    """Require attributes to have so many finite numbers."""
    for name, length in lengths.items():
        values = getattr(scenario, name)
        require(
            len(values) == length and all(map(math.isfinite, values)),
            f"scenario.{name}",
            f"have {length} finite numbers",
            list(values),
            "Correct the list.",
        )


@dataclass(frozen=True)
class PassiveLocationScenario(EmitterPass, Scenario):
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
        super().__post_init__()
        _require_lengths(self, measurement_sd=5, ownship_position_sd=3, range_limits=2)
        for name in ("carrier_frequency", "velocity_sd", "interval_s", "measurement_sd"):
            values = getattr(self, name)
            require(
                min(values if isinstance(values, Sequence) else [values]) > 0.0,
                f"scenario.{name}",
                "be positive",
                values,
                f"Increase scenario.{name}.",
            )
        for name in ("carrier_frequency_sd", "acceleration_sd", "ownship_position_sd"):
            values = getattr(self, name)
            require(
                not min(values if isinstance(values, Sequence) else [values]) < 0.0,
                f"scenario.{name}",
                "be at least 0",
                values,
                "Use 0 for no error.",
            )
        require(
            0.0 < self.range_limits[0] < self.range_limits[1],
            "scenario.range_limits",
            "be [nearest, farthest] with 0 < nearest < farthest",
            list(self.range_limits),
            "Correct the limits.",
        )
        require_ranges("scenario", self, steps="[1, inf]")

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


# --------------------------------------------------------------------------------------------------
# Moments of a passively located emitter given the first measurement, by quadrature.

# ranges of the coarse search: 20 m apart at 10 km, where the elevation resolves 80 m
_COARSE_RANGES = 2000
_RUNS_PER_BATCH = 25
_LOG_LIKELIHOOD_DROP = 20.0  # below the maximum, at which the search excludes a range


@dataclass(frozen=True)
class QuadratureEmitterPrior(EmitterPrior):
    """Moments of the emitter given the first measurement, by quadrature [ours].

    Before the measurement, the horizontal range has a uniform distribution between its limits. The
    bearing is uniform, and the velocity is normal about 0. Three effects are included that the
    printed prior neglects:

    - The elevation determines the range of an emitter on the ground.
    - The emitter velocity affects the angular rates.
    - The distribution of the range is not normal. Its exact first two moments are used.

    If emitters are drawn from this prior, the mean normalised error of the start is 1 per degree of
    freedom.

    Attributes:
        ranges: Number of range nodes.
        bearings: Number of Gauss-Hermite nodes for the bearing.
        velocities: Number of Gauss-Hermite nodes for each velocity component.
    """

    ranges: int = 120
    bearings: int = 5
    velocities: int = 5

    @override
    def initial_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor, str]:
        # a run has many nodes, so that batches limit the memory
        platform = [leaf.expand(len(first.z), *leaf.shape[1:]) for leaf in first.platform]
        batches = zip(*(leaf.split(_RUNS_PER_BATCH) for leaf in (first.z, *platform)), strict=True)
        moments = [
            self._compute_moments(first._replace(z=z, platform=PlatformInputs(*leaves)))
            for z, *leaves in batches
        ]
        mean, covariance = (torch.cat(batch) for batch in zip(*moments, strict=True))
        low, high = first.limits
        note = (
            "filters start from the mean and covariance given the first measurement, "
            f"with ranges from {low:g} to {high:g} m"
        )
        return mean, torch.linalg.cholesky(covariance), note

    def _compute_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor]:
        """Compute mean [R, 4] and covariance [R, 4, 4]."""
        low, high = first.limits
        coarse = torch.exp(
            torch.linspace(math.log(low), math.log(high), _COARSE_RANGES, dtype=torch.float64)
        )
        candidates = _CandidatePositions.from_measurement(
            first, coarse.expand(len(first.z), -1), first.z[:, :1]
        )
        likely = candidates.log_weight
        selected_mask, step = (
            likely > likely.amax(1, keepdim=True) - _LOG_LIKELIHOOD_DROP,
            coarse[1] / coarse[0],
        )
        near, far = (torch.where(selected_mask, coarse, edge) for edge in (torch.inf, -torch.inf))
        begin, end = (near.amin(1) / step).clamp(min=low), (far.amax(1) * step).clamp(max=high)
        midpoints = (torch.arange(self.ranges, dtype=torch.float64) + 0.5) / self.ranges
        nodes, weight = _hermite(self.bearings)
        ranges = begin[:, None] + (end - begin)[:, None] * midpoints
        candidates = _CandidatePositions.from_measurement(
            first, ranges, first.z[:, :1] + first.sd[0] * nodes
        )
        x, log_weight = candidates.with_velocities(first, *_hermite(self.velocities))
        log_weight = log_weight + weight.log().repeat_interleave(self.ranges)[:, None]
        share, x = torch.softmax(log_weight.flatten(1), 1).unsqueeze(-1), x.flatten(1, 2)
        mean = (share * x).sum(1)
        deviation = x - mean.unsqueeze(1)
        return mean, (share * deviation).mT @ deviation


class _CandidatePositions(NamedTuple):
    """N candidate emitter positions per run, with the velocity distribution at each.

    Attributes:
        ground: x, y, m, [R, N, 2].
        log_weight: Log likelihood of elevation and angular rates, [R, N].
        velocity: Mean of the velocity given the angular rates, m/s, [R, N, 2].
        root: Cholesky factor of the velocity covariance, m/s, [R, N, 2, 2].
    """

    ground: Tensor
    log_weight: Tensor
    velocity: Tensor
    root: Tensor

    @classmethod
    def from_measurement(
        cls, first: FirstMeasurement, ranges: Tensor, bearings: Tensor
    ) -> _CandidatePositions:
        """Compute the candidates at all ranges [R, n] and bearings [R, m], N = m n."""
        # the range is the index that changes fastest
        platform, z, sd, velocity_variance = (
            first.platform,
            first.z.unsqueeze(1),
            first.sd,
            first.velocity_sd**2,
        )
        ahead = torch.stack(
            [torch.sin(bearings), torch.cos(bearings), torch.zeros_like(bearings)], -1
        )
        level = (ahead @ platform.attitude)[..., :2]
        ground = platform.position[:, None, :2] + (
            level.unsqueeze(2) * ranges[:, None, :, None]
        ).flatten(1, 2)
        static, eye = (
            torch.cat([ground, torch.zeros_like(ground)], -1),
            torch.eye(4, dtype=sd.dtype),
        )
        base, east, north = (
            _predict(static + velocity, platform) for velocity in (0.0 * eye[0], eye[2], eye[3])
        )
        # angular rates are linear in the velocity
        h = torch.stack([(rates - base)[..., 2:4] for rates in (east, north)], -1)
        s = velocity_variance * h @ h.mT + torch.diag(sd[2:4].square())
        innovation = (z[..., 2:4] - base[..., 2:4]).unsqueeze(-1)
        gain = velocity_variance * torch.linalg.solve(s, h).mT
        covariance = velocity_variance * (eye[:2, :2] - gain @ h)
        deviance = ((z[..., 1] - base[..., 1]) / sd[1]).square() + torch.logdet(s)
        deviance = deviance + (innovation.mT @ torch.linalg.solve(s, innovation)).flatten(-3)
        return cls(
            ground,
            -0.5 * deviance,
            (gain @ innovation).squeeze(-1),
            torch.linalg.cholesky((covariance + covariance.mT) / 2),
        )

    def with_velocities(
        self, first: FirstMeasurement, nodes: Tensor, weight: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute states [R, N, V, 4] and log weights [R, N, V], including the Doppler rate."""
        velocity = self.velocity.unsqueeze(2) + torch.cartesian_prod(nodes, nodes) @ self.root.mT
        x = torch.cat([self.ground.unsqueeze(2).expand_as(velocity), velocity], -1)
        doppler = _predict(x.flatten(1, 2), first.platform)[..., 4].unflatten(
            1, velocity.shape[1:3]
        )
        log_likelihood = -0.5 * ((first.z[:, 4, None, None] - doppler) / first.sd[4]).square()
        return x, self.log_weight.unsqueeze(-1) + torch.outer(
            weight, weight
        ).flatten().log() + log_likelihood


def _predict(x: Tensor, platform: PlatformInputs) -> Tensor:
    """Predict the measurements [R, N, 5] of emitters x [R, N, 4]."""
    return predict_bearing(*relative_motion(x, platform), platform.carrier.unsqueeze(-1))


def _hermite(n: int) -> tuple[Tensor, Tensor]:
    """Compute nodes [n] and weights [n] for the standard normal distribution."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(n)
    return torch.from_numpy(nodes), torch.from_numpy(weights / weights.sum())
