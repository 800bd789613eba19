"""Refreshing a cloud: which particles go on, and with what weights.

A resampler returns particles, not indices, since some (regularised, aggregating) do not copy. Every scheme gives each
particle on average n a copies for probabilities a. All are batched, work by counting or sorted search, and never index out
of range: cumulative sums are float64 from N = 1e5 on and their last value is set, not trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench import native
from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter import belief
from pfbench.filter.belief import Cloud, moments
from pfbench.fusion import fusible
from pfbench.model.base import StateSpaceModel

_DOUBLE_FROM = 100_000  # particles; in float32 one ancestor in 500 is wrong there, and the evidence drifts


class Scheme(Protocol):
    """Probabilities a [R, N] and the number n [R, 1] wanted of N slots -> ancestors [R, N]; slots from n on are ignored."""

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor: ...


class Resampler(Protocol):
    """log_a: log resampling probabilities [R, N], n: wanted particles [R, 1] -> the cloud and which runs were touched [R]."""

    @property
    def exact(self) -> bool: ...

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]: ...


@dataclass(frozen=True)
class Resample:
    """Copies particles by a scheme where the effective sample size has fallen.

    Args:
        scheme: how ancestors are drawn.
        threshold: resample the runs with ESS < threshold n; 1 resamples always, 0 never.

    Raises:
        ValueError: threshold outside [0, 1].
    """

    scheme: Scheme
    threshold: float = 0.5
    exact = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"resampler.threshold={self.threshold}: give a ratio of ESS to N between 0 (never) and 1 (always)")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        a = torch.exp(log_a)
        hit = torch.ones_like(cloud.log_z, dtype=torch.bool)
        if self.threshold < 1.0:
            hit = 1.0 / a.square().sum(-1) < self.threshold * n.squeeze(1)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.threshold < 1.0:
            ancestors = torch.where(hit.unsqueeze(1), ancestors, slots)
        fresh = belief.gather(cloud, ancestors)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not cloud.log_w:  # preferred by something else than the weights, which then carry the correction
            log_w = log_w + (cloud.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        return fresh._replace(log_w=log_w if self.threshold == 1.0 else torch.where(hit.unsqueeze(1), log_w, cloud.log_w)), hit


class Smoothing(Protocol):
    """A density K(e) of d whitened coordinates, the same for e and -e, that smooths a cloud: x + h A e."""

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        """The h that is best for n normal particles in d dimensions [R, 1]."""

    def variance(self, d: int) -> float:
        """Of each coordinate of e."""

    def draw(self, draws: Draws, purpose: str, n: int, d: int) -> Tensor:
        """e [R, n, d]."""


@dataclass(frozen=True)
class NormalKernel:
    """K = N(0, I), h = (4/(d+2))^(1/(d+4)) N^(-1/(d+4)) [Silverman 1986; Musso, Oudjane, Le Gland 2001]."""

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        return (4.0 / (d + 2)) ** (1.0 / (d + 4)) * n ** (-1.0 / (d + 4))

    def variance(self, d: int) -> float:
        return 1.0

    def draw(self, draws: Draws, purpose: str, n: int, d: int) -> Tensor:
        return draws.normal(purpose, n, d)


@dataclass(frozen=True)
class Epanechnikov:
    """K = (d+2)/(2 c) (1 - |e|^2) on the unit ball, whose volume is c: the kernel of least mean integrated squared error.

    h = (8 (d+4) (2 sqrt(pi))^d / (c N))^(1/(d+4)) [Musso, Oudjane, Le Gland 2001].
    """

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        log_volume = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0)
        log_top = math.log(8.0 * (d + 4)) + d * math.log(2.0 * math.sqrt(math.pi)) - log_volume
        return math.exp(log_top / (d + 4)) * n ** (-1.0 / (d + 4))

    def variance(self, d: int) -> float:
        return 1.0 / (d + 4)

    def draw(self, draws: Draws, purpose: str, n: int, d: int) -> Tensor:
        """In a uniform direction; the squared length is Beta(d/2, 2), a product of powers of two uniforms."""
        e = draws.normal(purpose, n, d)
        u = draws.uniform(f"{purpose}.length", n, 2).to(e.dtype)
        return e / e.norm(dim=-1, keepdim=True) * (u[..., :1] ** (1.0 / d) * u[..., 1:] ** (1.0 / (d + 2)))


@dataclass(frozen=True)
class Regularise:
    """Draws from a kernel estimate of the cloud: copies by `inner`, then adds h A e in the chart to the runs it touched.

    Covariance A A' is that of the weighted cloud before resampling; h is the kernel's optimal bandwidth times `scale`
    [Musso, Oudjane, Le Gland 2001; Yan et al. 2016, eqs. 7-9, whose eq. 9 prints n - 2 for n + 2 and loses a sign].

    Args:
        inner: the resampler that copies.
        scale: factor on the optimal bandwidth; 1/2 for clouds of several modes.
        shrink: pull particles to the mean first, so that the covariance is kept [West 1993; Liu and West 2001]; without it
            each refresh multiplies the covariance by 1 + h^2 times the kernel's variance.
        kernel: the law of e.
    """

    inner: Resample
    scale: float = 1.0
    shrink: bool = False
    kernel: Smoothing = field(default_factory=NormalKernel)
    exact = False

    def __post_init__(self) -> None:
        if not self.scale > 0.0:
            raise ValueError(f"resampler.scale={self.scale}: give a positive factor on the optimal bandwidth")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        mean, covariance = moments(model.chart, cloud)
        fresh, hit = self.inner(model, cloud, log_a, n, draws)
        d = covariance.shape[-1]
        h = self.scale * self.kernel.bandwidth(d, n.to(covariance.dtype))  # [R, 1]
        e = self.kernel.draw(draws, "regularise", fresh.x.shape[1], d)
        step = h.unsqueeze(-1) * (e @ factor(covariance)[0].mT)
        centre = mean.unsqueeze(1)
        if self.shrink:
            kept = torch.sqrt(1.0 - (self.kernel.variance(d) * h * h).clamp(max=1.0))
            x = model.chart.add(centre, kept.unsqueeze(-1) * model.chart.subtract(fresh.x, centre) + step)
        else:
            x = model.chart.add(fresh.x, step)
        return fresh._replace(x=torch.where(hit[:, None, None], x, fresh.x)), hit


@dataclass(frozen=True)
class Systematic:
    """One uniform for all slots, positions (j + u) / n. Counts are within 1 of n a."""

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        return _evenly(_precise(a), n, draws.uniform("resample", 1, 1).squeeze(1))


def _counted_evenly(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Ancestors [R, N] by the positions (j + u) / n of slots j; u [R, 1]."""
    reach = _cumulative(a) * n
    # where, since n - u rounds to n - 1 in float32 and the last slot would go to a last particle of weight 0
    return _ancestors(torch.where(reach < n, torch.ceil(reach - u.to(reach.dtype)), n).long(), n)


_evenly = fusible(_counted_evenly, by_hand=native.systematic)


@dataclass(frozen=True)
class Stratified:
    """One uniform for each slot, positions (j + u_j) / n."""

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 1).squeeze(2)
        reach = _cumulative(a) * n
        whole = torch.floor(reach).long().clamp(max=a.shape[1] - 1)
        inside = u.gather(1, whole) <= reach - whole  # does the position in the slot that the sum ends in lie below it?
        return _ancestors(whole + inside, n)


@dataclass(frozen=True)
class Multinomial:
    """Independent draws. The highest variance of all; the textbook scheme."""

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        return _pick(_cumulative(a), draws.uniform("resample", a.shape[1], 1).squeeze(2))


@dataclass(frozen=True)
class Residual:
    """floor(n a) copies for certain, the rest multinomial on what is left [Liu and Chen 1998]."""

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        wanted = _wanted(a, n)
        # 49 (1/49) is less than 1: without a few roundings of grace, equal weights would all be drawn by lot
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
    """Srinivasan's sampling process: counts floor(n a) or one more, negatively associated [Gerber, Chopin, Whiteley 2019].

    Pairs of fractional parts are resolved in a tournament, so that N particles take log2 N batched rounds, not N steps; the
    order of pairing is free [Srinivasan 2001].
    """

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
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
    """A particle survives with probability a / max a, or is replaced by a multinomial draw [Del Moral 2004].

    Slots keep their particles, so it needs the number of particles to stay as it is.
    """

    def __call__(self, a: Tensor, n: Tensor, draws: Draws) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 2)
        survives = u[..., 0] * a.max(1, keepdim=True).values < a
        slots = torch.arange(a.shape[1], device=a.device).expand_as(survives)
        return torch.where(survives, slots, _pick(_cumulative(a), u[..., 1]))


def _settle(first: Tensor, second: Tensor, toss: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One round of the tournament for pairs of fractions.

    Returns: the fraction carried on, the count (0 or 1) of the member that leaves, and whether the first member leaves.
    """
    both = first + second
    over = both >= 1.0
    # sum below 1: one leaves with 0, the other carries the sum; above: one leaves with 1, the other carries the rest
    chance = torch.where(over, (1.0 - second) / (2.0 - both).clamp(min=1e-300), second / both.clamp(min=1e-300))
    return both - over.to(both.dtype), over.to(both.dtype), toss < chance


def _wanted(a: Tensor, n: Tensor) -> Tensor:
    """Expected copies [R, N], float64: a float32 softmax of 1e6 particles sums to 1 only within 5e-6, that is 5 slots."""
    return a.double() * (n / a.sum(1, keepdim=True, dtype=torch.float64))


def _cumulative(a: Tensor) -> Tensor:
    """Cumulative sums [R, N] whose last value is 1, whatever rounding did."""
    sums = _precise(a).cumsum(1)
    return sums / sums[:, -1:]


def _precise(a: Tensor) -> Tensor:
    return a.double() if a.shape[1] >= _DOUBLE_FROM else a


def _pick(cumulative: Tensor, u: Tensor) -> Tensor:
    """Independent draws from the law with these cumulative sums, by inversion: [R, N], [R, M] -> [R, M]."""
    return torch.searchsorted(cumulative, u.to(cumulative.dtype).contiguous()).clamp(max=cumulative.shape[1] - 1)


def _ancestors(below: Tensor, n: Tensor) -> Tensor:
    """Ancestors [R, N] from the number of slots filled up to and including each particle, int64 [R, N], non-decreasing.

    Slot j belongs to the first particle that ends after it: count particles by where they end, and sum.
    """
    (runs, slots), wanted = below.shape, n.long()
    ends = torch.minimum(below, wanted).clamp(min=0)  # in float32 the largest uniform is 1 and ends a weight of 0 at -1
    last = torch.arange(slots, device=below.device) == slots - 1
    ends = torch.where(last, wanted, ends)  # whatever rounding did
    counts = torch.zeros(runs, slots + 1, dtype=torch.long, device=ends.device).scatter_add(1, ends, torch.ones_like(ends))
    return counts.cumsum(1)[:, :slots].clamp(max=slots - 1)
