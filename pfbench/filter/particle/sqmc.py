"""Sequential quasi-Monte Carlo (SQMC).

One point of d + 1 coordinates gives ancestor and noise of a particle. Ancestors are quantiles of
the weights in the order of a Hilbert curve through the particles. Close points then select close
ancestors, which preserves the low discrepancy. The evidence is unbiased, as with plain Monte Carlo
[Gerber and Chopin 2015, "Sequential quasi Monte Carlo"].
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, gather_ancestors, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.point_sets import PointSet, SobolPoints
from pfbench.filter.particle.proposals import BootstrapProposal, Proposal, ProposalSample
from pfbench.filter.particle.resampling import EssResampler, Resampler, ResamplingScheme
from pfbench.model.base import StateSpaceModel

_BITS = 62  # of a Hilbert index, in an int64


@dataclass(frozen=True)
class SqmcScheme(ResamplingScheme):
    """Scheme: quantiles of the probabilities at the first coordinates of a point set.

    Attributes:
        points: Point set. Only its first axis is used.
    """

    points: PointSet = field(default_factory=SobolPoints)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"scheme.points": self.points})

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        u = self.points(draws).uniform("quantile", a.shape[1], 1).squeeze(2)
        reach = a.double().cumsum(1)
        ancestors = torch.searchsorted(reach / reach[:, -1:], u.contiguous())
        return ancestors.clamp(max=a.shape[1] - 1)


@dataclass(frozen=True)
class HilbertSortedResampler(Resampler):
    """Sort particles along a Hilbert curve before another resampler.

    With `SqmcScheme` this is the resampling of SQMC. Other schemes benefit from the order too.

    Attributes:
        resampler: Resampler that copies.
    """

    resampler: EssResampler

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.inner": self.resampler})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        order = compute_hilbert_order(model.chart, belief)
        ordered = gather_ancestors(belief, order)
        log_a = ordered.log_w if log_a is belief.log_w else log_a.gather(1, order)
        return self.resampler(model, ordered, log_a, n, draws)


@dataclass(frozen=True)
class SqmcProposal(Proposal):
    """Noise of the model at the coordinates that the choice of ancestors does not use.

    Attributes:
        points: Point set, the same as that of the resampler.
    """

    points: PointSet = field(default_factory=SobolPoints)

    has_bounded_weights = True  # the noise is that of the model

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"proposal.points": self.points})

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        return BootstrapProposal()(model, belief, record, self.points(draws, first=1))


def compute_hilbert_order(chart: Chart, belief: ParticleBelief) -> Tensor:
    """Compute the order of particles along a Hilbert curve.

    See [Gerber and Chopin 2015, section 3.3]. The logistic function maps their deviations from the
    mean, in standard deviations, to the unit cube.

    Args:
        chart: Chart of the state.
        belief: Weighted particles.

    Returns:
        Slots in order, [R, N].
    """
    mean, covariance = weighted_mean_cov(chart, belief)
    d = chart.subtract(belief.x, mean.unsqueeze(1))
    variance = covariance.diagonal(dim1=-2, dim2=-1).unsqueeze(1)
    unit = torch.sigmoid(d / torch.where(variance > 0.0, variance, 1.0).sqrt())
    size = d.shape[-1]
    bits = max(1, min(_BITS // size, max(4, 32 // size)))  # finer cells would only cost time
    cells = (unit[..., :_BITS] * 2**bits).long().clamp(max=2**bits - 1)
    return compute_hilbert_index(cells, bits).argsort(1)


def compute_hilbert_index(cells: Tensor, bits: int) -> Tensor:
    """Compute the index of cells on the Hilbert curve of a cube [Skilling 2004].

    Args:
        cells: Integer coordinates, [..., k].
        bits: The cube has 2^bits cells on a side.

    Returns:
        Index, int64 [...].
    """
    x = list(cells.unbind(-1))
    for level in reversed(range(1, bits)):
        low = (1 << level) - 1
        for i in range(len(x)):
            is_set = (x[i] >> level) & 1 == 1
            swap = torch.where(is_set, 0, (x[0] ^ x[i]) & low)
            x[0] = torch.where(is_set, x[0] ^ low, x[0]) ^ swap
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
