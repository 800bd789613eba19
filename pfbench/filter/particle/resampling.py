"""Resampling by copies: schemes that draw the ancestors, and the weights of their copies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, exponentiate, gather_ancestors
from pfbench.filter.exactness import is_every_part_exact
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable
from pfbench.model.base import StateSpaceModel

# --------------------------------------------------------------------------------------------------
# Resampling by copies: choice of ancestors, and the weights of their copies.
#
# A resampler returns particles, not indices, because some (regularised, aggregating) do not copy.


class ResamplingScheme(Protocol):
    """Resampling scheme: the distribution of the ancestors, given their probabilities."""

    @property
    def is_exact(self) -> bool:
        """True if every particle gets n a copies on average."""

    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        """Draw ancestors.

        Args:
            a: Probabilities, [R, N].
            n: Number of particles to draw, [R, 1]. Later slots are ignored.
            draws: Random stream of the step.

        Returns:
            Slot that each new particle copies, [R, N].
        """


class Resampler(Protocol):
    """Stage that replaces particles by others of the same target."""

    @property
    def is_exact(self) -> bool:
        """True if resampling does not change the target of the particles as N grows."""

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        """Resample particles.

        Args:
            model: State-space model of the step.
            belief: Weighted particles.
            log_a: Log resampling probabilities, [R, N]. The same object as the log weights of the
                belief if the probabilities are the weights.
            n: Number of new particles, [R, 1].
            draws: Random stream of the step.

        Returns:
            New particles and a mask of the resampled runs, [R].
        """


@dataclass(frozen=True)
class EssResampler(Resampler):
    """Resample the runs with a small effective sample size.

    Attributes:
        scheme: Resampling scheme.
        ess_threshold: Resample if ESS < threshold n. 1 resamples at every step, 0 never.

    Raises:
        ValueError: If the threshold is outside [0, 1].
    """

    scheme: ResamplingScheme
    ess_threshold: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.ess_threshold <= 1.0:
            raise ValueError(
                "resampler.ess_threshold must be from 0 (never) to 1 (at every step), got "
                f"{self.ess_threshold}. Choose a ratio of ESS to N."
            )

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.scheme": self.scheme})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        a = exponentiate(log_a, belief.weights)
        resampled_mask = torch.ones_like(belief.log_evidence, dtype=torch.bool)
        ancestors = self.scheme(a, n, draws)
        slots = torch.arange(a.shape[1], device=a.device)
        if self.ess_threshold < 1.0:
            resampled_mask = 1.0 / a.square().sum(-1) < self.ess_threshold * n.squeeze(1)
            ancestors = torch.where(resampled_mask.unsqueeze(1), ancestors, slots)
        log_w = -torch.log(n.to(a.dtype))
        if log_a is not belief.log_w:  # other probabilities than the weights: correct for them
            log_w = log_w + (belief.log_w - log_a).gather(1, ancestors)
        log_w = torch.where(slots < n, log_w, -torch.inf)
        if self.ess_threshold < 1.0:
            log_w = torch.where(resampled_mask.unsqueeze(1), log_w, belief.log_w)
        return gather_ancestors(belief, ancestors, log_w), resampled_mask


# --------------------------------------------------------------------------------------------------
# Resampling schemes: ancestors drawn by probabilities.
#
# Every scheme gives a particle n a copies on average for probabilities a. All are batched and use
# counting or sorted search. Probabilities are cut to multiples of 2^-52, whose sums are exact in double
# precision. Cumulative sums are therefore the same in any order of summation, so that all engines and
# devices choose the same ancestors by the same probabilities.

_GRID = 2.0**52  # multiples of its inverse are summed without rounding, up to a sum of 2


@dataclass(frozen=True)
class Systematic(ResamplingScheme):
    """One uniform u for all slots, at positions (j + u) / n.

    Counts differ from n a by less than 1.
    """

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        return _systematic(a, n, draws.uniform("resample", 1, 1).squeeze(1))


def _eager_systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Return ancestors [R, N] by the positions (j + u) / n of slots j, u [R, 1]."""
    sums, count = _exact_sums(a), n.double()
    total = sums[:, -1:]
    ends = torch.minimum(torch.ceil(sums * (count / total) - u.double()), count)
    # where, since the last sum may round below n, which gives the last slot to a weight of 0
    return _ancestors(torch.where(sums < total, ends, count).long(), n)


_systematic = compilable(_eager_systematic, operator=dispatch.resample_systematic)


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
        return _ancestors(last_slot + is_below_sum, n)


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
        expected = _expected_copies(a, n)
        # 49 (1/49) < 1: without this tolerance all copies of equal weights would be random
        certain = torch.floor(expected * (1.0 + 4.0 * torch.finfo(a.dtype).eps))
        missing = n - certain.sum(1, keepdim=True).long()
        residual = (expected - certain).clamp(min=0.0)
        residual = residual / residual.sum(1, keepdim=True).clamp(min=torch.finfo(a.dtype).tiny)
        index = _invert(_cumulative(residual), draws.uniform("resample", a.shape[1], 1).squeeze(2))
        slots = torch.arange(a.shape[1], device=a.device)
        counts = certain.long().scatter_add(1, index, (slots < missing).long())
        return _ancestors(counts.cumsum(1), n)


@dataclass(frozen=True)
class Ssp(ResamplingScheme):
    """Srinivasan's sampling process, with counts floor(n a) or one more.

    The counts are negatively associated. Pairs of fractional parts are resolved in a tournament of
    log2 N batched rounds. The order of the pairs is free [Srinivasan 2001].

    References:
        Gerber, Chopin, Whiteley 2019.
    """

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        expected = _expected_copies(a, n)
        counts = torch.floor(expected)
        width = 1 << max(1, (a.shape[1] - 1).bit_length())
        pad = width - a.shape[1]
        p = torch.nn.functional.pad(expected - counts, (0, pad))
        holder = torch.arange(width, device=a.device).expand(a.shape[0], -1)
        u = draws.uniform("resample", width, 1).squeeze(2)
        extra = torch.zeros_like(p)
        offset = 0
        while p.shape[1] > 1:
            first, second = p[:, 0::2], p[:, 1::2]
            pair_u = u[:, offset : offset + first.shape[1]]
            offset += first.shape[1]
            p, final, is_first = _resolve_pairs(first, second, pair_u)
            resolved = torch.where(is_first, holder[:, 0::2], holder[:, 1::2])
            holder = torch.where(is_first, holder[:, 1::2], holder[:, 0::2])
            extra = extra.scatter_add(1, resolved, final)
        extra = extra.scatter_add(1, holder, p.round())  # the fractions sum to an integer
        counts = (counts + extra[:, : a.shape[1]]).long()
        return _ancestors(counts.cumsum(1), n)


@dataclass(frozen=True)
class Killing(ResamplingScheme):
    """Survival of a particle with probability a / max a, otherwise a multinomial draw.

    A surviving particle stays in its slot, so the number of particles must be constant.

    References:
        Del Moral 2004.
    """

    is_exact = True

    @override
    def __call__(self, a: Tensor, n: Tensor, draws: RandomStream) -> Tensor:
        u = draws.uniform("resample", a.shape[1], 2)
        survivors = u[..., 0] * a.max(1, keepdim=True).values < a
        slots = torch.arange(a.shape[1], device=a.device).expand_as(survivors)
        return torch.where(survivors, slots, _invert(_cumulative(a), u[..., 1]))


def _resolve_pairs(first: Tensor, second: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return remaining fraction, count of the final member, mask where it is first."""
    total = first + second
    is_over = total >= 1.0
    # total below 1: the final member gets 0, and the other one keeps the total
    # otherwise: the final member gets 1, and the other one keeps the total minus 1
    probability = torch.where(
        is_over, (1.0 - second) / (2.0 - total).clamp(min=1e-300), second / total.clamp(min=1e-300)
    )
    return total - is_over.to(total.dtype), is_over.to(total.dtype), u < probability


def _expected_copies(a: Tensor, n: Tensor) -> Tensor:
    """Return expected copies [R, N], in float64.

    In float32 the weights of 1e6 particles sum to 1 within 5 slots.
    """
    return a.double() * (n / a.sum(1, keepdim=True, dtype=torch.float64))


def _exact_sums(a: Tensor) -> Tensor:
    """Return cumulative sums [R, N] in units of 2^-52, float64. They do not depend on their order."""
    return torch.trunc(a.double() * _GRID).cumsum(1)


def _cumulative(a: Tensor) -> Tensor:
    """Return cumulative sums [R, N] whose last value is exactly 1, float64."""
    sums = _exact_sums(a)
    return sums / sums[:, -1:]


def _invert(cumulative: Tensor, u: Tensor) -> Tensor:
    """Draw indices [R, M] by inversion of cumulative sums [R, N] at u [R, M]."""
    return torch.searchsorted(cumulative, u.to(cumulative.dtype).contiguous()).clamp(
        max=cumulative.shape[1] - 1
    )


def _ancestors(below: Tensor, n: Tensor) -> Tensor:
    """Return ancestors [R, N], non-decreasing, from cumulative counts, int64 [R, N]."""
    # slot j belongs to the first particle that ends after it: count particles by their end, and sum
    (runs, slots), total = below.shape, n.long()
    # in float32 the largest uniform is 1 and ends a weight of 0 at -1
    ends = torch.minimum(below, total).clamp(min=0)
    last = torch.arange(slots, device=below.device) == slots - 1
    ends = torch.where(last, total, ends)  # exact in spite of rounding
    counts = torch.zeros(runs, slots + 1, dtype=torch.long, device=ends.device).scatter_add(
        1, ends, torch.ones_like(ends)
    )
    return counts.cumsum(1)[:, :slots].clamp(max=slots - 1)
