"""Regularised resampling: copies plus a step of a smoothing kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.particle.resampling import EssResampler, Resampler
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

    References:
        Silverman 1986. Musso, Oudjane, Le Gland 2001.
    """

    @override
    def bandwidth(self, d: int, n: Tensor) -> Tensor:
        return (4.0 / (d + 2)) ** (1.0 / (d + 4)) * n ** (-1.0 / (d + 4))

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
            1 + h^2 times the variance of the kernel.
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
                f"resampler.scale must be positive, got {self.scale}. "
                "Choose a factor on the optimal bandwidth."
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
        mean, covariance = weighted_mean_cov(model.chart, belief)
        copies, resampled_mask = self.resampler(model, belief, log_a, n, draws)
        d = covariance.shape[-1]
        h = self.scale * self.kernel.bandwidth(d, n.to(covariance.dtype))  # [R, 1]
        e = self.kernel.draw(draws, "regularise", copies.x.shape[1], d)
        step = h.unsqueeze(-1) * (e @ factor(covariance)[0].mT)
        centre = mean.unsqueeze(1)
        if self.shrink_to_mean:
            shrinkage = torch.sqrt(1.0 - (self.kernel.variance(d) * h * h).clamp(max=1.0))
            deviations = model.chart.subtract(copies.x, centre)
            x = model.chart.add(centre, shrinkage.unsqueeze(-1) * deviations + step)
        else:
            x = model.chart.add(copies.x, step)
        x = torch.where(resampled_mask[:, None, None], x, copies.x)
        return copies._replace(x=x), resampled_mask
