"""Worlds drawn from a model itself follow that model: moments by the exact recursion, and the convention of the first step."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from pyro.distributions import Laplace
from scipy import stats

import pfbench
from pfbench.model.linear import LinearGaussian, linear_walk, local_level
from pfbench.model.toys import Pendulum, StochasticVolatility
from pfbench.noise.regimes import Nominal, Outage, Outliers
from pfbench.noise.surges import Surge
from pfbench.scenario.model_world import ModelWorld

RUNS, STEPS = 4000, 15


def test_moments_follow_the_exact_recursion() -> None:
    model = linear_walk(0.5, 0.3, 1.0)
    episode = ModelWorld(model, STEPS, interval=0.5).draw(Nominal(), torch.arange(RUNS), 4)
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


def test_measurements_are_the_state_and_white_noise_of_the_stated_size() -> None:
    episode = ModelWorld(linear_walk(0.5, 0.3, 2.0), STEPS).draw(Nominal(), torch.arange(RUNS), 4)
    z = (episode.record.y[..., 0] - episode.truth["state"][..., 0]) / 2.0
    assert abs(z.mean()) < 4.5 / math.sqrt(z.numel())
    assert abs(z.std() - 1) < 4.5 / math.sqrt(2 * z.numel())
    assert abs((z[:, 1:] * z[:, :-1]).mean()) < 4.5 / math.sqrt(z.numel())


def test_a_surge_multiplies_the_variance_of_what_drives_the_steps_in_its_window() -> None:
    model = linear_walk(0.5, 0.3, 2.0)
    surge = Surge(((3.0, 5.0),), (9.0,), (100.0,))
    episode, calm = (ModelWorld(model, STEPS, interval=0.5).draw(noise, torch.arange(RUNS), 4) for noise in (surge, Nominal()))
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
    level = ModelWorld(model, 2).draw(Nominal(), torch.arange(RUNS), 4).truth["state"][..., 0]
    for t, variance in ((0, 25.0), (1, 925.0)):
        assert abs(level[:, t].mean() - 500.0) < 4.5 * math.sqrt(variance / RUNS)
        assert abs(level[:, t].var() / variance - 1) < 4.5 * math.sqrt(2 / RUNS)


def test_a_dense_initial_law_is_drawn_with_its_correlation() -> None:
    factor = [[2.0, 0.0], [1.5, 0.5]]
    model = LinearGaussian(np.eye(2), np.zeros((2, 1)), np.eye(2), [1.0, 1.0], [1.0, -1.0], factor)
    x = ModelWorld(model, 1).draw(Nominal(), torch.arange(RUNS), 4).truth["state"][:, 0].numpy()
    p = np.array(factor) @ np.array(factor).T
    error = np.sqrt((np.outer(np.diag(p), np.diag(p)) + p**2) / RUNS)
    assert (np.abs(np.cov(x.T) - p) < 4.5 * error).all()
    assert (np.abs(x.mean(0) - [1.0, -1.0]) < 4.5 * np.sqrt(np.diag(p) / RUNS)).all()


def test_deviations_that_depend_on_the_state_reach_the_measurement() -> None:
    episode = ModelWorld(StochasticVolatility(), STEPS).draw(Nominal(), torch.arange(RUNS), 4)
    z = episode.record.y[..., 0] * torch.exp(-episode.truth["state"][..., 0] / 2)
    assert abs(z.var() - 1) < 4.5 * math.sqrt(2 / z.numel())


def test_a_run_is_its_own_and_a_regime_changes_the_measurement_alone() -> None:
    world = ModelWorld(Pendulum(), 20, interval=0.05)
    ten, alone = world.draw(Nominal(), torch.arange(10), 4), world.draw(Nominal(), torch.tensor([3]), 4)
    assert all(torch.allclose(alone.truth[name], value[3:4], rtol=1e-13) for name, value in ten.truth.items())
    assert torch.allclose(alone.record.y, ten.record.y[3:4], rtol=1e-13)
    for noise in (Outliers(0.5, 10.0), Outage(((0.2, 0.5),))):
        other = world.draw(noise, torch.arange(10), 4)
        assert all(torch.equal(other.truth[name], value) for name, value in ten.truth.items())
        assert not torch.equal(other.record.y, ten.record.y)


def test_filters_draw_from_other_streams_than_worlds() -> None:
    """Nothing that a world draws may come back as a particle: streams are told apart by the name of their purpose."""
    package = Path(pfbench.__file__).parent

    def purposes(*folders: str) -> set[str]:
        text = "\n".join(file.read_text() for folder in folders for file in (package / folder).glob("*.py"))
        return set(re.findall(r'\b(?:normal|uniform|markov|_constant)\(\s*f?"([^"]+)"', text))

    worlds, filters = purposes("scenario", "noise", "nav"), purposes("filter")
    assert {"world.state", "world.receiver", "world.initial", "world.imu.gyro"} <= worlds
    assert {"initial", "noise", "resample"} <= filters
    assert all(purpose.startswith(("world.", "{purpose}.")) for purpose in worlds)
    assert not any(purpose.startswith("world") for purpose in filters)


def test_no_steps_and_noise_that_is_not_normal_are_refused() -> None:
    with pytest.raises(ValueError, match=r"scenario\.steps=0: give at least 1 step"):
        ModelWorld(Pendulum(), 0)

    class HeavyTailed(Pendulum):
        def observation(self, x, u):
            return Laplace(torch.sin(x[..., :1]), 0.3).to_event(1)

    with pytest.raises(ValueError, match="HeavyTailed: worlds are drawn for independent normal measurement noise only"):
        ModelWorld(HeavyTailed(), 3).draw(Nominal(), torch.arange(2), 1)
