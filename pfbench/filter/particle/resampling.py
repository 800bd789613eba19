"""Resampling: choice of ancestors, and the weights of their copies.

A resampler returns particles, not indices, because some (regularised, aggregating) do not copy. Every
scheme gives a particle n a copies on average for probabilities a. All are batched and use counting or
sorted search. Indices stay in range: cumulative sums are float64 from N = 1e5, and their last value is
set to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, gather_ancestors, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable
from pfbench.model.base import StateSpaceModel

_DOUBLE_FROM = (
    100_000  # particles; float32 then gets one ancestor in 500 wrong, and the evidence drifts
)


class ResamplingScheme(Protocol):
    """Draw ancestors [R, N] by probabilities a [R, N]. Slots from n [R, 1] on are ignored."""

    @property
    def is_exact(self) -> bool:
        """Whether every particle gets n a copies on average."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor: ...


class Resampler(Protocol):
    """Resample n [R, 1] particles by log probabilities log_a [R, N].

    It returns the new belief and a mask of the resampled runs, [R].
    """

    @property
    def is_exact(self) -> bool:
        """Whether the weighted particles keep their target as N grows."""

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]: ...


@dataclass(frozen=True)
class EssResampler:
    """Resample the runs with a small effective sample size.

    Attributes:
        scheme: How ancestors are drawn.
        ess_threshold: Resample if ESS < threshold n. 1 resamples always, 0 never.

    Raises:
        ValueError: If the threshold is outside [0, 1].
    """

    scheme: ResamplingScheme
    ess_threshold: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.ess_threshold <= 1.0:
            raise ValueError(
                f"resampler.ess_threshold must be from 0 (never) to 1 (always), got {self.ess_threshold}. "
                "Choose a ratio of ESS to N"
            )

    @property
    def is_exact(self) -> bool:
        """Whether the scheme is unbiased."""
        return is_every_part_exact(**{"resampler.scheme": self.scheme})

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        a = torch.exp(log_a)
        hit = torch.ones_like(belief.log_evidence, dtype=torch.bool)
        if self.ess_threshold < 1.0:
            hit = 1.0 / a.square().sum(-1) < self.ess_threshold * n.squeeze(1)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.ess_threshold < 1.0:
            ancestors = torch.where(hit.unsqueeze(1), ancestors, slots)
        fresh = gather_ancestors(belief, ancestors)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not belief.log_w:  # other probabilities than the weights: correct for them
            log_w = log_w + (belief.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        return fresh._replace(
            log_w=log_w
            if self.ess_threshold == 1.0
            else torch.where(hit.unsqueeze(1), log_w, belief.log_w)
        ), hit


class SmoothingKernel(Protocol):
    """Symmetric density K(e) of d whitened coordinates, for smoothed particles x + h A e."""

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        """Return the optimal h [R, 1] for n normal particles in d dimensions."""

    def variance(self, d: int) -> float:
        """Return the variance of each coordinate of e."""

    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        """Draw e, [R, n, d]."""


@dataclass(frozen=True)
class GaussianSmoothing:
    """K = N(0, I), h = (4/(d+2))^(1/(d+4)) N^(-1/(d+4)).

    References:
        Silverman 1986. Musso, Oudjane, Le Gland 2001.
    """

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        """Return the optimal h [R, 1]."""
        return (4.0 / (d + 2)) ** (1.0 / (d + 4)) * n ** (-1.0 / (d + 4))

    def variance(self, d: int) -> float:
        """Return the variance of each coordinate."""
        return 1.0

    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        """Draw e, [R, n, d]."""
        return draws.normal(purpose, n, d)


@dataclass(frozen=True)
class EpanechnikovSmoothing:
    """K = (d+2)/(2 c) (1 - |e|^2) on the unit ball of volume c: minimal mean integrated squared error.

    h = (8 (d+4) (2 sqrt(pi))^d / (c N))^(1/(d+4)) [Musso, Oudjane, Le Gland 2001].
    """

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        """Return the optimal h [R, 1]."""
        log_volume = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0)
        log_top = math.log(8.0 * (d + 4)) + d * math.log(2.0 * math.sqrt(math.pi)) - log_volume
        return math.exp(log_top / (d + 4)) * n ** (-1.0 / (d + 4))

    def variance(self, d: int) -> float:
        """Return the variance of each coordinate."""
        return 1.0 / (d + 4)

    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        """Draw a uniform direction and a squared length of Beta(d/2, 2), by powers of two uniforms."""
        e = draws.normal(purpose, n, d)
        u = draws.uniform(f"{purpose}.length", n, 2).to(e.dtype)
        return (
            e
            / e.norm(dim=-1, keepdim=True)
            * (u[..., :1] ** (1.0 / d) * u[..., 1:] ** (1.0 / (d + 2)))
        )


@dataclass(frozen=True)
class RegularisedResampler:
    """Resample from a kernel density estimate: copies by `resampler`, plus h A e in the chart.

    A A' is the covariance of the weighted particles before resampling. h is the kernel's optimal
    bandwidth times `scale`.

    Attributes:
        resampler: Resampler that copies.
        scale: Factor on the optimal bandwidth. Use 1/2 for several modes.
        shrink_to_mean: Pull particles to the mean first, which keeps the covariance [West 1993; Liu and West
            2001]. Without it each resampling multiplies the covariance by 1 + h^2 times the
            variance of the kernel.
        kernel: Distribution of e.

    Raises:
        ValueError: If the scale is not positive.

    References:
        Musso, Oudjane, Le Gland 2001. Yan et al. 2016, eqs. 7-9 (eq. 9 prints n - 2 for n + 2 and
        loses a sign).
    """

    resampler: EssResampler
    scale: float = 1.0
    shrink_to_mean: bool = False
    kernel: SmoothingKernel = field(default_factory=GaussianSmoothing)
    is_exact = False

    def __post_init__(self) -> None:
        if not self.scale > 0.0:
            raise ValueError(
                f"resampler.scale must be positive, got {self.scale}. Choose a factor on the optimal bandwidth"
            )

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        mean, covariance = weighted_mean_cov(model.chart, belief)
        fresh, hit = self.resampler(model, belief, log_a, n, draws)
        d = covariance.shape[-1]
        h = self.scale * self.kernel.bandwidth(d, n.to(covariance.dtype))  # [R, 1]
        e = self.kernel.draw(draws, "regularise", fresh.x.shape[1], d)
        step = h.unsqueeze(-1) * (e @ factor(covariance)[0].mT)
        centre = mean.unsqueeze(1)
        if self.shrink_to_mean:
            shrinkage = torch.sqrt(1.0 - (self.kernel.variance(d) * h * h).clamp(max=1.0))
            x = model.chart.add(
                centre, shrinkage.unsqueeze(-1) * model.chart.subtract(fresh.x, centre) + step
            )
        else:
            x = model.chart.add(fresh.x, step)
        return fresh._replace(x=torch.where(hit[:, None, None], x, fresh.x)), hit


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
