"""Resampling that moves the copies: smoothing kernels, and the Thompson-Taylor generator."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import pad
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, normalise_log_weights, weighted_mean_cov
from pfbench.filter.particle.stages import EssResampler, Resampler
from pfbench.filter.whitening import whiten
from pfbench.model.base import StateSpaceModel


class SmoothingKernel(Protocol):
    """Symmetric density K(e) of d whitened coordinates, for particles x + h A e."""

    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        """Return the optimal bandwidth h for a normal distribution.

        Args:
            d: Number of dimensions.
            n: Number of particles, [R, 1].

        Returns:
            Bandwidth h, [R, 1].
        """

    def variance(self, d: int) -> float:
        """Return the variance of each coordinate of e in d dimensions."""

    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        """Draw from the kernel.

        Args:
            draws: Random stream.
            purpose: Label of the numbers.
            n: Number of particles.
            d: Number of dimensions.

        Returns:
            Samples e, [R, n, d].
        """


@dataclass(frozen=True)
class GaussianSmoothing(SmoothingKernel):
    """K = N(0, I), h = (4/(d+2))^(1/(d+4)) N^(-1/(d+4)).

    Attributes:
        offset: Number added to d in the base. 2 as derived, -2 as printed in [Yan et al. 2016,
            eq. 9], where the base is infinite for two dimensions and negative for one.
        dimension: d that a paper states in place of the number of coordinates, None for these.

    Raises:
        ValueError: On use, if d + offset is not positive.

    References:
        Silverman 1986. Musso, Oudjane, Le Gland 2001.
    """

    offset: int = 2
    dimension: int | None = None

    @override
    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        d = d if self.dimension is None else self.dimension
        require(
            d + self.offset > 0,
            "kernel.offset",
            f"exceed -{d} with {d} dimensions",
            f"{self.offset}: the bandwidth does not exist",
            "Use 2, as derived.",
        )
        return (4.0 / (d + self.offset)) ** (1.0 / (d + 4)) * n ** (-1.0 / (d + 4))

    @override
    def variance(self, d: int) -> float:
        return 1.0

    @override
    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        return draws.normal(purpose, n, d)


@dataclass(frozen=True)
class EpanechnikovSmoothing(SmoothingKernel):
    """K = (d+2)/(2 c) (1 - |e|^2) on the unit ball of volume c.

    This kernel has the smallest mean integrated squared error. The optimal bandwidth is
    h = (8 (d+4) (2 sqrt(pi))^d / (c N))^(1/(d+4)) [Musso, Oudjane, Le Gland 2001].
    """

    @override
    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        log_volume = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0)
        log_factor = math.log(8.0 * (d + 4)) + d * math.log(2.0 * math.sqrt(math.pi)) - log_volume
        return math.exp(log_factor / (d + 4)) * n ** (-1.0 / (d + 4))

    @override
    def variance(self, d: int) -> float:
        return 1.0 / (d + 4)

    @override
    def draw(self, draws: RandomStream, purpose: str, n: int, d: int) -> Tensor:
        # a uniform direction, and a squared length of Beta(d/2, 2) by powers of two uniforms
        e = draws.normal(purpose, n, d)
        u = draws.uniform(f"{purpose}.length", n, 2).to(e.dtype)
        length = u[..., :1] ** (1.0 / d) * u[..., 1:] ** (1.0 / (d + 2))
        return e / e.norm(dim=-1, keepdim=True) * length


@dataclass(frozen=True)
class RegularisedResampler(Resampler):
    """Resampling from a kernel density estimate.

    The new particles are copies by `resampler` plus h A e in the chart. A A' is the covariance of
    the weighted particles before resampling. h is the kernel's optimal bandwidth times `scale`.

    Attributes:
        resampler: Resampler that copies.
        scale: Factor on the optimal bandwidth. Use 1/2 for several modes.
        shrink_to_mean: Shrink particles towards the mean first, which preserves the covariance
            [West 1993; Liu and West 2001]. Without it each resampling multiplies the covariance by
            1 + h^2 times the variance of the kernel. Copies by equal probabilities, as before the first
            measurement, stay as they are.
        kernel: Distribution of e.
        is_unbiased: Divide the covariance by 1 - sum w^2, and take that of equal weights where one particle has all
            the weight. Without it few particles of uneven weights are smoothed too little.
        moves_unique: Also move particles that were copied once. If False, copies alone are moved.

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
    is_unbiased: bool = False
    moves_unique: bool = True
    is_exact = False

    def __post_init__(self) -> None:
        require_ranges(
            "resampler", self, scale="(0, inf] Choose a factor on the optimal bandwidth."
        )

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        if self.is_unbiased:
            mean, covariance = _unbiased_mean_cov(model.chart, belief)
        else:
            mean, covariance = weighted_mean_cov(model.chart, belief)
        copies, resampled_mask = self.resampler(model, belief, log_a, n, draws)
        d = covariance.shape[-1]
        h = self.scale * self.kernel.bandwidth(d, n.to(covariance.dtype))  # [R, 1]
        e = self.kernel.draw(draws, "regularise", copies.x.shape[1], d)
        step = h.unsqueeze(-1) * (e @ factor(covariance)[0].mT)
        if not self.moves_unique:  # copies are neighbours: resampling keeps the order
            is_equal = (copies.x[:, 1:] == copies.x[:, :-1]).all(-1, keepdim=True)
            step = step * (pad(is_equal, (0, 0, 1, 0)) | pad(is_equal, (0, 0, 0, 1)))
        centre = mean.unsqueeze(1)
        if self.shrink_to_mean:
            shrinkage = torch.sqrt(1.0 - (self.kernel.variance(d) * h * h).clamp(max=1.0))
            deviations = model.chart.subtract(copies.x, centre)
            x = model.chart.add(centre, shrinkage.unsqueeze(-1) * deviations + step)
        else:
            x = model.chart.add(copies.x, step)
        return _move_where_uneven(copies, x, log_a, resampled_mask), resampled_mask


_LONE = 1e-10  # weight of all other particles below this: equal weights


def _unbiased_mean_cov(chart: Chart, belief: ParticleBelief) -> tuple[Tensor, Tensor]:
    """Return the weighted mean [R, D] and the unbiased covariance [R, d, d], of equal weights for a lone particle."""
    w = normalise_log_weights(belief.log_w)
    is_lone = w.amax(1, keepdim=True) > 1.0 - _LONE
    is_flat = is_lone & (belief.log_w > -torch.inf)  # inactive slots stay so
    spread = belief._replace(log_w=torch.where(is_flat, 0.0, belief.log_w))
    mean, covariance = weighted_mean_cov(chart, spread)
    w = normalise_log_weights(spread.log_w)
    return mean, covariance / (1.0 - w.square().sum(1)).clamp(min=_LONE)[:, None, None]


def _move_where_uneven(
    copies: ParticleBelief, x: Tensor, log_a: Tensor, resampled_mask: Tensor
) -> ParticleBelief:
    """Move the copies to x [R, N, D] in resampled runs whose probabilities are not all equal.

    Equal ones, as of the prior and after a step without measurement, weigh nothing: a smoothed cloud would no
    longer be that of the prediction.
    """
    uneven = ((log_a > -torch.inf) & (log_a < log_a.amax(1, keepdim=True))).any(1)
    return copies._replace(x=torch.where((resampled_mask & uneven)[:, None, None], x, copies.x))


# --------------------------------------------------------------------------------------------------
# Thompson-Taylor generator: particles combine nearest neighbours at random.

_PAIRS = 20_000_000  # distances that are computed at a time


@dataclass(frozen=True)
class ThompsonTaylorResampler(Resampler):
    """Random combinations of the neighbours of resampled particles.

    z = xbar + sum_l u_l (x_l - xbar) over the m nearest neighbours x_l of each copy. The neighbours
    include the copy, xbar is their mean, and u_l is uniform with mean 1/m and variance (m - 1)/m^2
    [Taylor and Thompson 1986]. The covariance within a neighbourhood is multiplied by (m - 1)/m, so
    mean and covariance of the sample hardly change for any shape. Distances are Euclidean in
    whitened coordinates [ours]. Copies of one particle are neighbours of each other, so m copies
    stay equal, as in the published algorithm.

    Attributes:
        resampler: Resampler that copies, to equal weights.
        neighbours: Number of neighbours m.
        as_printed: Use a single random neighbour, z = xbar + u_k (x_k - xbar), as printed. The sum
            is missing there, and the covariance within a neighbourhood shrinks to 1/m.

    Raises:
        ValueError: If there are fewer than two neighbours, or, on use, more than particles.

    References:
        Pu and Qin, "Application of quasi Monte Carlo polymerization re-sampling particle filter
        algorithm in airborne passive location", eq. 12.
    """

    resampler: EssResampler
    neighbours: int = 20
    as_printed: bool = False
    is_exact = False

    def __post_init__(self) -> None:
        require_ranges("resampler", self, neighbours="[2, inf] Count the particle itself as one.")

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        slots, m = belief.x.shape[1], self.neighbours
        require(
            not m > slots,
            "resampler.neighbours",
            f"be at most {slots} (the particles)",
            m,
            "Choose fewer.",
        )
        mean, covariance = weighted_mean_cov(model.chart, belief)
        copies, resampled_mask = self.resampler(model, belief, log_a, n, draws)
        d = model.chart.subtract(copies.x, mean.unsqueeze(1))
        near = nearest_neighbours(whiten(d, factor(covariance)[0]), copies.log_w > -torch.inf, m)
        rows = d.gather(1, near.flatten(1).unsqueeze(-1).expand(-1, -1, d.shape[-1])).unflatten(
            1, (slots, m)
        )
        centre = rows.mean(2)
        combination = self._combine(rows - centre.unsqueeze(2), draws)
        x = model.chart.add(mean.unsqueeze(1), centre + combination)
        return _move_where_uneven(copies, x, log_a, resampled_mask), resampled_mask

    def _combine(self, r: Tensor, draws: RandomStream) -> Tensor:
        """Combine the deviations r [R, N, m, d] of neighbours from their mean, [R, N, d]."""
        m = self.neighbours
        half = math.sqrt(3.0 * (m - 1.0)) / m
        u = draws.uniform("neighbours", r.shape[1], m).to(r)
        u = 1.0 / m + half * (2.0 * u - 1.0)
        if not self.as_printed:
            return (u.unsqueeze(-2) @ r).squeeze(-2)
        index = (m * draws.uniform("neighbour", r.shape[1], 1)).long().clamp(max=m - 1)
        neighbour = r.gather(2, index.unsqueeze(-1).expand(-1, -1, 1, r.shape[-1])).squeeze(2)
        return u[..., :1] * neighbour


def nearest_neighbours(z: Tensor, active_mask: Tensor, m: int) -> Tensor:
    """Find the m nearest active points of each point, including itself.

    Returns indices in ascending order, [R, N, m]. Copies of a particle are equally near, and
    rounding decides between them; in this order that does not matter. Shapes: z [R, N, d],
    active_mask [R, N].
    """
    block = max(1, _PAIRS // max(1, z.shape[0] * z.shape[1]))
    penalty = torch.where(active_mask, 0.0, torch.inf).unsqueeze(1)
    indices = [
        (torch.cdist(points, z) + penalty).topk(m, largest=False, sorted=False).indices
        for points in z.split(block, 1)
    ]
    return torch.cat(indices, 1).sort(-1).values
