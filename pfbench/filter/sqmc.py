"""Sequential quasi-Monte-Carlo: one point of d + 1 coordinates chooses each particle's ancestor and its noise [Gerber and Chopin
2015, "Sequential quasi Monte Carlo"].

Ancestors are quantiles of the weights in the order of a Hilbert curve through the cloud, so that near points choose near
ancestors and the points' evenness survives the step. Everything is as unbiased as with plain Monte Carlo.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.chart import Chart
from pfbench.draws import Draws
from pfbench.filter import belief
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.points import Points, Sobol
from pfbench.filter.proposals import Bootstrap, Proposed
from pfbench.filter.resamplers import Resample
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

_BITS = 62  # of a Hilbert index, in an int64


@dataclass(frozen=True)
class Quantiles:
    """A scheme: ancestors are the quantiles of the probabilities at the first coordinates of a set of points.

    Args:
        points: whose first axis is used.
    """

    points: Points = field(default_factory=Sobol)

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        u = self.points(draws).uniform("quantile", a.shape[1], 1).squeeze(2)
        reach = a.double().cumsum(1)
        chosen = torch.searchsorted(reach / reach[:, -1:], u.contiguous())
        return chosen.clamp(max=a.shape[1] - 1)


@dataclass(frozen=True)
class HilbertSorted:
    """Puts a cloud in the order of a Hilbert curve before another resampler goes through it.

    With `Quantiles` it is sequential quasi-Monte-Carlo's; any other scheme, systematic resampling say, profits from the order as
    well.

    Args:
        inner: the resampler that copies.
    """

    inner: Resample

    @property
    def exact(self) -> bool:
        return self.inner.exact

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        order = hilbert_order(model.chart, cloud)
        ordered = belief.gather(cloud, order)
        return self.inner(model, ordered, ordered.log_w if log_a is cloud.log_w else log_a.gather(1, order), n, draws)


@dataclass(frozen=True)
class PointNoise:
    """The model's own noise at the coordinates of a set of points that the choice of ancestors has left.

    Args:
        points: the same as the resampler's.
    """

    points: Points = field(default_factory=Sobol)
    exact = True

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        return Bootstrap()(model, cloud, seen, self.points(draws, first=1))


def hilbert_order(chart: Chart, cloud: Cloud) -> Tensor:
    """Particles in the order of the Hilbert curve through the unit cube, into which the logistic function takes their differences
    from the mean in standard deviations [Gerber and Chopin 2015, section 3.3]: [R, N]."""
    mean, covariance = moments(chart, cloud)
    d = chart.subtract(cloud.x, mean.unsqueeze(1))
    variance = covariance.diagonal(dim1=-2, dim2=-1).unsqueeze(1)
    unit = torch.sigmoid(d / torch.where(variance > 0.0, variance, 1.0).sqrt())
    size = d.shape[-1]
    bits = max(1, min(_BITS // size, max(4, 32 // size)))  # cells far finer than particles would only cost time
    cells = (unit[..., :_BITS] * 2**bits).long().clamp(max=2**bits - 1)
    return hilbert_index(cells, bits).argsort(1)


def hilbert_index(cells: Tensor, bits: int) -> Tensor:
    """Where cells [..., k] of a cube with 2^bits on a side lie on its Hilbert curve, int64 [...] [Skilling 2004]."""
    x = list(cells.unbind(-1))
    for level in reversed(range(1, bits)):
        low = (1 << level) - 1
        for i in range(len(x)):
            set_ = (x[i] >> level) & 1 == 1
            swap = torch.where(set_, 0, (x[0] ^ x[i]) & low)
            x[0] = torch.where(set_, x[0] ^ low, x[0]) ^ swap
            x[i] = x[i] ^ swap
    for i in range(1, len(x)):
        x[i] = x[i] ^ x[i - 1]
    parity = torch.zeros_like(x[0])
    for level in range(1, bits):
        parity = torch.where((x[-1] >> level) & 1 == 1, parity ^ ((1 << level) - 1), parity)
    index = torch.zeros_like(x[0])
    for level in reversed(range(bits)):
        for axis in x:
            index = index << 1 | (((axis ^ parity) >> level) & 1)
    return index
