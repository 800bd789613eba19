"""Sequential quasi-Monte Carlo (SQMC).

One point of d + 1 coordinates gives ancestor and noise of a particle. Ancestors are quantiles of
the weights in the order of a Hilbert curve through the particles. Close points then select close
ancestors, which preserves the low discrepancy. The evidence is unbiased, as with plain Monte Carlo
[Gerber and Chopin 2015, "Sequential quasi Monte Carlo"].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import DerivedStream, PhiloxStream, RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, gather_ancestors, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.stages import (
    BootstrapProposal,
    EssResampler,
    PointSet,
    Proposal,
    ProposalSample,
    Resampler,
    ResamplingScheme,
)
from pfbench.model.base import StateSpaceModel

# Each draw of a point set has a new shift. Each shifted point is uniform, so averages are unbiased and their spread
# over runs is a valid error. The base set is fixed and cached. The shift comes from the counter-based
# stream, so the points of a run depend only on seed, run, step and label.

_EDGE = 1e-9  # a shifted point may be 0, and its normal quantile infinite

_POINT_BITS = 30  # of a point of the Sobol engine of torch


class ShiftedPoints(PointSet, Protocol):
    """Fixed points with a new uniform shift for each run, step, label and axis."""

    def shift_points(self, axes: range, n: int, shift: Tensor) -> Tensor:
        """Compute points 0 to n - 1 under a shift.

        Shapes: shift [w, R, 1].
        """

    @override
    def __call__(self, draws: RandomStream, first: int = 0) -> RandomStream:
        def uniforms(draws: RandomStream, purpose: str, n: int, w: int) -> Tensor:
            shift = draws.uniform(purpose, 1, w).permute(2, 0, 1)
            return self.shift_points(range(first, first + w), n, shift).permute(1, 2, 0)

        return DerivedStream(draws, uniforms)


@dataclass(frozen=True)
class HaltonPoints(ShiftedPoints):
    """Radical inverses in the first prime bases [Halton 1960], shifted modulo 1.

    Attributes:
        skip: Number of points omitted at the beginning.
        permute_digits: Permute the digits of each base by a fixed permutation [Owen 2017; ours].
            Without it neighbouring axes of large base are correlated: 0.27 for some of 21 axes with
            400 points, 0.05 by chance. With six axes the effect is negligible.
        shifted: Shift each draw. False gives one set, the same in each draw and run, whose error
            does not average out.

    Raises:
        ValueError: If the number is negative.

    References:
        Cranley and Patterson 1976 (shift).
    """

    skip: int = 20
    permute_digits: bool = True
    shifted: bool = True

    @property
    @override
    def is_exact(self) -> bool:
        """True if each point is uniform."""
        return self.shifted

    def __post_init__(self) -> None:
        require_ranges("points", self, skip="[0, inf]")

    @override
    def shift_points(self, axes: range, n: int, shift: Tensor) -> Tensor:
        base = halton_points(self.skip, n, axes, self.permute_digits).to(shift.device)
        shift = shift if self.shifted else torch.zeros_like(shift)
        return ((base.unsqueeze(1) + shift) % 1.0).clamp(_EDGE, 1.0 - _EDGE)


@dataclass(frozen=True)
class SobolPoints(ShiftedPoints):
    """Sobol points with the direction numbers of Joe and Kuo, and a digital shift.

    The digital shift preserves the net.
    """

    is_exact = True

    @override
    def shift_points(self, axes: range, n: int, shift: Tensor) -> Tensor:
        digits = sobol_digits(n, axes).to(shift.device).unsqueeze(1)
        return ((digits ^ (shift * 2.0**_POINT_BITS).long()).double() + 0.5) * 2.0**-_POINT_BITS


@cache
def halton_points(skip: int, n: int, axes: range, permuted: bool = False) -> Tensor:
    """Compute Halton points without shift, in base 2 for example 1/2, 1/4, 3/4, 1/8.

    The set begins with point `skip` + 1.
    """
    bases = first_primes(axes.stop)
    return torch.stack([_radical_inverse(skip + 1, n, bases[a], permuted) for a in axes])


def _radical_inverse(start: int, n: int, base: int, permuted: bool) -> Tensor:
    """Return the radical inverses of start, start + 1, ... in a base, [n]."""
    number = torch.arange(start, start + n)
    value, weight, digit = torch.zeros(n, dtype=torch.float64), 1.0, 0
    while bool((number > 0).any()):
        digits, weight = number % base, weight / base
        if permuted:  # from a fixed stream: the same for all seeds and machines
            stream = PhiloxStream(0, torch.tensor([base])).at_step(digit)
            digits = stream.uniform("points.digits", base, 1)[0, :, 0].argsort()[digits]
        value, number, digit = value + weight * digits.double(), number // base, digit + 1
    return value


@cache
def sobol_digits(n: int, axes: range) -> Tensor:
    """Return Sobol points without shift, times 2^30."""
    points = SobolEngine(axes.stop).draw(n, dtype=torch.float64)
    return (points * 2.0**_POINT_BITS).long().T[axes.start :].contiguous()


def first_primes(count: int) -> list[int]:
    """Return the first prime numbers."""
    limit = max(20, int(count * (np.log(count + 2) + np.log(np.log(count + 2) + 1) + 1)) + 10)
    candidates = range(2, limit)
    numbers = [p for p in candidates if all(p % q for q in range(2, int(p**0.5) + 1))]
    return numbers[:count]


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

    Returns slots in order, [R, N].
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

    Returns index, int64 [...]. Shapes: cells [..., k].
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
