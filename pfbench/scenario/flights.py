"""Simulated flights: an INS with aiding sensors, and terrain-referenced navigation."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from tqdm import tqdm
from typing_extensions import override

from pfbench.core.parameter_checks import check_positive, require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.model.terrain import RandomTerrain, TerrainAided, TerrainInputs, compute_elevation
from pfbench.nav import attitude, earth, imu_errors, strapdown
from pfbench.nav.aiding import AidingSensor, AlignmentErrors, FlightSolution, GnssReceiver
from pfbench.nav.trajectory import TrajectoryData, TrajectorySource
from pfbench.noise.base import NoiseRegime, process_variance_factors
from pfbench.scenario.base import Scenario
from pfbench.scenario.closed_loop import ClosedLoopIns
from pfbench.scenario.simulated import Arrays, load_or_build


@dataclass(frozen=True)
class SimulatedFlight(Scenario):
    """Simulated flight with an INS. Filters estimate the INS errors.

    The inertial sensors are simulated at their own rate and processed by the mechanisation. No
    filter model is used. Each run draws its sensor errors, initial errors and receiver noise. All
    runs have the same trajectory.

    Attributes:
        trajectory: Motion of the vehicle.
        imu: Error parameters of the inertial sensors.
        receiver: Sensor that aids the INS, such as a GNSS receiver.
        initial_errors: Standard deviations of the initial errors.
        imu_rate_hz: Sampling rate of the inertial sensors, Hz.
        filter_interval_s: Time between measurements, s, an even number of samples.
        cache_dir: Folder for simulated flights. None disables the cache.
        closed_loop: Whether the estimated errors correct the INS after every interval. Results
            contain the errors of the corrected navigation.

    Raises:
        ValueError: If the interval is not an even number of samples, or `closed_loop` is set with a
            sensor other than a GNSS receiver. `draw` raises it if the flight is not a whole number
            of intervals.
    """

    trajectory: TrajectorySource
    imu: imu_errors.ImuErrors
    receiver: AidingSensor
    initial_errors: AlignmentErrors
    imu_rate_hz: float = 100.0
    filter_interval_s: float = 1.0
    cache_dir: str | None = None
    closed_loop: bool = False

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the receiver. Empty if it does not state them."""
        names: tuple[str, ...] = getattr(self.receiver, "channel_names", ())
        return names

    @property
    def input_type(self) -> type | None:
        """Type of the inputs that the receiver passes on. None if it does not state them."""
        kind: type | None = getattr(self.receiver, "input_type", None)
        return kind

    @property
    def samples(self) -> float:
        """Samples of the inertial sensors."""
        return getattr(self.trajectory, "duration_s", 0.0) * self.imu_rate_hz

    @property
    def steps(self) -> float:
        """Measurements per run."""
        return getattr(self.trajectory, "duration_s", 0.0) / self.filter_interval_s

    def __post_init__(self) -> None:
        samples = self.imu_rate_hz * self.filter_interval_s
        require(
            not samples < 2 and (not abs(samples / 2 - round(samples / 2)) > 1e-09),
            "scenario.filter_interval_s",
            "be an even number of samples",
            f"{self.filter_interval_s} ({samples:g} samples at {self.imu_rate_hz} Hz)",
            "Change scenario.filter_interval_s or scenario.imu_rate_hz.",
        )
        require(
            not self.closed_loop or isinstance(self.receiver, GnssReceiver),
            "scenario.closed_loop",
            "be false without a GnssReceiver",
            f"true with {type(self.receiver).__name__}",
            "Set scenario.closed_loop=false.",
        )

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        draws = PhiloxStream(seed, runs)
        flown, truth, track, datasheet = self.fly(noise, runs, seed)
        aiding = self.receiver.measure(flown, draws, process_variance_factors(noise, flown.time))
        y = aiding.y + noise.draw_errors(draws, self.receiver.channels, flown.time)
        feedback = self._build_feedback(noise, draws) if self.closed_loop else None
        notes = (
            ("the estimates correct the INS in flight; errors refer to the corrected navigation",)
            if self.closed_loop
            else ()
        )
        # of orbits that were read from a file
        notes += getattr(getattr(self.receiver, "constellation", None), "notes", ())
        tracks = track.expand(len(runs), -1, -1)
        return Episode(
            Record(y, aiding.u, feedback=feedback),
            flown.time,
            truth | aiding.truth,
            tracks,
            notes,
            datasheet | aiding.sheet,
        )

    def _build_feedback(self, noise: NoiseRegime, draws: PhiloxStream) -> ClosedLoopIns:
        """Build the closed-loop INS with the same sensors and initial errors."""
        flight = self.trajectory.generate(self.imu_rate_hz)
        ins, imu = self._simulate_ins(
            flight, process_variance_factors(noise, flight.time[1:]), draws
        )
        return ClosedLoopIns(
            ins,
            imu.dtheta,
            imu.dv,
            1.0 / self.imu_rate_hz,
            round(self.imu_rate_hz * self.filter_interval_s),
        )

    def _simulate_ins(
        self, flight: TrajectoryData, process: Tensor, draws: PhiloxStream
    ) -> tuple[strapdown.InsState, imu_errors.ImuMeasurements]:
        """Simulate the INS state at the start and the sensor measurements."""
        imu = imu_errors.add_imu_errors(
            flight.dtheta, flight.dv, 1.0 / self.imu_rate_hz, self.imu, draws, process
        )
        errors = self.initial_errors.draw_errors(draws)
        start = flight.dcm[0], flight.vel[0], flight.pos[0]
        return strapdown.align(*start, errors[:, :3], errors[:, 3:6], errors[:, 6:]), imu

    def fly(
        self, noise: NoiseRegime, runs: Tensor, seed: int
    ) -> tuple[FlightSolution, Arrays, Tensor, Arrays]:
        """Simulate the flight of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, [R].
            seed: Seed.

        Returns:
            The flight; true INS errors by group, [R, T, k]; the track, m, [1, T, 3]; and data for
            the datasheet.
        """
        per = round(self.imu_rate_hz * self.filter_interval_s)
        # generated at most once, and only if the cache does not contain all data
        generate = cache(lambda: self.trajectory.generate(self.imu_rate_hz))
        course = load_or_build(
            self.cache_dir,
            ("course 1", self.trajectory, self.imu_rate_hz, self.filter_interval_s),
            lambda: self._summarise_trajectory(generate(), per),
        )
        process = process_variance_factors(noise, course["samples"][1:])
        process_key = (
            None
            if bool((process == 1.0).all())
            else hashlib.sha256(process.numpy().tobytes()).hexdigest()
        )
        recipe = (
            "flight 6",
            self.trajectory,
            self.imu,
            self.initial_errors,
            self.imu_rate_hz,
            self.filter_interval_s,
            seed,
            runs.tolist(),
            process_key,
        )
        simulation = load_or_build(
            self.cache_dir,
            recipe,
            lambda: self._simulate(generate(), per, process, PhiloxStream(seed, runs)),
        )
        truth = {name[6:]: value for name, value in simulation.items() if name.startswith("truth.")}
        intervals = strapdown.InsIntervals(
            *(simulation[name] for name in strapdown.InsIntervals._fields)
        )
        flown = FlightSolution(
            course["time"], course["pos"], course["vel"], course["dcm"], intervals
        )
        plan = earth.local_enu(flown.pos, course["origin"])[:, :2]
        # ellipsoidal height: after 36 km the tangent plane is 100 m higher
        height = flown.pos[:, 2:] - course["origin"][2]
        datasheet = {name: course[name] for name in ("force", "rate")}
        return flown, truth, torch.cat([plan, height], -1).unsqueeze(0), datasheet

    def _summarise_trajectory(self, flight: TrajectoryData, per: int) -> Arrays:
        """Return truth at interval ends, means of ideal sensors, and sample times."""
        if len(flight.dtheta) % per:
            raise ValueError(
                f"scenario.filter_interval_s must divide the flight of {flight.time[-1]:g} s, "
                f"got {self.filter_interval_s}. Change the interval or the length of a segment."
            )
        ends = {
            name: getattr(flight, name)[per::per].contiguous()
            for name in ("time", "pos", "vel", "dcm")
        }
        return ends | {
            "origin": flight.pos[0],
            "samples": flight.time,
            "force": flight.dv.unflatten(0, (-1, per)).mean(1) * self.imu_rate_hz,
            "rate": flight.dtheta.unflatten(0, (-1, per)).mean(1) * self.imu_rate_hz,
        }

    def _simulate(
        self, flight: TrajectoryData, per: int, process: Tensor, draws: PhiloxStream
    ) -> Arrays:
        """Simulate true errors and INS output at the interval ends."""
        ins, imu = self._simulate_ins(flight, process, draws)
        intervals = imu.dtheta.shape[1] // per
        with tqdm(
            total=intervals,
            desc="simulating flights",
            unit="interval",
            delay=2,
            disable=None,
            leave=False,
        ) as bar:
            _, u = strapdown.navigate(
                ins, imu.dtheta, imu.dv, 1.0 / self.imu_rate_hz, per, tick=bar.update
            )
        dcm, vel, pos = flight.dcm[per::per], flight.vel[per::per], flight.pos[per::per]
        gyro, accelerometer = (
            imu.gyro_markov[:, per - 1 :: per],
            imu.accelerometer_markov[:, per - 1 :: per],
        )
        constant = imu.gyro_bias.unsqueeze(1).expand_as(gyro)
        truth = {
            "attitude": attitude.attitude_error(dcm, u.dcm_end),
            "velocity": u.vel_end - vel,
            "position": (u.pos_end - pos) * earth.metre_scale(pos),
            "gyro_bias": constant + gyro,
            "gyro_constant": constant,
            "gyro_markov": gyro,
            "accelerometer_bias": imu.accelerometer_bias.unsqueeze(1) + accelerometer,
        }
        tensors = {f"truth.{name}": value.contiguous() for name, value in truth.items()}
        return {**tensors, **{k: v.contiguous() for k, v in u._asdict().items()}}


# --------------------------------------------------------------------------------------------------
# Terrain-referenced navigation along a simulated or recorded trajectory.

SAMPLES = 10  # of the trajectory per interval
MAP_SIZE = 100e3  # range of the places of the runs, m


@dataclass(frozen=True)
class TerrainFlight(Scenario):
    """Vehicle with an INS, a barometer, a radar altimeter and a map of the terrain.

    All runs have the same trajectory, each at another place of the map. The position error of the
    INS is a random walk with a normal start, as in `TerrainAided`, so the model describes the
    data. The measurement is the height of the terrain below the true position with an error that
    contains those of barometer, altimeter and map.

    Attributes:
        trajectory: Motion of the vehicle, simulated or recorded.
        terrain: Terrain of the map.
        initial_sd: Standard deviation of the initial position error per axis, m.
        drift: Random walk of the position error per axis, m/sqrt(s).
        measurement_sd: Standard deviation of the measured height of the terrain, m.
        interval_s: Time between measurements, s.
        cache_dir: Folder for trajectories. None disables the cache.

    Raises:
        ValueError: If a value is not positive.
    """

    trajectory: TrajectorySource
    terrain: RandomTerrain
    initial_sd: float
    drift: float
    measurement_sd: float
    interval_s: float = 1.0
    cache_dir: str | None = None
    channel_names, input_type = TerrainAided.channel_names, TerrainInputs

    @property
    def steps(self) -> float:
        """Measurements per run."""
        return getattr(self.trajectory, "duration_s", 0.0) / self.interval_s

    def __post_init__(self) -> None:
        for name in ("initial_sd", "drift", "measurement_sd", "interval_s"):
            check_positive(f"scenario.{name}", getattr(self, name))

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        draws = PhiloxStream(seed, runs)
        course = load_or_build(
            self.cache_dir,
            ("terrain course 1", self.trajectory, self.interval_s),
            self._sample_course,
        )
        time, track = course["time"], course["track"]
        factor = process_variance_factors(noise, time).sqrt().unsqueeze(-1)
        start = self.initial_sd * draws.normal("world.start", 1, 2)
        walk = factor * draws.normal("world.state", len(time), 2)
        error = start + self.drift * self.interval_s**0.5 * walk.cumsum(1)
        origin = MAP_SIZE * (draws.uniform("world.place", 1, 2) - 0.5)
        position = track[:, :2] + origin
        height = compute_elevation(position, self.terrain.draw_waves()).unsqueeze(-1)
        sd = torch.tensor([self.measurement_sd], dtype=torch.float64)
        y = height + noise.draw_errors(draws, MeasurementChannels.of_one_kind(sd), time)
        notes = ("position errors of the INS are drawn from the model of the filters",)
        tracks = track.expand(len(runs), -1, -1)
        inputs = TerrainInputs(position + error)
        return Episode(Record(y, inputs), time, {"position": error}, tracks, notes)

    def _sample_course(self) -> Arrays:
        """Return times [T] and East, North and height relative to the start [T, 3]."""
        flight = self.trajectory.generate(SAMPLES / self.interval_s)
        pos = flight.pos[SAMPLES::SAMPLES]
        plan = earth.local_enu(pos, flight.pos[0])[:, :2]
        track = torch.cat([plan, pos[:, 2:] - flight.pos[0, 2]], -1)
        return {"time": flight.time[SAMPLES::SAMPLES].contiguous(), "track": track}
