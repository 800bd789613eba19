"""Models and records of several tests of filters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pfbench.core.chart import Chart, EuclideanBlock
from pfbench.core.random_stream import PhiloxStream
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.model.textbook import Pendulum


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


class Fragile(LinearGaussian):
    """A walk whose mechanisation fails far out: some particles become NaN, others infinite."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        moved = torch.where(x[..., :1] > 2.5, torch.nan, moved)
        return torch.where(x[..., :1] < -2.5, torch.inf, moved)
