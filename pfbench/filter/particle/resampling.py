"""Resampling schemes other than the systematic one, which is a stage of the SIR filter.

Every scheme gives a particle n a copies on average for probabilities a. All are batched and use
counting or sorted search, and sum the probabilities as systematic resampling does.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.particle.stages import (
    ResamplingScheme,
    slots_below,
    sum_exactly,
)


@dataclass(frozen=True)
class Stratified(ResamplingScheme):
    """One uniform per slot, at positions (j + u_j) / n."""

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 1).squeeze(2)
        reach = _cumulative(a) * n
        last_slot = torch.floor(reach).long().clamp(max=a.shape[1] - 1)
        is_below_sum = u.gather(1, last_slot) <= reach - last_slot  # the position in that slot
        return slots_below(last_slot + is_below_sum, n)


@dataclass(frozen=True)
class Multinomial(ResamplingScheme):
    """Independent draws, the textbook scheme with the highest variance."""

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return _invert(_cumulative(a), draws.uniform("resample", a.shape[1], 1).squeeze(2))


@dataclass(frozen=True)
class Residual(ResamplingScheme):
    """floor(n a) copies, and multinomial draws by the remainders [Liu and Chen 1998]."""

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        # in float64: in float32 the weights of 1e6 particles sum to 1 within 5 slots
        expected = a.double() * (n / a.sum(1, keepdim=True, dtype=torch.float64))
        # 49 (1/49) < 1: without this tolerance all copies of equal weights would be random
        certain = torch.floor(expected * (1.0 + 4.0 * torch.finfo(a.dtype).eps))
        missing = n - certain.sum(1, keepdim=True).long()
        residual = (expected - certain).clamp(min=0.0)
        residual = residual / residual.sum(1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny)
        index = _invert(_cumulative(residual), draws.uniform("resample", a.shape[1], 1).squeeze(2))
        slots = torch.arange(a.shape[1], device=a.device)
        counts = certain.long().scatter_add(1, index, (slots < missing).long())
        return slots_below(counts.cumsum(1), n)


def _cumulative(a: Tensor) -> Tensor:
    """Return cumulative sums [R, N] whose last value is exactly 1, float64."""
    sums = sum_exactly(a)
    return sums / sums[:, -1:]


def _invert(cumulative: Tensor, u: Tensor) -> Tensor:
    """Draw indices [R, M] by inversion of cumulative sums [R, N] at u [R, M]."""
    return torch.searchsorted(cumulative, u.to(cumulative.dtype).contiguous()).clamp(
        max=cumulative.shape[1] - 1
    )
