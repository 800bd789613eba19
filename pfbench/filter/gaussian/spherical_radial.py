"""Sigma points of spherical-radial cubature: products of a spherical and a radial rule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override


class SphericalRule(Protocol):
    """Mean over the unit sphere.

    Implementations are frozen, so that points can be cached.
    """

    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        """Return unit vectors [P, d] and weights [P] with sum 1."""


class RadialRule(Protocol):
    """Mean over |x|, x ~ N(0, I_d)."""

    def __call__(self, d: int) -> list[tuple[float, float]]:
        """Return pairs of radius and weight; the weights have sum 1."""


@dataclass(frozen=True)
class SphericalRadialPoints:
    """Points r u and weights c a from a spherical rule and a radial rule.

    A radius of 0 gives one centre point. The degree is the smaller degree of the two rules
    [Arasaratnam and Haykin 2009, proposition 3.2]. The higher degree of the other rule holds in
    one direction only: E|x|^4 for a third-degree sphere and a fifth-degree radius.

    | sphere, radius | filter | points |
    |---|---|---|
    | Axis3, Radial3 | CKF | 2 d |
    | Axis5, Radial5 | HCKF (a negative weight if d >= 5) | 2 d^2 + 1 |
    | Simplex3, Radial3 | SSRCKF | 2 d + 2 |
    | Simplex5, Radial5 | SSRHCKF (negative weights if d >= 8) | d^2 + 3 d + 3 |
    | Simplex3, Radial5 | MSSRCKF | 2 d + 3 |
    | Simplex5, Radial3 | SSR53 (negative weights if d >= 8) | d^2 + 3 d + 2 |
    | Axis3, Radial5 | MCKF, the UKF with kappa = 2 | 2 d + 1 |

    With negative weights a covariance may not be positive definite: see `GaussianFilter.repair_covariance`.

    Attributes:
        spherical_rule: Spherical rule.
        radial_rule: Radial rule.
    """

    spherical_rule: SphericalRule
    radial_rule: RadialRule

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], and their weights [P] for means and for covariances."""
        return _product(self, d)


@lru_cache(maxsize=64)
def _product(rule: SphericalRadialPoints, d: int) -> tuple[Tensor, Tensor, Tensor]:
    """Combine both rules into points and weights."""
    u, a = rule.spherical_rule(d)
    shells = rule.radial_rule(d)
    xi = torch.cat(
        [r * u if r > 0.0 else torch.zeros(1, d, dtype=torch.float64) for r, _ in shells]
    )
    w = torch.cat(
        [c * a if r > 0.0 else torch.full((1,), c, dtype=torch.float64) for r, c in shells]
    )
    return xi, w, w


@dataclass(frozen=True)
class RadialDegree3(RadialRule):
    """One shell: E|x|^2 = d [Arasaratnam and Haykin 2009]."""

    @override
    def __call__(self, d: int) -> list[tuple[float, float]]:
        return [(math.sqrt(d), 1.0)]


@dataclass(frozen=True)
class RadialDegree5(RadialRule):
    """One shell and the centre: also E|x|^4 = d (d + 2) [Jia, Xin and Cheng 2013]."""

    @override
    def __call__(self, d: int) -> list[tuple[float, float]]:
        return [(0.0, 2.0 / (d + 2)), (math.sqrt(d + 2), d / (d + 2))]


@dataclass(frozen=True)
class AxisDegree3(SphericalRule):
    """Both ends of each axis, 2 d points [Arasaratnam and Haykin 2009]."""

    @override
    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        return _with_opposites(torch.eye(d, dtype=torch.float64), 0.5 / d)


@dataclass(frozen=True)
class AxisDegree5(SphericalRule):
    """Axes and diagonals of each pair of axes, 2 d^2 points [Jia, Xin and Cheng 2013]."""

    @override
    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        axes = torch.eye(d, dtype=torch.float64)
        i, j = torch.triu_indices(d, d, 1)
        diagonals = torch.cat([axes[i] + axes[j], axes[i] - axes[j]]) / math.sqrt(2.0)
        return _concatenated(
            _with_opposites(axes, (4 - d) / (2 * d * (d + 2))),
            _with_opposites(diagonals, 1.0 / (d * (d + 2))),
        )


@dataclass(frozen=True)
class SimplexDegree3(SphericalRule):
    """Simplex corners and their opposites, 2 d + 2 points [Wang, Feng and Tseng 2014]."""

    @override
    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        return _with_opposites(_simplex(d), 0.5 / (d + 1))


@dataclass(frozen=True)
class SimplexDegree5(SphericalRule):
    """Corners and projected edge midpoints of a simplex [Lu and Darmofal 2004]."""

    @override
    def __call__(self, d: int) -> tuple[Tensor, Tensor]:
        corners = _simplex(d)
        corner_points = _with_opposites(corners, d * (7 - d) / (2 * (d + 1) ** 2 * (d + 2)))
        if d == 1:  # the edge midpoint is the centre
            return corner_points
        i, j = torch.triu_indices(d + 1, d + 1, 1)
        midpoints = math.sqrt(d / (2 * (d - 1))) * (corners[i] + corners[j])
        return _concatenated(
            corner_points,
            _with_opposites(midpoints, 2 * (d - 1) ** 2 / (d * (d + 1) ** 2 * (d + 2))),
        )


def _with_opposites(u: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Return unit vectors and their opposites, all with the same weight."""
    return torch.cat([u, -u]), torch.full((2 * len(u),), weight, dtype=torch.float64)


def _concatenated(*point_sets: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Concatenate pairs of points and weights."""
    return torch.cat([u for u, _ in point_sets]), torch.cat([a for _, a in point_sets])


def _simplex(d: int) -> Tensor:
    """Return corners a_j of a regular simplex [d + 1, d] with a_j . a_k = -1/d."""
    i = torch.arange(1, d + 1, dtype=torch.float64)
    j = torch.arange(1, d + 2, dtype=torch.float64)[:, None]
    below_diagonal = -torch.sqrt((d + 1) / (d * (d - i + 2) * (d - i + 1)))
    on_diagonal = torch.sqrt((d + 1) * (d - i + 1) / (d * (d - i + 2)))
    return torch.where(i < j, below_diagonal, 0.0) + torch.where(i == j, on_diagonal, 0.0)
