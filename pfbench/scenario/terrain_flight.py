"""Terrain-referenced navigation along a simulated or recorded trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_positive
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.model.terrain.random_terrain import RandomTerrain, compute_elevation
from pfbench.model.terrain.terrain_aided import TerrainAided, TerrainInputs
from pfbench.nav import earth
from pfbench.nav.trajectory import TrajectorySource
from pfbench.noise.base import NoiseRegime, process_variance_factors
from pfbench.scenario.base import Scenario
from pfbench.scenario.episode_cache import Arrays, load_or_build

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
