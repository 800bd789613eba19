"""Smoothing against one dense solve of the joint normal law, and backward sampling against it within its Monte Carlo error."""

from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from pfbench.core.chart import Chart, QuaternionBlock
from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import (
    CubaturePoints,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
)
from pfbench.filter.gaussian.noise_adaptation import FadingMemory
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.smoothing import sample_trajectories, smooth
from pfbench.model.base import ModelWrapper, StateSpaceModel
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk, local_level
from pfbench.model.textbook import UnivariateGrowth
from pfbench.noise.white import NominalNoise
from pfbench.scenario.model_simulation import ModelSimulation

RULES = {
    "jacobian": TaylorLinearisation(),
    "unscented": SigmaPointLinearisation(UnscentedPoints()),
    "cubature": SigmaPointLinearisation(CubaturePoints()),
}


def dense(model: LinearGaussian, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Posterior of all states at once: x = A (x_0, w_1, ..., w_T), conditioned on what was seen of it. y [T, Dy]."""
    f, g, h, r, m0, l0 = (getattr(model, name).numpy() for name in ("f", "g", "h", "r", "m0", "l0"))
    steps, (d, w) = len(y), g.shape
    rows, row, mean, centre = [], np.concatenate([l0, np.zeros((d, steps * w))], 1), [], m0
    for t in range(steps):
        if t or not model.observes_initial:
            row, centre = f @ row, f @ centre
            row[:, d + t * w : d + (t + 1) * w] += g
        rows.append(row)
        mean.append(centre)
    a, mean = np.concatenate(rows), np.concatenate(mean)
    p, big = a @ a.T, np.kron(np.eye(steps), h)
    seen = ~np.isnan(y).ravel()
    big, noise = big[seen], np.diag(np.tile(r**2, steps)[seen])
    gain = np.linalg.solve(big @ p @ big.T + noise, big @ p).T
    mean, p = mean + gain @ (y.ravel()[seen] - big @ mean), p - gain @ big @ p
    return mean.reshape(steps, d), np.stack(
        [p[t * d : (t + 1) * d, t * d : (t + 1) * d] for t in range(steps)]
    )


def record_of(model: LinearGaussian, runs: int, steps: int) -> Record:
    record = ModelSimulation(model, steps).draw(NominalNoise(), torch.arange(runs), 3).record
    record.y[:, 2] = torch.nan  # an instant without measurement, in all runs
    record.y[0, steps - 1] = torch.nan  # and the last of one run
    return record


class Driven(ModelWrapper):
    """The same linear model, which does not tell how its noise enters: it then goes through the filter's rule."""

    linear = True

    @property
    def observes_initial(self) -> bool:
        return self.model.observes_initial


SINGULAR = LinearGaussian(
    [[1.0, 0.7], [0.0, 0.9]], [[0.1], [0.5]], [[1.0, 0.0]], [0.8], [1.0, -1.0], [2.0, 1.0]
)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    "model",
    [
        linear_walk(0.5, 0.3, 0.7),
        SINGULAR,
        local_level(0.4, 1.0, 2.0, 3.0, observes_initial=True),
        Driven(SINGULAR),
    ],
    ids=["walk", "singular", "at_rest", "driven"],
)
def test_smoothed_laws_are_those_of_the_dense_joint_law(model: StateSpaceModel, rule: str) -> None:
    plain: Any = model.model if isinstance(model, Driven) else model
    record = record_of(plain, 3, 9)
    found = smooth(GaussianFilter(RULES[rule]), model, record)
    for run in range(3):
        mean, covariance = dense(plain, record.y[run].numpy())
        np.testing.assert_allclose(found.mean[run], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.covariance[run], covariance, rtol=0, atol=1e-9)


class Push(NamedTuple):
    """What is added to the position in each step [1, T]."""

    by: Tensor


class Pushed(Driven):
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.model.propagate(x, u, w) + torch.nn.functional.pad(u.by[:, None, None], (0, 1))


def test_each_step_goes_back_by_its_own_inputs() -> None:
    """Known pushes move a linear model's path by what they alone would do, and nothing else."""
    by, model = (
        torch.tensor([[3.0, -1.0, 0.5, 4.0, -2.0, 1.0, 0.0, 7.0, 5.0]], dtype=torch.float64),
        linear_walk(0.5, 0.3, 0.7),
    )
    record, way = record_of(model, 2, 9), by.cumsum(1)
    pushed = smooth(
        GaussianFilter(TaylorLinearisation()),
        Pushed(model),
        Record(record.y + way[..., None], Push(by)),
    )
    plain = smooth(GaussianFilter(TaylorLinearisation()), model, record)
    torch.testing.assert_close(pushed.mean[..., 0] - way, plain.mean[..., 0])
    torch.testing.assert_close(pushed.mean[..., 1], plain.mean[..., 1])


def test_the_last_state_is_the_filter_s_and_no_other_is() -> None:
    model = linear_walk(0.5, 0.3, 0.7)
    found = smooth(GaussianFilter(TaylorLinearisation()), model, record_of(model, 2, 9))
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(found.mean[:, -1], found.filtered.mean[:, -1])
    assert bool(
        (variance[1, :-1] < found.filtered.variance[1, :-1]).all()
    )  # of run 0 nothing was seen last


class Tumbler(StateSpaceModel):
    """A body whose attitude walks; a receiver sees the rotation vector from the start, as long as it is small."""

    noise_dim, names, units, groups = 3, ("a", "b", "c"), ("rad",) * 3, {"attitude": (0, 1, 2)}
    p0: Tensor

    def __init__(self, size: float) -> None:
        super().__init__()
        self.register_buffer("p0", torch.full((3,), size, dtype=torch.float64))

    @property
    def chart(self) -> Chart:
        return Chart((QuaternionBlock(),))

    @property
    def origin(self) -> Tensor:
        return self.p0.new_tensor([1.0, 0.0, 0.0, 0.0])

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.chart.add(x, 0.5 * self.p0 * w)

    def noise_gain(self, u: Any) -> Tensor:
        return torch.diag(0.5 * self.p0).unsqueeze(0)

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(self.chart.subtract(x, self.origin), self.p0)


def test_on_a_curved_chart_it_is_the_flat_one_where_angles_are_small() -> None:
    size = 1e-3
    flat = LinearGaussian(
        np.eye(3), 0.5 * size * np.eye(3), np.eye(3), [size] * 3, [0.0] * 3, [size] * 3
    )
    record = record_of(flat, 2, 8)
    curved, plain = (
        smooth(GaussianFilter(TaylorLinearisation()), model, record)
        for model in (Tumbler(size), flat)
    )
    vectors = Tumbler(size).chart.subtract(curved.mean, Tumbler(size).origin)
    assert plain.mean.abs().max() > size  # angles of the second order are a thousand times smaller
    torch.testing.assert_close(vectors, plain.mean, rtol=0, atol=10 * size**2)
    torch.testing.assert_close(curved.covariance, plain.covariance, rtol=2e-2, atol=1e-10)


def test_backward_sampling_agrees_with_the_smoother() -> None:
    """Means and variances over paths at every instant, and the covariance of neighbours, that single states do not show."""
    model, steps, clouds, paths = linear_walk(1.0, 0.5, 0.8), 8, 40, 25
    record = record_of(model, 1, steps)
    many = record._replace(
        y=record.y.expand(clouds, -1, -1)
    )  # as many clouds as runs: their scatter is the standard error
    x = sample_trajectories(
        ParticleFilter(150), model, many, PhiloxStream(1, torch.arange(clouds)), paths
    )
    assert x.shape == (clouds, paths, steps, 2)
    mean, covariance = dense(model, record.y[0].numpy())
    inside = torch.from_numpy(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    z = (x - torch.from_numpy(mean)) / inside
    for moment, truth in ((z, 0.0), (z.square(), 1.0)):
        means = moment.mean(1)
        off = (means.mean(0) - truth) / (means.std(0) / clouds**0.5)
        assert off.abs().max() < 4.5, off  # of 16 numbers
    steps_of = (
        x[:, :, 1:, 0] - x[:, :, :-1, 0] - x[:, :, :-1, 1]
    )  # position's own noise: variance q/3 a priori
    assert (
        steps_of.std() < 0.5 / 3**0.5 * 1.3
    )  # paths of unrelated states would scatter by the posterior spread, 0.6 and more


def test_paths_of_a_bent_model_have_the_law_that_a_grid_gives() -> None:
    """The first of three states of the growth model given all three measurements, by quadrature."""
    model = UnivariateGrowth(process_sd=4.0, measurement_sd=1.0, initial_sd=3.0)
    y = np.array([4.0, 5.0, 1.0])
    grid = np.linspace(-45.0, 45.0, 901)
    dx = grid[1] - grid[0]

    def step(t: int) -> np.ndarray:
        mean = 0.5 * grid + 25.0 * grid / (1.0 + grid**2) + 8.0 * np.cos(1.2 * t)
        return np.exp(-0.5 * ((grid[:, None] - mean) / 4.0) ** 2) * dx

    seen = [np.exp(-0.5 * (value - grid**2 / 20.0) ** 2) for value in y]
    ahead = step(1) @ np.exp(-0.5 * (grid / 3.0) ** 2) * seen[0]
    behind = step(2).T @ (seen[1] * (step(3).T @ seen[2]))
    law = ahead * behind / (ahead * behind).sum()
    exact = np.array([(law * (grid > 0)).sum(), (law * grid).sum()])
    clouds = 60
    record = Record(torch.from_numpy(y)[None, :, None].expand(clouds, -1, -1))
    x = sample_trajectories(
        ParticleFilter(400), model, record, PhiloxStream(2, torch.arange(clouds)), 20
    )[:, :, 0, 0]
    shares = torch.stack([(x > 0).double().mean(1), x.mean(1)], 1)
    off = (shares.mean(0) - torch.from_numpy(exact)) / (shares.std(0) / clouds**0.5)
    assert off.abs().max() < 4.0, (off, exact)
    assert (
        exact[0] > 0.75 > 0.45 > ahead[grid > 0].sum() / ahead.sum()
    )  # what came later told the sign


def test_paths_do_not_depend_on_how_many_are_weighed_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = UnivariateGrowth()
    record = ModelSimulation(model, 4).draw(NominalNoise(), torch.arange(2), 0).record
    draws = PhiloxStream(1, torch.arange(2))
    whole = sample_trajectories(ParticleFilter(20), model, record, draws, 7)
    monkeypatch.setattr("pfbench.filter.smoothing._PAIRS", 50)
    torch.testing.assert_close(
        sample_trajectories(ParticleFilter(20), model, record, draws, 7), whole
    )


def test_what_cannot_be_smoothed_says_why() -> None:
    model = linear_walk(1.0, 0.5, 0.8)
    record, draws = record_of(model, 1, 4), PhiloxStream(0, torch.arange(1))
    with pytest.raises(ValueError, match="must have a transition density"):
        sample_trajectories(ParticleFilter(20), SINGULAR, record, draws, 2)
    with pytest.raises(ValueError, match="must be a particle filter"):
        sample_trajectories(GaussianFilter(TaylorLinearisation()), model, record, draws, 2)
    with pytest.raises(ValueError, match="at least 1"):
        sample_trajectories(ParticleFilter(20), model, record, draws, 0)
    with pytest.raises(ValueError, match="adapts"):
        smooth(
            GaussianFilter(TaylorLinearisation(), noise_adaptations=[FadingMemory()]), model, record
        )


def test_a_lost_run_has_no_paths_and_no_smoothed_law_and_spoils_no_other() -> None:
    model = UnivariateGrowth(measurement_sd=1e-3)
    record = Record(torch.tensor([[[1.0], [2.0]], [[1.0], [1e200]]], dtype=torch.float64))
    paths = sample_trajectories(
        ParticleFilter(50), model, record, PhiloxStream(0, torch.arange(2)), 3
    )
    assert torch.isfinite(paths[0]).all()
    assert torch.isnan(paths[1]).all()
