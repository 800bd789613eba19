"""Coefficients of the left Jacobian of rotations and of its inverse, in full precision at all angles.

With theta^2 = phi . phi and K = [phi x],

    J(phi) = I + a K + b K^2,         a = (1 - cos theta) / theta^2, b = (theta - sin theta) / theta^3,
    J(phi)^-1 = I - K / 2 + c K^2,    c = (1 - theta / 2 cot(theta / 2)) / theta^2.

Below theta = 0.5 the closed forms cancel, and power series in theta^2 replace them. The branch depends on
theta^2, since the derivative of theta at 0 is not a number.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

_SWITCH = 0.25  # theta^2 at which the closed forms replace the series
_A = (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)
_B = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)
_C = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)


def jacobian_coefficients(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the coefficients a and b of J.

    Args:
        phi: Rotation vectors, [..., 3], rad.

    Returns:
        Coefficients, [..., 1] each.
    """
    square, small, theta = _angles(phi)
    half_sine = torch.sin(0.5 * theta)
    a = 2.0 * (half_sine / theta).square()  # 1 - cos would cancel
    b = (theta - torch.sin(theta)) / theta**3
    return (
        torch.where(small, _polynomial(_A, square), a),
        torch.where(small, _polynomial(_B, square), b),
    )


def inverse_jacobian_coefficient(phi: Tensor) -> Tensor:
    """Compute the coefficient c of the inverse of J.

    Args:
        phi: Rotation vectors no longer than pi, [..., 3], rad.

    Returns:
        Coefficient, [..., 1].
    """
    square, small, theta = _angles(phi)
    half = 0.5 * theta
    c = (1.0 - half * torch.cos(half) / torch.sin(half)) / theta.square()
    return torch.where(small, _polynomial(_C, square), c)


def apply_left_jacobian(phi: Tensor, a: Tensor) -> Tensor:
    """Compute J(phi) a.

    Args:
        phi: Rotation vectors, [..., 3], rad.
        a: Vectors, [..., 3].

    Returns:
        Vectors, [..., 3].
    """
    first, second = jacobian_coefficients(phi)
    phi, a = torch.broadcast_tensors(phi, a)
    once = torch.linalg.cross(phi, a)
    return a + first * once + second * torch.linalg.cross(phi, once)


def apply_inverse_left_jacobian(phi: Tensor, a: Tensor) -> Tensor:
    """Compute J(phi)^-1 a.

    Args:
        phi: Rotation vectors no longer than pi, [..., 3], rad.
        a: Vectors, [..., 3].

    Returns:
        Vectors, [..., 3].
    """
    c = inverse_jacobian_coefficient(phi)
    phi, a = torch.broadcast_tensors(phi, a)
    once = torch.linalg.cross(phi, a)
    return a - 0.5 * once + c * torch.linalg.cross(phi, once)


def _angles(phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return theta^2, whether the series holds, and theta with 1 in place of small angles."""
    square = phi.square().sum(-1, keepdim=True)
    small = square < _SWITCH
    # a derivative of the branch that is not taken must be finite
    return square, small, torch.where(small, torch.ones_like(square), square).sqrt()


def _polynomial(coefficients: Sequence[float], t: Tensor) -> Tensor:
    """Evaluate a polynomial, lowest order first, by Horner's rule."""
    value = torch.full_like(t, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * t + coefficient
    return value
