"""Terrain-referenced navigation: the surface and its statistics, the exact point-mass filter, its grid, bad input."""

import math
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from checkout import ROOT
from refusals import check_refused
from torch import Tensor
from typing_extensions import override

from pfbench.core import Episode, PhiloxStream, Record
from pfbench.filter import ParticleFilter, run_filter
from pfbench.model.terrain import (
    RandomTerrain,
    TerrainAided,
    TerrainInputs,
    compute_elevation,
    compute_slope,
)
from pfbench.nav import ManoeuvreTrajectory, TrajectoryStart, cruise, turn
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import TerrainFlight

sys.path.insert(0, str(ROOT / "experiments" / "analyses"))  # scripts, not a package
import terrain_limit

TERRAIN = RandomTerrain(height_sd=60.0, shortest_m=300.0, longest_m=8000.0)
START = TrajectoryStart(34.0, 108.0, 400.0, 100.0, 30.0)
COURSE = ManoeuvreTrajectory([cruise(20.0), turn(60.0, 20.0)], START)
SCENE = TerrainFlight(COURSE, TERRAIN, initial_sd=150.0, drift=4.0, measurement_sd=5.0)


def model_of(scene: TerrainFlight = SCENE) -> TerrainAided:
    return TerrainAided(
        scene.terrain, scene.interval_s, scene.drift, scene.measurement_sd, scene.initial_sd
    )


def draw(runs: int, scene: TerrainFlight = SCENE) -> Episode:
    return scene.draw(NominalNoise(), torch.arange(runs), seed=4)


def places(n: int, width: float = 2e5) -> Tensor:
    return width * (PhiloxStream(8, torch.arange(1)).uniform("places", n, 2)[0] - 0.5)


# the surface


def test_heights_have_the_stated_spread_and_the_slope_is_their_derivative() -> None:
    waves = TERRAIN.draw_waves()
    p = places(20000).requires_grad_()
    height = compute_elevation(p, waves)
    # places of a sum of waves are nearly independent: four standard errors of a variance
    (gradient,) = torch.autograd.grad(height.sum(), p)
    height = height.detach()
    assert float(height.var()) == pytest.approx(3600.0, rel=4.0 * math.sqrt(2.0 / 20000))
    assert abs(float(height.mean())) < 4.0 * 60.0 / math.sqrt(20000)
    torch.testing.assert_close(compute_slope(p.detach(), waves), gradient)


def test_each_octave_has_its_share_of_the_variance() -> None:
    """Variance per octave in proportion to wavelength^(2 H), in all directions."""
    waves = RandomTerrain(waves=4000, hurst_exponent=0.5).draw_waves()
    length = 2.0 * math.pi / waves.wave_vector.norm(dim=-1)
    assert float(length.min()) > 500.0
    assert float(length.max()) < 8000.0
    power = 0.5 * waves.amplitude**2
    assert float(power.sum()) == pytest.approx(3600.0)
    octaves = [
        float(power[(length > a) & (length <= 2 * a)].sum()) for a in (500, 1000, 2000, 4000)
    ]
    np.testing.assert_allclose(np.divide(octaves[1:], octaves[:-1]), 2.0, rtol=0.01)
    direction = waves.wave_vector / waves.wave_vector.norm(dim=-1, keepdim=True)
    moments = direction.mT @ direction / len(direction)
    assert (moments - 0.5 * torch.eye(2)).abs().max() < 4.5 * math.sqrt(0.125 / 4000)


def test_the_surface_follows_its_seed_alone() -> None:
    first, again = TERRAIN.draw_waves(), TERRAIN.draw_waves()
    assert all(map(torch.equal, first, again))
    assert not torch.equal(first.phase, replace(TERRAIN, seed=2).draw_waves().phase)


# the scenario


def test_measurements_are_heights_below_the_true_position() -> None:
    episode = draw(400)
    error, u = episode.truth["position"], episode.record.u
    height = compute_elevation(u.position - error, TERRAIN.draw_waves())
    z = (episode.record.y[..., 0] - height) / SCENE.measurement_sd
    assert abs(float(z.mean())) < 4.0 / math.sqrt(z.numel())
    assert float(z.var()) == pytest.approx(1.0, rel=4.0 * math.sqrt(2.0 / z.numel()))
    start = error[:, 0]
    expected = SCENE.initial_sd**2 + SCENE.drift**2
    assert float(start.square().mean()) == pytest.approx(expected, rel=4.0 * math.sqrt(2.0 / 800))
    steps = error.diff(dim=1)
    assert float(steps.var()) == pytest.approx(16.0, rel=4.0 * math.sqrt(2.0 / steps.numel()))
    path = (u.position - error).diff(dim=1).norm(dim=-1)
    torch.testing.assert_close(path, torch.full_like(path, 100.0), rtol=2e-3, atol=0.0)
    assert float((u.position - error)[:, 0].std()) > 2e4  # each run at another place of the map


# the exact filter


def exact_mean(episode: Episode, scene: TerrainFlight = SCENE, cell: float = 8.0) -> np.ndarray:
    waves = tuple(a.numpy() for a in scene.terrain.draw_waves())
    method = terrain_limit.PointMass(
        waves, scene.drift, scene.measurement_sd, scene.initial_sd, cell
    )
    return method.run(episode.record.u.position[0].numpy(), episode.record.y[0, :, 0].numpy())


class WrongSign(TerrainAided):
    """A model that adds the error of the INS in place of subtracting it."""

    @override
    def observation(self, x: Tensor, u: TerrainInputs) -> Any:
        return super().observation(-x, u)


def repeat(record: Record, runs: int) -> Record:
    return Record(
        record.y.expand(runs, -1, -1), TerrainInputs(record.u.position.expand(runs, -1, -1))
    )


def test_a_particle_filter_has_the_mean_of_the_point_mass_filter() -> None:
    """30 filters with 2000 particles on the record of one run, four standard errors at each of 12 steps."""
    episode, runs = draw(1), 30
    record = repeat(episode.record, runs)
    expected = torch.from_numpy(exact_mean(episode))
    spread = float((expected - episode.truth["position"][0]).norm(dim=-1)[:10].mean())
    assert spread > 5.0  # the first steps are uncertain, so the comparison has power

    def distance(model: TerrainAided) -> float:
        stream = PhiloxStream(2, torch.arange(runs))
        mean = run_filter(ParticleFilter(2000), model, record, stream).mean
        error = mean.std(0) / math.sqrt(runs) + 0.05  # bias of order 1 / N and the cells
        return float(((mean.mean(0) - expected).abs() / error)[:40].max())

    assert distance(model_of()) < 4.5
    wrong = WrongSign(TERRAIN, 1.0, SCENE.drift, SCENE.measurement_sd, SCENE.initial_sd)
    assert distance(wrong) > 20.0


def test_the_point_mass_filter_does_not_depend_on_its_cells() -> None:
    episode = draw(1)
    coarse, fine = exact_mean(episode, cell=8.0), exact_mean(episode, cell=4.0)
    assert np.abs(coarse - fine).max() < 0.5  # of errors of several metres


def test_without_slope_the_point_mass_filter_keeps_the_initial_distribution() -> None:
    """Heights far apart in scale: the walk alone, whose variance the steps to adjacent cells have."""
    flat = replace(SCENE, terrain=RandomTerrain(1e-6, 4000.0, 8000.0), initial_sd=20.0)
    method = terrain_limit.PointMass(
        tuple(a.numpy() for a in flat.terrain.draw_waves()), 4.0, 5.0, 20.0, 5.0
    )
    assert np.abs(method.run(np.zeros((30, 2)), np.zeros(30))).max() < 1e-6


# bad input


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height_sd": 0.0}, "scenario.terrain.height_sd must be positive and finite"),
        ({"longest_m": 200.0}, r"longest_m must be above 300\.0 and finite, got 200\.0"),
        ({"waves": 4}, "scenario.terrain.waves must be a whole number of at least 8, got 4"),
    ],
)
def test_a_terrain_of_bad_values_is_refused(change: dict[str, Any], message: str) -> None:
    check_refused([(message, lambda: replace(TERRAIN, **change))], remedy=False)


@pytest.mark.parametrize("name", ["initial_sd", "drift", "measurement_sd", "interval_s"])
def test_sizes_that_are_not_positive_are_refused(name: str) -> None:
    check_refused(
        [(f"scenario.{name} must be finite positive", lambda: replace(SCENE, **{name: 0.0}))],
        remedy=False,
    )
    values = {"interval": 1.0, "drift": 1.0, "measurement_sd": 1.0, "initial_sd": 1.0}
    key = name.removesuffix("_s")
    check_refused(
        [
            (
                f"model.{key} must be finite positive",
                lambda: TerrainAided(TERRAIN, **(values | {key: -1.0})),
            )
        ],
        remedy=False,
    )
