"""How a Gaussian filter sees a map: through its Jacobian, or through points and weights. All rules answer one question.

For x = m + L xi, xi ~ (0, I), a rule finds the statistical linearisation f(x) = y + M xi + e, Cov e = Omega
[Lefebvre et al. 2002; Garcia-Fernandez et al. 2015]. The rest of the filter is then the same for all of them, and works on
square roots, since M is already multiplied by the Cholesky factor L.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor

from pfbench import native
from pfbench.derivatives import slopes
from pfbench.fusion import fusible

Map: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""xi [R, P, d] -> mean [R, P, k] and covariance [R or 1, P or 1, k, k] of a law given each point."""


class Space(NamedTuple):
    """How values of a map differ, (y, y0) -> difference, and average, (y [R, P, k], w [R, P]) -> [R, k]."""

    subtract: Callable[[Tensor, Tensor], Tensor]
    mean: Callable[[Tensor, Tensor], Tensor]


class Linearised(NamedTuple):
    """y [R, k]; M [R, k, d] in whitened coordinates; Omega [R, k, k]: what M leaves, plus the law's own covariance `noise`."""

    y: Tensor
    m: Tensor
    omega: Tensor
    noise: Tensor


class Rule(Protocol):
    """Linearises a map of d whitened coordinates, in the dtype and for the R runs of `like` [R, ...]."""

    def __call__(self, f: Map, like: Tensor, d: int, space: Space) -> Linearised: ...


@dataclass(frozen=True)
class Jacobian:
    """First-order Taylor expansion: the extended Kalman filter. Exact derivatives, all of them in one pass."""

    def __call__(self, f: Map, like: Tensor, d: int, space: Space) -> Linearised:
        y, covariance = f(like.new_zeros(like.shape[0], 1, d))
        own = covariance[:, 0].expand(like.shape[0], -1, -1)
        return Linearised(y[:, 0], slopes(lambda xi: f(xi)[0], y, d, space.subtract), own, own)


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
        m, left = _fitted(r, xi, w_cov)
        own = (w_mean[:, None, None] * covariance).sum(1) if covariance.shape[1] > 1 else covariance[:, 0]
        return Linearised(y, m, left + own, own)


def _separate_fit(r: Tensor, xi: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """r [R, P, k] at points xi [P, d] of weights w [P]: slopes M [R, k, d], and the covariance of what they leave [R, k, k]."""
    m = r.mT @ (w[:, None] * xi)
    left = r - xi @ m.mT
    return m, (w[:, None] * left).mT @ left


_fitted = fusible(_separate_fit, by_hand=native.fitted, compiles=False)


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


class SphereRule(Protocol):
    """Mean over the unit sphere: d -> unit vectors [P, d] and weights [P] that sum to 1. Frozen, so that points are kept."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor]: ...


class RadialRule(Protocol):
    """Mean over |x|, x ~ N(0, I_d): d -> radii and their weights, which sum to 1. Odd powers come with the sphere."""

    def __call__(self, d: int) -> list[tuple[float, float]]: ...


@dataclass(frozen=True)
class Product:
    """Points r u and weights c a of a rule on the sphere and a rule along the radius; a radius of 0 gives one centre point.

    Of the degree that the poorer of its parts has [Arasaratnam and Haykin 2009, proposition 3.2]; what the richer one adds is
    right in one direction only: of a third-degree sphere and a fifth-degree radius, E|x|^4.

    | sphere, radius | filter | points |
    |---|---|---|
    | Axis3, Radial3 | CKF | 2 d |
    | Axis5, Radial5 | HCKF; a negative weight from d = 5 on | 2 d^2 + 1 |
    | Simplex3, Radial3 | SSRCKF | 2 d + 2 |
    | Simplex5, Radial5 | SSRHCKF; negative weights from d = 8 on | d^2 + 3 d + 3 |
    | Simplex3, Radial5 | MSSRCKF | 2 d + 3 |
    | Simplex5, Radial3 | the other mix; negative weights from d = 8 on | d^2 + 3 d + 2 |
    | Axis3, Radial5 | the UKF of kappa = 2 | 2 d + 1 |

    Where weights are negative a covariance may lose its square root: see GaussianFilter.repair.
    """

    sphere: SphereRule
    radial: RadialRule

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        return _product(self, d)


@lru_cache(maxsize=64)
def _product(rule: Product, d: int) -> tuple[Tensor, Tensor, Tensor]:
    u, a = rule.sphere(d)
    shells = rule.radial(d)
    xi = torch.cat([r * u if r > 0.0 else torch.zeros(1, d, dtype=torch.float64) for r, _ in shells])
    w = torch.cat([c * a if r > 0.0 else torch.full((1,), c, dtype=torch.float64) for r, c in shells])
    return xi, w, w


@dataclass(frozen=True)
class Radial3:
    """One shell: E|x|^2 = d [Arasaratnam and Haykin 2009]."""

    def __call__(self, d: int) -> list[tuple[float, float]]:
        return [(math.sqrt(d), 1.0)]


@dataclass(frozen=True)
class Radial5:
    """A shell and the centre: E|x|^4 = d (d + 2) as well [Jia, Xin and Cheng 2013]."""

    def __call__(self, d: int) -> list[tuple[float, float]]:
        return [(0.0, 2.0 / (d + 2)), (math.sqrt(d + 2), d / (d + 2))]


@dataclass(frozen=True)
class Axis3:
    """Both ends of each axis, 2 d points [Arasaratnam and Haykin 2009]."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        return _both_ways(torch.eye(d, dtype=torch.float64), 0.5 / d)


@dataclass(frozen=True)
class Axis5:
    """The axes, and the diagonals of each pair of them, 2 d^2 points [Jia, Xin and Cheng 2013]."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        axes = torch.eye(d, dtype=torch.float64)
        k, l = torch.triu_indices(d, d, 1)
        diagonals = torch.cat([axes[k] + axes[l], axes[k] - axes[l]]) / math.sqrt(2.0)
        return _joined(_both_ways(axes, (4 - d) / (2 * d * (d + 2))), _both_ways(diagonals, 1.0 / (d * (d + 2))))


@dataclass(frozen=True)
class Simplex3:
    """The d + 1 corners of a regular simplex and what lies opposite [Wang, Feng and Tseng 2014], 2 d + 2 points."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        return _both_ways(_simplex(d), 0.5 / (d + 1))


@dataclass(frozen=True)
class Simplex5:
    """The corners of a simplex and the middles of its edges, carried out to the sphere [Lu and Darmofal 2004]."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        corners = _simplex(d)
        ends = _both_ways(corners, d * (7 - d) / (2 * (d + 1) ** 2 * (d + 2)))
        if d == 1:  # two corners, no middle
            return ends
        k, l = torch.triu_indices(d + 1, d + 1, 1)
        middles = math.sqrt(d / (2 * (d - 1))) * (corners[k] + corners[l])
        return _joined(ends, _both_ways(middles, 2 * (d - 1) ** 2 / (d * (d + 1) ** 2 * (d + 2))))


def _both_ways(u: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    return torch.cat([u, -u]), torch.full((2 * len(u),), weight, dtype=torch.float64)


def _joined(*parts: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    return torch.cat([u for u, _ in parts]), torch.cat([a for _, a in parts])


def _simplex(d: int) -> Tensor:
    """Corners a_j of a regular simplex on the unit sphere [d + 1, d]: a_j . a_k = -1/d [Lu and Darmofal 2004]."""
    i = torch.arange(1, d + 1, dtype=torch.float64)
    j = torch.arange(1, d + 2, dtype=torch.float64)[:, None]
    below = -torch.sqrt((d + 1) / (d * (d - i + 2) * (d - i + 1)))
    at = torch.sqrt((d + 1) * (d - i + 1) / (d * (d - i + 2)))
    return torch.where(i < j, below, 0.0) + torch.where(i == j, at, 0.0)
