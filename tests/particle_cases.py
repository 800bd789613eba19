"""Models whose filtering problem has a known answer, for the tests of particle filters."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import oracles
import torch
from pyro.distributions import Laplace, Normal
from torch import Tensor
from torch.distributions import Distribution, Independent, Uniform

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import ParticleBelief, ParticleFilter
from pfbench.model import (
    Benes,
    LinearGaussian,
    StateSpaceModel,
    StochasticVolatility,
    UnivariateGrowth,
    linear_walk,
    local_level,
)
from pfbench.testing import FilterMoments, reference_moments

WALK = linear_walk(1.0, 0.5, 1.0)
WALK_Y = torch.tensor([[0.8], [2.9], [1.2], [math.nan], [3.0], [6.5]], dtype=torch.float64)


def by_grid(
    grid: np.ndarray, prior: np.ndarray, y: Tensor, transition: Any, log_likelihood: Any
) -> FilterMoments:
    mean, variance, log_z = oracles.grid_filter(grid, prior, transition, log_likelihood, len(y))
    return FilterMoments(mean[-1:], variance[-1:] + mean[-1:] ** 2, log_z)


def growth_case(
    measurement_sd: float = 4.0, steps: int = 6
) -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    """Measurements of a path that the model might take, in noise that leaves both signs of the state possible."""
    rng, x, rows = np.random.default_rng(3), 0.5, []
    for t in range(1, steps + 1):
        x = x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * t) + math.sqrt(10) * rng.normal()
        rows.append([x**2 / 20 + measurement_sd * rng.normal()])
    y, grid = torch.tensor(rows), np.linspace(-45, 45, 1501)

    def transition(t: int) -> np.ndarray:
        centre = grid / 2 + 25 * grid / (1 + grid**2) + 8 * np.cos(1.2 * (t + 1))
        return oracles.normal_density(grid[:, None], centre[None], math.sqrt(10.0))

    def log_likelihood(t: int) -> np.ndarray:
        z = (y[t].item() - grid**2 / 20) / measurement_sd
        return -0.5 * z**2 - 0.5 * math.log(2 * math.pi * measurement_sd**2)

    prior = oracles.normal_density(grid, 0.0, math.sqrt(2.0))
    return (
        UnivariateGrowth(measurement_sd=measurement_sd),
        y,
        by_grid(grid, prior, y, transition, log_likelihood),
    )


def volatility_case() -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    y = torch.tensor(
        [[0.3], [-1.1], [2.0], [0.1], [-0.7], [0.2], [1.5], [-0.4]], dtype=torch.float64
    )
    grid = np.linspace(-7, 5, 1201)
    matrix = oracles.normal_density(grid[:, None], -1.0 + 0.95 * (grid[None] + 1.0), 0.3)
    prior = oracles.normal_density(grid, -1.0, 0.3 / math.sqrt(1 - 0.95**2))

    def log_likelihood(t: int) -> np.ndarray:
        return -0.5 * y[t].item() ** 2 * np.exp(-grid) - 0.5 * grid - 0.5 * math.log(2 * math.pi)

    return (
        StochasticVolatility(-1.0, 0.95, 0.3),
        y,
        by_grid(grid, prior, y, lambda t: matrix, log_likelihood),
    )


def benes_case() -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    """Steps so large that the law of the next state has two modes."""
    y = torch.tensor([[0.4], [-0.3], [1.9], [2.2], [4.0]], dtype=torch.float64)
    mean, variance, log_z = oracles.benes(y[:, 0].numpy(), 0.8, 1.0)
    return Benes(0.8, 1.0), y, FilterMoments(mean[-1:], variance[-1:] + mean[-1:] ** 2, log_z)


def level_case() -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    model = local_level(1.0, 1.5, 3.0, 2.0, observes_initial=True)
    y = torch.tensor([[4.0], [1.0], [2.5], [math.nan], [5.0]], dtype=torch.float64)
    return model, y, reference_moments(model, y)


def singular_case() -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    """Three states, one noise, a correlated initial law, measurements that are partly missing."""
    model = LinearGaussian(
        [[0.9, 0.5, 0.0], [0.0, 0.8, 0.3], [0.1, 0.0, 0.7]], [[0.0], [0.3], [1.0]],
        [[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], [1.0, 2.0],
        [1.0, 0.0, -1.0], [[1.0, 0.0, 0.0], [0.8, 0.5, 0.0], [0.3, -0.4, 0.7]],
    )  # fmt: skip
    y = torch.tensor(
        [[2.0, 1.0], [math.nan, -1.0], [0.5, math.nan], [1.5, 1.0]], dtype=torch.float64
    )
    return model, y, reference_moments(model, y)


CASES: dict[str, Callable[[], tuple[StateSpaceModel, Tensor, FilterMoments]]] = {
    "growth": growth_case,
    "volatility": volatility_case,
    "benes": benes_case,
    "level seen at once": level_case,
    "singular": singular_case,
}


class Drifting(LinearGaussian):
    """Its noise is normal, but neither centred nor of unit variance."""

    @property
    def noise(self) -> Distribution:
        return Independent(Normal(self.m0.new_tensor([0.4]), self.m0.new_tensor([1.5])), 1)


class Spiky(LinearGaussian):
    """Its noise is Laplace's."""

    @property
    def noise(self) -> Distribution:
        return Independent(Laplace(self.m0.new_tensor([0.4]), self.m0.new_tensor([1.5])), 1)


class BoundedErrors(LinearGaussian):
    """Its measurement errors are uniform, and the noise is normal."""

    linear = False

    def observation(self, x: Tensor, u: Any) -> Distribution:
        width = 0.5 * self.r
        return Independent(Uniform(x - width, x + width, validate_args=False), 1)


class BoundedNoise(LinearGaussian):
    """Its noise is uniform, of variance 1, and the measurement errors are normal."""

    linear = False

    @property
    def noise(self) -> Distribution:
        end = self.m0.new_tensor([math.sqrt(3.0)])
        return Independent(Uniform(-end, end, validate_args=False), 1)

    def transition(self, x: Tensor, u: Any) -> None:
        return None


def bounded_case(kind: type[LinearGaussian]) -> tuple[StateSpaceModel, Tensor, FilterMoments]:
    """One state with x' = 0.9 x + w, against a grid."""
    model = kind([[0.9]], [[1.0]], [[1.0]], [1.6 if kind is BoundedErrors else 0.4], [0.0], [1.0])
    y, grid = torch.tensor([[1.5], [-1.2], [0.4]]).double(), np.linspace(-12, 12, 4801)
    step = grid[:, None] - 0.9 * grid[None]
    if kind is BoundedErrors:
        moved = oracles.normal_density(step, 0.0, 1.0)
    else:
        moved = (abs(step) < math.sqrt(3.0)) / (2 * math.sqrt(3.0))

    def log_likelihood(t: int) -> np.ndarray:
        error = y[t].item() - grid
        if kind is BoundedErrors:
            return np.where(abs(error) < 0.8, -math.log(1.6), -np.inf)
        return np.log(oracles.normal_density(error, 0.0, 0.4))

    prior = oracles.normal_density(grid, 0.0, 1.0)
    return model, y, by_grid(grid, prior, y, lambda t: moved, log_likelihood)


HARD: dict[str, Callable[[], tuple[StateSpaceModel, Tensor, FilterMoments]]] = {
    "bounded errors": lambda: bounded_case(BoundedErrors),
    "bounded noise": lambda: bounded_case(BoundedNoise),
    "two modes": lambda: growth_case(1.0, 3),
}


def belief(model: StateSpaceModel, n: int = 40, runs: int = 3) -> ParticleBelief:
    cloud = ParticleFilter(n).init(model, runs, PhiloxStream(5, torch.arange(runs)))
    log_w = PhiloxStream(5, torch.arange(runs)).normal("w", n, 1)[..., 0].log_softmax(-1)
    return cloud._replace(log_w=log_w)
