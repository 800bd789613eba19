"""How a Gaussian filter sees a map: through its Jacobian, or through points and weights. All rules answer one question.

For x = m + L xi, xi ~ (0, I), a rule finds the statistical linearisation f(x) = y + M xi + e, Cov e = Omega
[Lefebvre et al. 2002; Garcia-Fernandez et al. 2015]. The rest of the filter is then the same for all of them, and works on
square roots, since M is already multiplied by the Cholesky factor L.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad

Map: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""xi [R, P, d] -> mean [R, P, k] and covariance [R or 1, P or 1, k, k] of a law given each point."""


class Space(NamedTuple):
    """How values of a map differ, (y, y0) -> difference, and average, (y [R, P, k], w [R, P]) -> [R, k]."""

    subtract: Callable[[Tensor, Tensor], Tensor]
    mean: Callable[[Tensor, Tensor], Tensor]


class Linearised(NamedTuple):
    """y [R, k]; M [R, k, d] in whitened coordinates; Omega [R, k, k]: what M leaves, plus the law's own covariance."""

    y: Tensor
    m: Tensor
    omega: Tensor


class Rule(Protocol):
    """Linearises a map of d whitened coordinates, in the dtype and for the R runs of `like` [R, ...]."""

    def __call__(self, f: Map, like: Tensor, d: int, space: Space) -> Linearised: ...


@dataclass(frozen=True)
class Jacobian:
    """First-order Taylor expansion: the extended Kalman filter. Exact derivatives, all directions in one forward pass."""

    def __call__(self, f: Map, like: Tensor, d: int, space: Space) -> Linearised:
        y, covariance = f(like.new_zeros(like.shape[0], 1, d))
        centre = like.new_zeros(like.shape[0], d, d)  # the axis of points holds the directions
        directions = torch.eye(d, dtype=like.dtype, device=like.device).expand_as(centre).contiguous()
        with forward_ad.dual_level():  # torch.func.jvp costs three times as much, and seconds at the first call
            moved = space.subtract(f(forward_ad.make_dual(centre, directions))[0], y)
            value, slopes = forward_ad.unpack_dual(moved)
        if slopes is None:  # the map does not depend on the state
            slopes = torch.zeros_like(value)
        return Linearised(y[:, 0], slopes.mT, covariance[:, 0].expand(like.shape[0], -1, -1))


@dataclass(frozen=True)
class Points:
    """Points and weights: unscented and cubature filters.

    Args:
        scheme: d -> whitened points [P, d], mean weights [P], covariance weights [P], with sum w_c xi xi' = I.
    """

    scheme: Callable[[int], tuple[Tensor, Tensor, Tensor]]

    def __call__(self, f: Map, like: Tensor, d: int, space: Space) -> Linearised:
        xi, w_mean, w_cov = (a.to(like) for a in self.scheme(d))
        values, covariance = f(xi.expand(like.shape[0], -1, -1))
        y = space.mean(values, w_mean.expand(values.shape[:2]))
        r = space.subtract(values, y.unsqueeze(1))
        m = (w_cov[:, None] * r).mT @ xi
        left = r - xi @ m.mT
        own = (w_mean[:, None, None] * covariance).sum(1) if covariance.shape[1] > 1 else covariance[:, 0]
        return Linearised(y, m, (w_cov[:, None] * left).mT @ left + own)


@dataclass(frozen=True)
class Unscented:
    """The scaled unscented transform [Julier and Uhlmann 1997; van der Merwe 2004].

    Args:
        alpha, beta, kappa: spread, weight of the centre in covariances, secondary spread. The defaults [ours] put the points
            at sqrt(d), as cubature does, and count the centre twice in covariances; the customary alpha = 1e-3 makes a centre
            weight of -1e6, which loses half the digits.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        if not self.alpha > 0.0:
            raise ValueError(f"rule.scheme.alpha={self.alpha}: give a positive spread")

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        reach = self.alpha**2 * (d + self.kappa)
        if not reach > 0.0:
            raise ValueError(f"rule.scheme.kappa={self.kappa}: alpha^2 (d + kappa) must be positive, and d is {d} here")
        ball = math.sqrt(reach) * torch.eye(d, dtype=torch.float64)
        xi = torch.cat([torch.zeros(1, d, dtype=torch.float64), ball, -ball])
        w = torch.full((2 * d + 1,), 0.5 / reach, dtype=torch.float64)
        w[0] = 1.0 - d / reach
        w_cov = w.clone()
        w_cov[0] += 1.0 - self.alpha**2 + self.beta
        return xi, w, w_cov


@dataclass(frozen=True)
class Cubature:
    """The third-degree spherical-radial rule: 2 d points at sqrt(d) [Arasaratnam and Haykin 2009]."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        ball = math.sqrt(d) * torch.eye(d, dtype=torch.float64)
        w = torch.full((2 * d,), 0.5 / d, dtype=torch.float64)
        return torch.cat([ball, -ball]), w, w
