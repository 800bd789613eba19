"""Episodes simulated from a model have its moments (exact recursion) and its convention of the first step."""

import math
import re
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

import pfbench
from pfbench.core import Chart, EuclideanBlock, QuaternionBlock
from pfbench.model import (
    LinearGaussian,
    Pendulum,
    StateSpaceModel,
    StochasticVolatility,
    independent_normal,
    linear_walk,
    local_level,
    normal_batch,
)
from pfbench.nav.strapdown import rotate
from pfbench.noise import MeasurementOutage, NominalNoise, OutlierNoise, VarianceSurge
from pfbench.scenario.simulated import ModelSimulation

RUNS, STEPS = 4000, 15


def test_moments_follow_the_exact_recursion() -> None:
    model = linear_walk(0.5, 0.3, 1.0)
    episode = ModelSimulation(model, STEPS, interval_s=0.5).draw(
        NominalNoise(), torch.arange(RUNS), 4
    )
    x = episode.truth["state"].numpy()
    f, q = np.array([[1.0, 0.5], [0.0, 1.0]]), 0.09 * np.array([[0.125 / 3, 0.125], [0.125, 0.5]])
    p = np.diag([4.0, 1.0])
    for t in range(STEPS):
        p = f @ p @ f.T + q  # the first measurement is of the state after the first propagation
        sd = np.sqrt(np.diag(p))
        assert (np.abs(x[:, t].mean(0)) < 4.5 * sd / math.sqrt(RUNS)).all()
        # the variance of a sample covariance of normal numbers is (p_ii p_jj + p_ij^2) / n
        error = np.sqrt((np.outer(sd, sd) ** 2 + p**2) / RUNS)
        assert (np.abs(np.cov(x[:, t].T) - p) < 4.5 * error).all()
    steps = x[:, 1:] - x[:, :-1] @ f.T
    error = np.sqrt((np.outer(np.diag(q), np.diag(q)) + q**2) / (RUNS * (STEPS - 1)))
    assert (np.abs(np.cov(steps.reshape(-1, 2).T) - q) < 4.5 * error).all()
    lag = (steps[:, 1:] * steps[:, :-1]).mean((0, 1)) / np.diag(q)
    assert (np.abs(lag) < 4.5 / math.sqrt(RUNS * (STEPS - 2))).all()
    assert episode.time.tolist() == [0.5 * (t + 1) for t in range(STEPS)]


def test_measurements_are_the_state_plus_white_noise_of_the_stated_size() -> None:
    episode = ModelSimulation(linear_walk(0.5, 0.3, 2.0), STEPS).draw(
        NominalNoise(), torch.arange(RUNS), 4
    )
    z = (episode.record.y[..., 0] - episode.truth["state"][..., 0]) / 2.0
    assert abs(z.mean()) < 4.5 / math.sqrt(z.numel())
    assert abs(z.std() - 1) < 4.5 / math.sqrt(2 * z.numel())
    assert abs((z[:, 1:] * z[:, :-1]).mean()) < 4.5 / math.sqrt(z.numel())


def test_a_surge_multiplies_the_variance_of_the_noise_in_its_window() -> None:
    model = linear_walk(0.5, 0.3, 2.0)
    surge = VarianceSurge(((3.0, 5.0),), (9.0,), (100.0,))
    episode, calm = (
        ModelSimulation(model, STEPS, interval_s=0.5).draw(noise, torch.arange(RUNS), 4)
        for noise in (surge, NominalNoise())
    )
    x, g = episode.truth["state"], model.g.inverse()
    w = (x[:, 1:] - x[:, :-1] @ model.f.mT) @ g.mT  # of the steps that end at 1.0, 1.5, ...
    for t, seconds in enumerate(np.arange(1.0, 0.5 * STEPS + 0.1, 0.5)):
        inside = 3.0 < seconds <= 5.0  # its interval lies in the window
        low, high = stats.chi2(2 * RUNS).ppf([1e-5, 1 - 1e-5]) * (100.0 if inside else 1.0)
        assert low < w[:, t].square().sum() < high
    assert torch.equal(x[:, :6], calm.truth["state"][:, :6])  # common numbers before it
    z = (episode.record.y[..., 0] - x[..., 0]) / 2.0
    variance = torch.where((episode.time >= 3.0) & (episode.time < 5.0), 9.0, 1.0)
    assert (((z.square().mean(0) / variance) - 1).abs() < 4.5 * math.sqrt(2 / RUNS)).all()


def test_a_model_that_observes_its_initial_state_does_not_move_it_first() -> None:
    model = local_level(30.0, 10.0, 500.0, 5.0, observes_initial=True)
    level = (
        ModelSimulation(model, 2).draw(NominalNoise(), torch.arange(RUNS), 4).truth["state"][..., 0]
    )
    for t, variance in ((0, 25.0), (1, 925.0)):
        assert abs(level[:, t].mean() - 500.0) < 4.5 * math.sqrt(variance / RUNS)
        assert abs(level[:, t].var() / variance - 1) < 4.5 * math.sqrt(2 / RUNS)


def test_a_dense_initial_law_is_drawn_with_its_correlation() -> None:
    factor = [[2.0, 0.0], [1.5, 0.5]]
    model = LinearGaussian(np.eye(2), np.zeros((2, 1)), np.eye(2), [1.0, 1.0], [1.0, -1.0], factor)
    x = (
        ModelSimulation(model, 1)
        .draw(NominalNoise(), torch.arange(RUNS), 4)
        .truth["state"][:, 0]
        .numpy()
    )
    p = np.array(factor) @ np.array(factor).T
    error = np.sqrt((np.outer(np.diag(p), np.diag(p)) + p**2) / RUNS)
    assert (np.abs(np.cov(x.T) - p) < 4.5 * error).all()
    assert (np.abs(x.mean(0) - [1.0, -1.0]) < 4.5 * np.sqrt(np.diag(p) / RUNS)).all()


def test_state_dependent_deviations_reach_the_measurement() -> None:
    episode = ModelSimulation(StochasticVolatility(), STEPS).draw(
        NominalNoise(), torch.arange(RUNS), 4
    )
    z = episode.record.y[..., 0] * torch.exp(-episode.truth["state"][..., 0] / 2)
    assert abs(z.var() - 1) < 4.5 * math.sqrt(2 / z.numel())


def test_a_run_does_not_depend_on_others_and_a_regime_changes_only_measurements() -> None:
    world = ModelSimulation(Pendulum(), 20, interval_s=0.05)
    ten, alone = (
        world.draw(NominalNoise(), torch.arange(10), 4),
        world.draw(NominalNoise(), torch.tensor([3]), 4),
    )
    assert all(
        torch.allclose(alone.truth[name], value[3:4], rtol=1e-13)
        for name, value in ten.truth.items()
    )
    assert torch.allclose(alone.record.y, ten.record.y[3:4], rtol=1e-13)
    for noise in (OutlierNoise(0.5, 10.0), MeasurementOutage(((0.2, 0.5),))):
        other = world.draw(noise, torch.arange(10), 4)
        assert all(torch.equal(other.truth[name], value) for name, value in ten.truth.items())
        assert not torch.equal(other.record.y, ten.record.y)


def test_filters_draw_from_other_streams_than_episodes() -> None:
    """No number of an episode may come back as a particle: streams are separated by the name of their purpose."""
    package = Path(pfbench.__file__).parent

    def purposes(pattern: str, *folders: str) -> set[str]:
        text = "\n".join(
            file.read_text() for folder in folders for file in (package / folder).rglob("*.py")
        )
        return set(re.findall(pattern, text))

    drawn = r'\b(?:normal|uniform|markov|_constant)\(\s*f?"([^"]+)"'
    episodes = purposes(drawn, "scenario", "noise", "nav") | purposes(
        r'"(world\.[^"]+)"', "scenario", "ppl"
    )
    filters = purposes(drawn, "filter") | purposes(
        r'(?:draw_values|draw_initial_state)\([^"]*?"([^"]+)"', "filter"
    )
    assert {"world.state", "world.receiver", "world.initial", "world.imu.gyro"} <= episodes
    assert {"initial", "noise", "resample"} <= filters
    assert all(purpose.startswith(("world.", "{label}.")) for purpose in episodes)
    assert not any("world." in file.read_text() for file in (package / "filter").rglob("*.py"))


def test_a_scenario_without_steps_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"scenario\.steps must be a whole number of at least 1, got 0"
    ):
        ModelSimulation(Pendulum(), 0)


def test_numbers_of_a_scenario_are_checked() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    for interval in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=r"scenario\.interval_s must be positive"):
            ModelSimulation(model, 5, interval)
    with pytest.raises(ValueError, match=r"scenario\.steps must be a whole number .* got 5\.5"):
        ModelSimulation(model, 5.5)  # type: ignore[arg-type]


class Turning(StateSpaceModel):
    """Attitude as a quaternion and a bias; the stars in two directions are measured."""

    chart = Chart((QuaternionBlock(), EuclideanBlock(1)))
    names, units, noise_dim = ("a", "b", "c", "bias"), ("rad", "rad", "rad", "m"), 4
    groups: ClassVar = {"attitude": (0, 1, 2), "bias": (3,)}
    sd: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sd", torch.full((7,), 0.01, dtype=torch.float64))

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, torch.full((4,), 0.5, dtype=torch.float64))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.chart.add(x, 0.1 * w)

    def observation(self, x: Tensor, u: Any) -> Any:
        stars = torch.eye(3, dtype=torch.float64)[:2]
        seen = [rotate(x[..., :4], star.expand(*x.shape[:-1], 3)) for star in stars]
        return independent_normal(torch.cat([*seen, x[..., 4:]], -1), self.sd)


def test_the_truth_of_a_model_with_a_quaternion_is_its_state() -> None:
    """Its measurements differ from those of the assembled truth by the noise, and the groups are rotation vectors."""
    model = Turning()
    episode = ModelSimulation(model, STEPS).draw(NominalNoise(), torch.arange(200), 4)
    single = {
        name: value.float() for name, value in episode.truth.items()
    }  # of an author who mixes types
    for truth in (episode.truth, single | {"bias": episode.truth["bias"]}):
        x = model.assemble(truth)
        z = (episode.record.y - model.observation(x, ()).mean) / 0.01
        assert abs(z.square().mean() - 1) < 4.5 * math.sqrt(2 / z.numel())
    turn = episode.truth["attitude"][:, -1].norm(dim=-1)
    torch.testing.assert_close(2 * torch.acos(x[:, -1, 0].abs()), turn, rtol=1e-4, atol=1e-5)
