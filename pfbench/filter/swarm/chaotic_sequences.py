"""Chaotic sequences for particle swarms: the logistic map and initial particles.

z' = 4 z (1 - z) [Tian et al., eq. 31]. The invariant distribution is the arcsine distribution
on (0, 1), with mean 1/2 and variance 1/8. Each coordinate of each particle has its own
sequence, since successive values depend on each other. Always float64: in single precision 1
sequence in 100 stays at 0 after 100 iterations, and 1 in 5 after 3000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.derived_stream import DerivedStream
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.particle.point_sets import PointSet
from pfbench.model.base import StateSpaceModel

_QUARTERS = 4  # 0, 1/4, 1/2, 3/4 and 1 lead to a fixed point
_SEED_MARGIN = 1e-3
_STUCK = 1e-12  # distance from 0, 3/4 and 1, which rounding can reach
_BURN_IN = 50  # iterations to the invariant distribution, each halves the difference


def safe_seeds(u: Tensor) -> Tensor:
    """Map uniforms on (0, 1) to uniforms at least 1e-3 from 0, 1/4, 1/2, 3/4 and 1."""
    start = torch.floor(_QUARTERS * u.double()).clamp(max=_QUARTERS - 1) / _QUARTERS
    return start + _SEED_MARGIN + (u - start) * (1.0 - 2.0 * _QUARTERS * _SEED_MARGIN)


def logistic_map(z: Tensor, spare: Tensor) -> Tensor:
    """Compute the next values, and restart sequences at a fixed point.

    Args:
        z: Values, [R, N, k].
        spare: Seeds of restarted sequences, [R, N, k].

    Returns:
        Next values, [R, N, k].
    """
    z = 4.0 * z * (1.0 - z)
    stuck = (z < _STUCK) | (z > 1.0 - _STUCK) | ((z - 0.75).abs() < _STUCK)
    return torch.where(stuck, spare, z)


def iterate_logistic(u: Tensor) -> Tensor:
    """Map uniforms on (0, 1) to chaotic values after the burn-in."""
    first = safe_seeds(u)
    z = first
    for _ in range(_BURN_IN):
        z = logistic_map(z, first)
    return z


def arcsine_cdf(z: Tensor) -> Tensor:
    """Map chaotic values to uniform ones by the arcsine cdf (2 / pi) asin sqrt z."""
    return 2.0 / torch.pi * torch.asin(torch.sqrt(z))


class SwarmStart(Protocol):
    """Start of a swarm: its particles before the first step."""

    @property
    def is_exact(self) -> bool:
        """True if the particles have the initial distribution."""

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        """Return the particles of the first step.

        Args:
            model: State-space model.
            belief: Initial particles.
            z: Chaotic values, [R, N, d].

        Returns:
            Particles, [R, N, D].
        """


@dataclass(frozen=True)
class PriorStart(SwarmStart):
    """Initial particles without change."""

    is_exact = True

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        return belief.x


@dataclass(frozen=True)
class IntervalStart(SwarmStart):
    """a + (b - a) z, [a, b] the range of the initial particles [Tian et al., eq. 39].

    Not the initial distribution: for 100 normal draws the interval is 5 sigma wide. The particles
    have a standard deviation of 1.76 sigma, are uncorrelated, and most are close to its ends.
    """

    is_exact = False

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, z: Tensor) -> Tensor:
        mean = weighted_mean_cov(model.chart, belief)[0].unsqueeze(1)
        d = model.chart.subtract(belief.x, mean)
        active_mask = torch.isfinite(belief.log_w).unsqueeze(-1)
        a = torch.where(active_mask, d, torch.inf).amin(1, keepdim=True)
        b = torch.where(active_mask, d, -torch.inf).amax(1, keepdim=True)
        return model.chart.add(mean, a + (b - a) * z.to(d.dtype))


@dataclass(frozen=True)
class ChaoticPerturbation:
    """Dx = reach (2 z - 1), applied if fitter [Tian et al., eqs. 40 and 42].

    Attributes:
        beta: Reach as a fraction of a coordinate's range, which is six scales. Not specified in
            the paper [ours].

    Raises:
        ValueError: If beta is not positive.
    """

    beta: float = 0.05

    def __post_init__(self) -> None:
        if not self.beta > 0.0:
            raise ValueError(
                f"proposal.perturbation.beta must be positive, got {self.beta}. "
                "Use perturbation=null for no perturbation."
            )

    def __call__(self, z: Tensor, scale: Tensor) -> Tensor:
        """Compute a perturbation.

        Args:
            z: Chaotic values, [R, N, k].
            scale: Scale of each coordinate, [R, 1, k].

        Returns:
            Perturbation Dx, [R, N, k].
        """
        return 6.0 * self.beta * scale * (2.0 * z.to(scale.dtype) - 1.0)


@dataclass(frozen=True)
class ChaoticPoints(PointSet):
    """Point set for the initial distribution from chaotic values made uniform [ours].

    The distribution is exactly the initial one.
    """

    is_exact = True

    @override
    def __call__(self, draws: RandomStream, first: int = 0) -> RandomStream:
        return DerivedStream(
            draws, lambda d, p, n, w: arcsine_cdf(iterate_logistic(d.uniform(p, n, w)))
        )
