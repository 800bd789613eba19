"""Linearisation rules: Taylor expansion, and sigma points with weights.

For x = m + L xi with xi ~ (0, I), a rule computes the statistical linearisation f(x) =
y + M xi + e, Cov e = Omega [Lefebvre et al. 2002; Garcia-Fernandez et al. 2015]. M is already
multiplied by the Cholesky factor L, so the rest of the filter works on square roots.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.jacobian import jacobian
from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable

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


def around_first(
    residual: Callable[[Tensor, Tensor], Tensor],
) -> Callable[[Tensor, Tensor], Tensor]:
    """Make the weighted mean of values that may wrap: the mean of residuals to the first value."""

    def mean(y: Tensor, w: Tensor) -> Tensor:
        return y[:, 0] + (w.unsqueeze(-1) * residual(y, y[:, :1])).sum(1)

    return mean


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
        if self.largest_angle is not None and not self.largest_angle > 0.0:
            raise ValueError(
                f"linearisation.largest_angle must be positive, got {self.largest_angle}. Use 2."
            )

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


_fitted = compilable(_separate_fit, operator=cpp.fit_affine, use_torch_compiler=False)


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
        if not self.alpha > 0.0:
            raise ValueError(
                f"linearisation.points.alpha must be positive, got {self.alpha}. Set a spread."
            )
        if not self.beta >= 0.0:  # the covariance of a curved function could be indefinite
            raise ValueError(
                f"linearisation.points.beta must be at least 0, got {self.beta}. Use 2 for normal states."
            )

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], mean weights [P] and covariance weights [P]."""
        squared_radius = self.alpha**2 * (d + self.kappa)
        if not squared_radius > 0.0:
            raise ValueError(
                f"filter.linearisation.points.kappa must be greater than -d = {-d}, got {self.kappa}. "
                "Increase it."
            )
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
