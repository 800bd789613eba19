"""Linearisation rules: Taylor expansion, and sigma points with weights.

For x = m + L xi with xi ~ (0, I), a rule computes the statistical linearisation f(x) =
y + M xi + e, Cov e = Omega [Lefebvre et al. 2002; Garcia-Fernandez et al. 2015]. M is already
multiplied by the Cholesky factor L, so the rest of the filter works on square roots.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import jacobian
from pfbench.core.parameter_checks import require_range, require_ranges
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable

ConditionalMoments: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]

"""xi [R, P, d] -> mean [R, P, k] and covariance [R or 1, P or 1, k, k] given each point."""


SigmaPoints: TypeAlias = Callable[[int], tuple[Tensor, Tensor, Tensor]]

"""d -> whitened points [P, d], mean weights [P] and covariance weights [P]; sum w_c xi xi' = I."""


class DifferenceSpace(NamedTuple):
    """Difference and average of the values of a map, and its slope if the model states it.

    Attributes:
        subtract: (y, y0) -> difference.
        mean: (y [R, P, k], w [R, P]) -> weighted average [R, k].
        slope: Returns the derivative at xi = 0, [R, k, d], or None if it is not stated.
    """

    subtract: Callable[[Tensor, Tensor], Tensor]
    mean: Callable[[Tensor, Tensor], Tensor]
    slope: Callable[[], Tensor | None] = lambda: None


class AffineApproximation(NamedTuple):
    """Affine approximation of a map in whitened coordinates.

    Attributes:
        y: Offset, [R, k].
        m: Slope M, [R, k, d].
        omega: Residual covariance of the fit plus `noise`, [R, k, k].
        noise: Covariance of the distribution given a point, [R, k, k].
    """

    y: Tensor
    m: Tensor
    omega: Tensor
    noise: Tensor


class LinearisationRule(Protocol):
    """A rule that approximates a map of whitened coordinates by an affine one."""

    def __call__(
        self, f: ConditionalMoments, template: Tensor, d: int, space: DifferenceSpace
    ) -> AffineApproximation:
        """Linearise a map.

        Args:
            f: Mean and covariance of the value given each point.
            template: Tensor with the dtype and the R runs of the result, [R, ...].
            d: Number of whitened coordinates.
            space: Difference and average of the values.

        Returns:
            The affine approximation.
        """


@dataclass(frozen=True)
class TaylorLinearisation(LinearisationRule):
    """First-order Taylor expansion by exact derivatives: extended Kalman filter."""

    @override
    def __call__(
        self, f: ConditionalMoments, template: Tensor, d: int, space: DifferenceSpace
    ) -> AffineApproximation:
        y, covariance = f(template.new_zeros(template.shape[0], 1, d))
        noise = covariance[:, 0].expand(template.shape[0], -1, -1)
        m = space.slope()
        if m is None:
            m = jacobian(lambda xi: f(xi)[0], y, d, space.subtract)
        return AffineApproximation(y[:, 0], m, noise, noise)


@dataclass(frozen=True)
class SigmaPointLinearisation(LinearisationRule):
    """Linearisation by sigma points and weights: unscented and cubature filters.

    Attributes:
        points: Points and weights.
        largest_angle: Largest angle of a point of the initial distribution from the mean, in angles and
            rotations, rad. A filter refuses a larger one at its start. None accepts any angle.

    Raises:
        ValueError: If the largest angle is not positive.
    """

    points: SigmaPoints
    largest_angle: float | None = 2.0

    def __post_init__(self) -> None:
        require_ranges("linearisation", self, largest_angle="null or (0, inf] Use 2.")

    @override
    def __call__(
        self, f: ConditionalMoments, template: Tensor, d: int, space: DifferenceSpace
    ) -> AffineApproximation:
        xi, w_mean, w_cov = (a.to(template) for a in self.points(d))
        values, covariance = f(xi.expand(template.shape[0], -1, -1))
        y = space.mean(values, w_mean.expand(values.shape[:2]))
        r = space.subtract(values, y.unsqueeze(1))
        m, residual_cov = _fitted(r, xi, w_cov)
        noise = (
            (w_mean[:, None, None] * covariance).sum(1)
            if covariance.shape[1] > 1
            else covariance[:, 0]
        )
        return AffineApproximation(y, m, residual_cov + noise, noise)


def _separate_fit(r: Tensor, xi: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Fit slopes M [R, k, d] and a residual covariance [R, k, k] to r at xi."""
    m = r.mT @ (w[:, None] * xi)
    residual = r - xi @ m.mT
    return m, (w[:, None] * residual).mT @ residual


_fitted = compilable(_separate_fit, operator=dispatch.fit_affine, use_torch_compiler=False)


@dataclass(frozen=True)
class UnscentedPoints:
    """Scaled unscented transform [Julier and Uhlmann 1997; van der Merwe 2004].

    With the defaults [ours] the points lie at sqrt(d), as in cubature, and the centre has weight
    2 in covariances. The usual alpha = 1e-3 makes a centre weight of -1e6, which loses half of
    the digits.

    Attributes:
        alpha: Spread of the points.
        beta: Additional weight of the centre in covariances.
        kappa: Secondary spread.

    Raises:
        ValueError: If alpha or, on use, alpha^2 (d + kappa) is not positive, or beta is negative.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        # with beta < 0 the covariance of a curved function could be indefinite
        beta = "[0, inf] Use 2 for normal states."
        require_ranges("linearisation.points", self, alpha="(0, inf]", beta=beta)

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], mean weights [P] and covariance weights [P]."""
        squared_radius = self.alpha**2 * (d + self.kappa)
        require_range("filter.linearisation.points.kappa", self.kappa, f"({-d}, inf] More than -d.")
        offsets = math.sqrt(squared_radius) * torch.eye(d, dtype=torch.float64)
        xi = torch.cat([torch.zeros(1, d, dtype=torch.float64), offsets, -offsets])
        w = torch.full((2 * d + 1,), 0.5 / squared_radius, dtype=torch.float64)
        w[0] = 1.0 - d / squared_radius
        w_cov = w.clone()
        w_cov[0] += 1.0 - self.alpha**2 + self.beta
        return xi, w, w_cov


@dataclass(frozen=True)
class CubaturePoints:
    """Third-degree spherical-radial rule, 2 d points [Arasaratnam and Haykin 2009]."""

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], mean weights [P] and covariance weights [P]."""
        offsets = math.sqrt(d) * torch.eye(d, dtype=torch.float64)
        w = torch.full((2 * d,), 0.5 / d, dtype=torch.float64)
        return torch.cat([offsets, -offsets]), w, w


# --------------------------------------------------------------------------------------------------
# Sigma points of spherical-radial cubature: products of a spherical and a radial rule.


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
