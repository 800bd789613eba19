"""Regularised resampling: copies plus a step of a smoothing kernel."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.particle.resampling import EssResampler
from pfbench.model.base import StateSpaceModel


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
