"""Resampling schemes: ancestors drawn by probabilities.

Every scheme gives a particle n a copies on average for probabilities a. All are batched and use
counting or sorted search. Indices stay in range: cumulative sums are float64 from N = 1e5, and their
last value is set to 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable

_DOUBLE_FROM = (
    100_000  # particles; float32 then gets one ancestor in 500 wrong, and the evidence drifts
)


@dataclass(frozen=True)
class Systematic:
    """One uniform for all slots, at positions (j + u) / n. Counts differ from n a by less than 1."""

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return _evenly(_precise(a), n, draws.uniform("resample", 1, 1).squeeze(1))


def _counted_evenly(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Return ancestors [R, N] by the positions (j + u) / n of slots j, u [R, 1]."""
    reach = _cumulative(a) * n
    # where, since n - u rounds to n - 1 in float32 and the last slot would go to a last particle of weight 0
    return _ancestors(torch.where(reach < n, torch.ceil(reach - u.to(reach.dtype)), n).long(), n)


_evenly = compilable(_counted_evenly, operator=cpp.resample_systematic)


@dataclass(frozen=True)
class Stratified:
    """One uniform per slot, at positions (j + u_j) / n."""

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 1).squeeze(2)
        reach = _cumulative(a) * n
        whole = torch.floor(reach).long().clamp(max=a.shape[1] - 1)
        inside = (
            u.gather(1, whole) <= reach - whole
        )  # whether the position in the last slot lies below the sum
        return _ancestors(whole + inside, n)


@dataclass(frozen=True)
class Multinomial:
    """Independent draws, the textbook scheme with the highest variance."""

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return _pick(_cumulative(a), draws.uniform("resample", a.shape[1], 1).squeeze(2))


@dataclass(frozen=True)
class Residual:
    """floor(n a) copies, the rest multinomial by the remainders [Liu and Chen 1998]."""

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        wanted = _wanted(a, n)
        # 49 (1/49) is less than 1: without this tolerance equal weights would all be drawn at random
        sure = torch.floor(wanted * (1.0 + 4.0 * torch.finfo(a.dtype).eps))
        missing = n - sure.sum(1, keepdim=True).long()
        left = (wanted - sure).clamp(min=0.0)
        left = left / left.sum(1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny)
        drawn = _pick(_cumulative(left), draws.uniform("resample", a.shape[1], 1).squeeze(2))
        slots = torch.arange(a.shape[1], device=a.device)
        counts = sure.long().scatter_add(1, drawn, (slots < missing).long())
        return _ancestors(counts.cumsum(1), n)


@dataclass(frozen=True)
class Ssp:
    """Srinivasan's sampling process: counts floor(n a) or one more, negatively associated.

    Pairs of fractional parts are resolved in a tournament of log2 N batched rounds. The order of the
    pairs is free [Srinivasan 2001].

    References:
        Gerber, Chopin, Whiteley 2019.
    """

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        wanted = _wanted(a, n)
        counts = torch.floor(wanted)
        width = 1 << max(1, (a.shape[1] - 1).bit_length())
        pad = width - a.shape[1]
        p = torch.nn.functional.pad(wanted - counts, (0, pad))
        holder = torch.arange(width, device=a.device).expand(a.shape[0], -1)
        u = draws.uniform("resample", width, 1).squeeze(2)
        extra = torch.zeros_like(p)
        used = 0
        while p.shape[1] > 1:
            first, second = p[:, 0::2], p[:, 1::2]
            toss = u[:, used : used + first.shape[1]]
            used += first.shape[1]
            p, settled, leaves = _settle(first, second, toss)
            out = torch.where(leaves, holder[:, 0::2], holder[:, 1::2])
            holder = torch.where(leaves, holder[:, 1::2], holder[:, 0::2])
            extra = extra.scatter_add(1, out, settled)
        extra = extra.scatter_add(1, holder, p.round())  # the fractions sum to a whole number
        counts = (counts + extra[:, : a.shape[1]]).long()
        return _ancestors(counts.cumsum(1), n)


@dataclass(frozen=True)
class Killing:
    """Keep a particle with probability a / max a, else replace it by a multinomial draw.

    Slots keep their particles, so the number of particles must be constant.

    References:
        Del Moral 2004.
    """

    is_exact = True

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 2)
        survives = u[..., 0] * a.max(1, keepdim=True).values < a
        slots = torch.arange(a.shape[1], device=a.device).expand_as(survives)
        return torch.where(survives, slots, _pick(_cumulative(a), u[..., 1]))


def _settle(first: Tensor, second: Tensor, toss: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the remaining fraction, the count of the member that leaves, and whether it is the first."""
    both = first + second
    over = both >= 1.0
    # sum below 1: one leaves with 0, the other carries the sum; above: one leaves with 1, the other carries the rest
    chance = torch.where(
        over, (1.0 - second) / (2.0 - both).clamp(min=1e-300), second / both.clamp(min=1e-300)
    )
    return both - over.to(both.dtype), over.to(both.dtype), toss < chance


def _wanted(a: Tensor, n: Tensor) -> Tensor:
    """Return expected copies [R, N] in float64: in float32, weights of 1e6 particles sum to 1 within 5 slots."""
    return a.double() * (n / a.sum(1, keepdim=True, dtype=torch.float64))


def _cumulative(a: Tensor) -> Tensor:
    """Return cumulative sums [R, N] whose last value is exactly 1."""
    sums = _precise(a).cumsum(1)
    return sums / sums[:, -1:]


def _precise(a: Tensor) -> Tensor:
    """Convert to float64 for many particles."""
    return a.double() if a.shape[1] >= _DOUBLE_FROM else a


def _pick(cumulative: Tensor, u: Tensor) -> Tensor:
    """Draw independent indices [R, M] by inversion of cumulative sums [R, N] at u [R, M]."""
    return torch.searchsorted(cumulative, u.to(cumulative.dtype).contiguous()).clamp(
        max=cumulative.shape[1] - 1
    )


def _ancestors(below: Tensor, n: Tensor) -> Tensor:
    """Return ancestors [R, N] from cumulative counts of copies, int64 [R, N], non-decreasing."""
    # slot j belongs to the first particle that ends after it: count particles by where they end, and sum
    (runs, slots), wanted = below.shape, n.long()
    ends = torch.minimum(below, wanted).clamp(
        min=0
    )  # in float32 the largest uniform is 1 and ends a weight of 0 at -1
    last = torch.arange(slots, device=below.device) == slots - 1
    ends = torch.where(last, wanted, ends)  # exact in spite of rounding
    counts = torch.zeros(runs, slots + 1, dtype=torch.long, device=ends.device).scatter_add(
        1, ends, torch.ones_like(ends)
    )
    return counts.cumsum(1)[:, :slots].clamp(max=slots - 1)
