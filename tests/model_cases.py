"""Models and records of several tests of filters."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench.core import (
    AngleBlock,
    Chart,
    Episode,
    EuclideanBlock,
    PhiloxStream,
    Record,
    wrap_angle,
)
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import FilterResult, run_filter
from pfbench.job.scoring import ScoreRecorder
from pfbench.model import LinearGaussian, Pendulum, StateSpaceModel
from pfbench.noise import NominalNoise
from pfbench.scenario import ModelSimulation

RUNS = torch.tensor([7, 0, 12])  # of records with gaps


def simulate_with_gaps(model: StateSpaceModel, steps: int = 20) -> Record:
    """A record of `RUNS` with a component missing at times, in some runs."""
    record = ModelSimulation(model, steps).draw(NominalNoise(), RUNS, 1).record
    record.y[1, 4] = record.y[2, 7:9, 0] = torch.nan
    return record


def filter_with_scores(
    method: Any, model: StateSpaceModel, episode: Episode, seed: int = 1
) -> FilterResult:
    """Filter the runs of an episode, and record their scores."""
    runs = torch.arange(episode.record.y.shape[0])
    watch = ScoreRecorder(model, model.assemble(episode.truth))
    with torch.no_grad():
        return run_filter(method, model, episode.record, PhiloxStream(seed, runs), watch)


def tracker() -> LinearGaussian:
    """Two states, each driven, two sensors."""
    h = [[1.0, 0.0], [0.3, 1.0]]
    return LinearGaussian(
        [[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.0], [0.2, 0.5]], h, [1.0, 0.8], [0.3, -0.2], [1.5, 1.0]
    )


def measurements(model: StateSpaceModel, runs: int = 4, steps: int = 8) -> Tensor:
    dy = model.observation(torch.ones(1, 1, model.chart.size, dtype=torch.float64), ()).event_shape[
        0
    ]
    mean = model.initial(1).mean[0, :dy] if dy == 3 else 0.0
    return mean + PhiloxStream(8, torch.arange(runs)).normal("y", steps, dy)


class Unrolled(Pendulum):
    """The pendulum on the real line."""

    @property
    def chart(self) -> Chart:
        return Chart((EuclideanBlock(2),))


class Hidden(LinearGaussian):
    """A linear model that keeps its noise gain to itself: the noise goes through the rule, as an unknown beside the state."""

    def noise_gain(self, u: Any) -> None:
        return None


class Turning(LinearGaussian):
    """A linear model whose first state is an angle."""

    @property
    def chart(self) -> Chart:
        return Chart((AngleBlock(1), EuclideanBlock(1)))


class Fragile(LinearGaussian):
    """A walk whose mechanisation fails far out: some particles become NaN, others infinite."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        moved = torch.where(x[..., :1] > 2.5, torch.nan, moved)
        return torch.where(x[..., :1] < -2.5, torch.inf, moved)


def four_states(
    sd: Sequence[float] = (0.5, 20.0, 0.1), kind: type[LinearGaussian] = LinearGaussian
) -> LinearGaussian:
    """Damped rotations coupled at random, a singular transition, three components of these deviations."""
    rng = np.random.default_rng(4)
    f = 0.4 * rng.normal(size=(4, 4))
    f *= 0.95 / np.abs(np.linalg.eigvals(f)).max()
    p = rng.normal(size=(4, 4))
    root = np.linalg.cholesky(p @ p.T + np.eye(4))
    g, h = rng.normal(size=(4, 2)), rng.normal(size=(3, 4))
    return kind(f, g, h, list(sd), rng.normal(size=4), root)


class BearingDistance(StateSpaceModel):
    """A point in the plane that walks, seen by bearing and distance from the origin; `turned` as a whole."""

    def __init__(self, turned: float = 0.0, sd: Sequence[float] = (0.02, 0.1)) -> None:
        super().__init__()
        self.register_buffer("s", torch.tensor(sd, dtype=torch.float64))
        self.names, self.units, self.noise_dim = ("x", "y"), ("m", "m"), 2
        self.groups = {"position": (0, 1)}
        self.turned = turned

    @property
    def rotation(self) -> Tensor:
        c, s = math.cos(self.turned), math.sin(self.turned)
        return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)

    def initial(self, runs: int) -> Distribution:
        start = self.rotation @ self.s.new_tensor([2.0, 0.0])
        return normal_batch(runs, self.s.new_tensor([0.3, 0.3]), start)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + 0.05 * w @ self.rotation.mT

    def observation(self, x: Tensor, u: Any) -> Independent:
        seen = torch.stack([torch.atan2(x[..., 1], x[..., 0]), x.norm(dim=-1)], -1)
        return independent_normal(seen[..., : len(self.s)], self.s)

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        return torch.cat([wrap_angle(y[..., :1] - y_hat[..., :1]), y[..., 1:] - y_hat[..., 1:]], -1)


class Bearing(BearingDistance):
    """The same, seen by its bearing alone; West of the origin, bearings jump between pi and -pi."""

    def __init__(self, turned: float = 0.0) -> None:
        super().__init__(turned, (0.05,))
