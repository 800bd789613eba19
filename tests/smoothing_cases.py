"""Linear and curved models for the tests of smoothers, and the dense solve of a whole path."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.core import Chart, QuaternionBlock, Record
from pfbench.core.density import independent_normal, normal_batch
from pfbench.model import LinearGaussian, StateSpaceModel
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation

SINGULAR = LinearGaussian(
    [[1.0, 0.7], [0.0, 0.9]], [[0.1], [0.5]], [[1.0, 0.0]], [0.8], [1.0, -1.0], [2.0, 1.0]
)


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


class Swing(StateSpaceModel):
    """Two states driven by one noise, a bent step and a bent measurement of the first state."""

    noise_dim, names, units, groups = 1, ("a", "b"), ("1", "1"), {"all": (0, 1)}
    p0: Tensor
    r: Tensor

    def __init__(self, noise: float = 0.6, measurement_sd: float = 0.3) -> None:
        super().__init__()
        self.noise_sd = noise
        self.register_buffer("p0", torch.tensor([1.0, 1.0], dtype=torch.float64))
        self.register_buffer("r", torch.tensor([measurement_sd], dtype=torch.float64))

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        a, b = x[..., :1], x[..., 1:]
        return torch.cat([a + 0.5 * b, 0.9 * b - 0.5 * torch.sin(a) + self.noise_sd * w], -1)

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(x[..., :1] + x[..., :1] ** 3 / 4.0, self.r)
