"""Chaotic sequences for particle swarms: the logistic map, and particles that start from it.

z' = 4 z (1 - z) [Tian et al., eq. 31]. Its invariant law is the arcsine law on (0, 1), of mean 1/2 and variance 1/8. Each
coordinate of each particle has a sequence of its own, since successive values are functions of each other. Always float64: in
single precision 1 sequence in 100 is stuck at 0 after 100 iterations and 1 in 5 after 3000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.derived_draws import Derived
from pfbench.model.base import StateSpaceModel

_QUARTERS = 4  # 0, 1/4, 1/2, 3/4 and 1 end at a fixed point
_MARGIN = 1e-3
_STUCK = 1e-12  # from 1, which goes to 0, and the fixed points 0 and 3/4: rounding can reach them
_SETTLED = 50  # iterations from a uniform seed to the invariant law; the differences halve in each


def seeds(u: Tensor) -> Tensor:
    """Uniforms on (0, 1) to uniforms at least 1e-3 away from 0, 1/4, 1/2, 3/4 and 1, where sequences die."""
    part = torch.floor(_QUARTERS * u.double()).clamp(max=_QUARTERS - 1)
    return part / _QUARTERS + _MARGIN + (u - part / _QUARTERS) * (1.0 - 2.0 * _QUARTERS * _MARGIN)


def logistic(z: Tensor, spare: Tensor) -> Tensor:
    """The next values; a sequence that has reached a fixed point goes on from its spare seed."""
    z = 4.0 * z * (1.0 - z)
    stuck = (z < _STUCK) | (z > 1.0 - _STUCK) | ((z - 0.75).abs() < _STUCK)
    return torch.where(stuck, spare, z)


def settled(u: Tensor) -> Tensor:
    """Uniforms on (0, 1) to values of sequences that have forgotten how they began."""
    first = seeds(u)
    z = first
    for _ in range(_SETTLED):
        z = logistic(z, first)
    return z


def uniform(z: Tensor) -> Tensor:
    """The distribution function of the arcsine law, (2 / pi) asin sqrt z: chaotic values to uniform ones."""
    return 2.0 / torch.pi * torch.asin(torch.sqrt(z))


class Start(Protocol):
    """The draws of the initial law and chaotic values z [R, N, d] -> the particles that the filter starts from [R, N, D]."""

    @property
    def exact(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, cloud: Cloud, z: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Prior:
    """The draws of the initial law themselves."""

    exact = True

    def __call__(self, model: StateSpaceModel, cloud: Cloud, z: Tensor) -> Tensor:
        return cloud.x


@dataclass(frozen=True)
class Interval:
    """a + (b - a) z, [a, b] being the least and greatest draw of each coordinate [Tian et al., eq. 39].

    Not the initial law: of 100 normal draws the interval is 5 sigma wide, and the particles spread 1.76 sigma, uncorrelated,
    most of them near its ends.
    """

    exact = False

    def __call__(self, model: StateSpaceModel, cloud: Cloud, z: Tensor) -> Tensor:
        mean = moments(model.chart, cloud)[0].unsqueeze(1)
        d = model.chart.subtract(cloud.x, mean)
        live = torch.isfinite(cloud.log_w).unsqueeze(-1)
        a = torch.where(live, d, torch.inf).amin(1, keepdim=True)
        b = torch.where(live, d, -torch.inf).amax(1, keepdim=True)
        return model.chart.add(mean, a + (b - a) * z.to(d.dtype))


@dataclass(frozen=True)
class Perturbation:
    """Dx = reach (2 z - 1), z being the particle's chaotic values, kept where it improves [Tian et al., eqs. 40 and 42].

    Args:
        beta: reach as a fraction of a coordinate's range, six of its scales; the paper does not give it [ours].

    Raises:
        ValueError: a beta that is not positive.
    """

    beta: float = 0.05

    def __post_init__(self) -> None:
        if not self.beta > 0.0:
            raise ValueError(f"perturbation.beta={self.beta}: give a positive fraction of a range, or perturbation=null")

    def __call__(self, z: Tensor, scale: Tensor) -> Tensor:
        """z [R, N, k], scale [R, 1, k] -> Dx [R, N, k]."""
        return 6.0 * self.beta * scale * (2.0 * z.to(scale.dtype) - 1.0)


@dataclass(frozen=True)
class Chaotic:
    """Points for the initial law: its quantiles at chaotic values that have been made uniform. The same law, exactly [ours]."""

    def __call__(self, draws: Draws, first: int = 0) -> Draws:
        return Derived(draws, lambda d, p, n, w: uniform(settled(d.uniform(p, n, w))))
