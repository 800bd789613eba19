"""States as points of a chart: addition, subtraction and means of components, angles, quaternions and groups."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from typing_extensions import override

# A chart maps states x [..., D] to differences d [..., d], the coordinates of covariances and kernels.
# The dimension d is smaller than D if the state has a quaternion. Each block applies to its components.


@dataclass(frozen=True)
class ChartBlock(ABC):
    """A block of components.

    Attributes:
        size: Number of components of a state.
    """

    size: int

    @property
    def dimension(self) -> int:
        """Number of components of a difference."""
        return self.size

    @abstractmethod
    def add(self, x: Tensor, d: Tensor) -> Tensor:
        """Add a difference.

        Returns components of states, [..., size]. Shapes: x [..., size], d [..., dimension].
        """

    @abstractmethod
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        """Compute the shortest d with x (+) d = y.

        Returns difference, [..., dimension]. Shapes: y [..., size], x [..., size].
        """

    def rotation_angles(self, d: Tensor) -> Tensor:
        """Compute the angles of a difference that a full turn does not change.

        Returns absolute angles, [..., A], rad. A block without them has A = 0. Shapes: d
        [..., dimension].
        """
        return d[..., :0]

    @abstractmethod
    def log_volume(self, d: Tensor) -> Tensor:
        """Return the log of the volume of states per volume of differences at d, [...].

        The measure of states is invariant: it is the same seen from any state. Shapes: d [..., dimension].
        """


@dataclass(frozen=True)
class EuclideanBlock(ChartBlock):
    """Real numbers."""

    @override
    def log_volume(self, d: Tensor) -> Tensor:
        return torch.zeros_like(d[..., 0])

    @override
    def add(self, x: Tensor, d: Tensor) -> Tensor:
        return x + d

    @override
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        return y - x


@dataclass(frozen=True)
class AngleBlock(ChartBlock):
    """Angles in [-pi, pi], rad."""

    @override
    def add(self, x: Tensor, d: Tensor) -> Tensor:
        return wrap_angle(x + d)

    @override
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        return wrap_angle(y - x)

    @override
    def rotation_angles(self, d: Tensor) -> Tensor:
        return d.abs()

    @override
    def log_volume(self, d: Tensor) -> Tensor:
        return torch.zeros_like(d[..., 0])


@dataclass(frozen=True)
class QuaternionBlock(ChartBlock):
    """A unit quaternion, scalar first, with right rotation vectors as differences: q exp(d)."""

    size: int = 4

    @property
    @override
    def dimension(self) -> int:
        return 3

    @override
    def add(self, x: Tensor, d: Tensor) -> Tensor:
        q = quaternion_multiply(x, quaternion_from_rotation_vector(d))
        return q / q.norm(dim=-1, keepdim=True)

    @override
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        conjugate = x * x.new_tensor([1.0, -1.0, -1.0, -1.0])
        return rotation_vector_from_quaternion(quaternion_multiply(conjugate, y))

    @override
    def rotation_angles(self, d: Tensor) -> Tensor:
        return d.norm(dim=-1, keepdim=True)

    @override
    def log_volume(self, d: Tensor) -> Tensor:
        return _log_turn_volume(d)


@dataclass(frozen=True)
class Chart:
    """Chart of a state.

    Attributes:
        blocks: Blocks in the order of the components.
    """

    blocks: tuple[ChartBlock, ...]

    @property
    def size(self) -> int:
        """Number of components of a state, D."""
        return sum(block.size for block in self.blocks)

    @property
    def dimension(self) -> int:
        """Number of components of a difference, d."""
        return sum(block.dimension for block in self.blocks)

    @property
    def identity(self) -> list[float]:
        """State [D] of zeros, with 1 for the scalar part of each quaternion."""
        return [
            float(component == 0 and block.dimension < block.size)
            for block in self.blocks
            for component in range(block.size)
        ]

    @cached_property
    def flat(self) -> bool:
        """True if all components are Euclidean."""
        return all(isinstance(block, EuclideanBlock) for block in self.blocks)

    def add(self, x: Tensor, d: Tensor) -> Tensor:
        """Compute x (+) d.

        Args:
            x: States, [..., D].
            d: Differences, [..., d].

        Returns:
            States, [..., D].
        """
        if self.flat:
            return x + d
        xs = x.split([b.size for b in self.blocks], -1)
        ds = d.split([b.dimension for b in self.blocks], -1)
        return torch.cat([b.add(p, q) for b, p, q in zip(self.blocks, xs, ds, strict=True)], -1)

    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        """Compute the shortest d with x (+) d = y.

        Args:
            y: States, [..., D].
            x: States, [..., D].

        Returns:
            Differences, [..., d].
        """
        if self.flat:
            return y - x
        sizes = [b.size for b in self.blocks]
        pairs = zip(self.blocks, y.split(sizes, -1), x.split(sizes, -1), strict=True)
        return torch.cat([b.subtract(p, q) for b, p, q in pairs], -1)

    def rotation_angles(self, d: Tensor) -> Tensor:
        """Compute the angles of all blocks of a difference.

        Args:
            d: Differences, [..., d].

        Returns:
            Absolute angles, [..., A], rad.
        """
        ds = d.split([b.dimension for b in self.blocks], -1)
        return torch.cat([b.rotation_angles(p) for b, p in zip(self.blocks, ds, strict=True)], -1)

    def log_volume(self, d: Tensor) -> Tensor:
        """Compute the log of the volume of states per volume of differences.

        Args:
            d: Differences from any state, [..., d].

        Returns:
            Log volumes, [...]; 0 everywhere for a flat chart.
        """
        if self.flat:
            return torch.zeros_like(d[..., 0])
        ds = d.split([b.dimension for b in self.blocks], -1)
        return sum(
            (b.log_volume(p) for b, p in zip(self.blocks, ds, strict=True)),
            torch.zeros_like(d[..., 0]),
        )

    def mean(self, x: Tensor, w: Tensor, passes: int = 3) -> Tensor:
        """Compute a weighted mean.

        Curved blocks are averaged in the tangent space at the particle of largest weight, then at
        the resulting mean (Gauss-Newton).

        Args:
            x: States, [..., N, D].
            w: Weights with sum 1, [..., N].
            passes: Number of Gauss-Newton iterations.

        Returns:
            Mean state, [..., D].
        """
        if self.flat:
            return (w.unsqueeze(-2) @ x).squeeze(-2)
        heaviest = w.argmax(-1, keepdim=True).unsqueeze(-1).expand(*x.shape[:-2], 1, x.shape[-1])
        m = x.gather(-2, heaviest)
        for _ in range(passes):
            m = self.add(m, (w.unsqueeze(-1) * self.subtract(x, m)).sum(-2, keepdim=True))
        return m.squeeze(-2)


def _log_turn_volume(r: Tensor) -> Tensor:
    """Return log (2 sin(a / 2) / a)^2 of rotation vectors [..., 3] with the angle a: det of their left Jacobian."""
    square, small, angle = _angles(r, _TINY)
    chord = torch.where(small, 1.0 - square / 24, torch.sinc(angle / (2.0 * torch.pi)))
    return 2.0 * torch.log(chord[..., 0])


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap an angle to [-pi, pi]; an angle in this interval is unchanged.

    Args:
        angle: Angles [...], rad.

    Returns:
        Angles [...], rad.
    """
    # remainder(angle + pi, 2 pi) - pi would leave two digits of an arcsecond in float32
    return angle - 2 * torch.pi * torch.round(angle / (2 * torch.pi))


# --------------------------------------------------------------------------------------------------
# Quaternion algebra of charts: unit quaternions, scalar first.

# Hamilton's table: row 4 i + j holds the sign of the product of units i and j in its component.
_HAMILTON = torch.zeros(16, 4, dtype=torch.float64)
for _i, _row in enumerate(((+1, +2, +3, +4), (+2, -1, +4, -3), (+3, -4, -1, +2), (+4, +3, -2, -1))):
    for _j, _unit in enumerate(_row):
        _HAMILTON[4 * _i + _j, abs(_unit) - 1] = math.copysign(1.0, _unit)


def quaternion_from_rotation_vector(r: Tensor) -> Tensor:
    """Convert rotation vectors [..., 3] to unit quaternions [..., 4]."""
    square, small, angle = _angles(r, _TINY)
    cosine = torch.where(small, 1.0 - square / 8 + square**2 / 384, torch.cos(angle / 2))
    sine = torch.where(
        small, 0.5 - square / 48 + square**2 / 3840, torch.sinc(angle / (2 * torch.pi)) / 2
    )
    return torch.cat([cosine, sine * r], dim=-1)


def rotation_vector_from_quaternion(q: Tensor) -> Tensor:
    """Convert unit quaternions [..., 4] to rotation vectors [..., 3].

    The length of a rotation vector is at most pi.
    """
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    square, small, half_sine = _angles(v, _TINY)
    w_near = torch.where(small, w, torch.ones_like(w))  # at half a turn w is 0
    ratio = square / w_near.square()  # squared tangent of half the angle
    near = 2 / w_near * (1 - ratio / 3 + ratio.square() / 5)
    return torch.where(small, near, 2 * torch.atan2(half_sine, w) / half_sine) * v


def quaternion_multiply(p: Tensor, q: Tensor) -> Tensor:
    """Compute Hamilton's product p q.

    Returns products, [..., 4]. Shapes: p [..., 4], q [..., 4].
    """
    # one operation for all products: 16 separate ones take 3 times as long in forward-mode AD
    products = (p.unsqueeze(-1) * q.unsqueeze(-2)).flatten(-2)
    return products @ _HAMILTON.to(products)


# --------------------------------------------------------------------------------------------------
# Chart blocks of the groups SO(3), SE(3) and SE_2(3): a quaternion followed by 0, 1 or 2 vectors.
#
# An element X = (C, a_1, ..., a_k) is the matrix [C a_1 ... a_k; 0 I]. The product of two elements is
# (C C', a_i + C a_i'). The exponential of (phi, d_i) is (Exp phi, J(phi) d_i) [Barrau and Bonnabel 2017].

SIDES = ("left", "right")


@dataclass(frozen=True)
class LieGroupBlock(ChartBlock):
    """An element of SO(3), SE(3) or SE_2(3) as components (quaternion, vectors), size 4, 7 or 10.

    Differences are elements of the Lie algebra (phi, d_1, ..., d_k), dimension 3, 6 or 9. They do not
    change if all states are multiplied from the side of the name:

        left     x (+) d = X exp(d),  y (-) x = log(X^-1 Y): phi and d_i in body axes,
        right    x (+) d = exp(d) X,  y (-) x = log(Y X^-1): phi and d_i in level axes.

    Attributes:
        side: `left` or `right`.

    Raises:
        ValueError: If the size is not 4, 7 or 10, or the side is neither.
    """

    size: int = 10
    side: str = "left"

    def __post_init__(self) -> None:
        if self.size not in (4, 7, 10):
            raise ValueError(
                "LieGroupBlock.size must be 4, 7 or 10 (a quaternion and 0, 1 or 2 vectors), got "
                f"{self.size}. Use 10 for attitude, velocity and position."
            )
        if self.side not in SIDES:
            raise ValueError(
                f"LieGroupBlock.side must be left or right, got {self.side}. Use left for position "
                "fixes."
            )

    @property
    @override
    def dimension(self) -> int:
        return self.size - 1

    @override
    def add(self, x: Tensor, d: Tensor) -> Tensor:
        phi, exponent = d[..., :3], _vectors(d[..., 3:])
        turn = quaternion_from_rotation_vector(phi)
        shift = apply_left_jacobian(phi.unsqueeze(-2), exponent)
        if self.side == "left":
            q = quaternion_multiply(x[..., :4], turn)
            vectors = _vectors(x[..., 4:]) + _rotate(x[..., :4], shift)
        else:
            q = quaternion_multiply(turn, x[..., :4])
            vectors = _rotate(turn, _vectors(x[..., 4:])) + shift
        q = q / q.norm(dim=-1, keepdim=True)
        return torch.cat([q, vectors.flatten(-2)], -1)

    @override
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        y, x = torch.broadcast_tensors(y, x)
        inverse, y_vectors, x_vectors = (
            x[..., :4] * x.new_tensor([1.0, -1.0, -1.0, -1.0]),
            _vectors(y[..., 4:]),
            _vectors(x[..., 4:]),
        )
        if self.side == "left":
            turn = quaternion_multiply(inverse, y[..., :4])
            vectors = _rotate(inverse, y_vectors - x_vectors)
        else:
            turn = quaternion_multiply(y[..., :4], inverse)
            vectors = y_vectors - _rotate(turn, x_vectors)
        phi = rotation_vector_from_quaternion(turn)
        exponent = apply_inverse_left_jacobian(phi.unsqueeze(-2), vectors)
        return torch.cat([phi, exponent.flatten(-2)], -1)

    @override
    def rotation_angles(self, d: Tensor) -> Tensor:
        return d[..., :3].norm(dim=-1, keepdim=True)

    @override
    def log_volume(self, d: Tensor) -> Tensor:
        """Return that of the rotation, once for itself and once for each vector, which J(phi) turns."""
        return self.dimension // 3 * _log_turn_volume(d[..., :3])


def _vectors(a: Tensor) -> Tensor:
    """Return components [..., 3 k] as vectors [..., k, 3]."""
    return a.unflatten(-1, (a.shape[-1] // 3, 3))


def _rotate(q: Tensor, a: Tensor) -> Tensor:
    """Rotate vectors [..., k, 3] by unit quaternions [..., 4]."""
    axis, a = torch.broadcast_tensors(q[..., 1:].unsqueeze(-2), a)
    twice = 2.0 * torch.linalg.cross(axis, a)
    return a + q[..., None, :1] * twice + torch.linalg.cross(axis, twice)


# --------------------------------------------------------------------------------------------------
# Coefficients of the left Jacobian of rotations and of its inverse, in full precision at all angles.
#
# With theta^2 = phi . phi and K = [phi x],
#
#     J(phi) = I + a K + b K^2,         a = (1 - cos theta) / theta^2, b = (theta - sin theta) / theta^3,
#     J(phi)^-1 = I - K / 2 + c K^2,    c = (1 - theta / 2 cot(theta / 2)) / theta^2.
#
# Below theta = 0.5 the closed forms cancel, and power series in theta^2 replace them. The branch depends on
# theta^2, since the derivative of theta at 0 is not a number.

_TINY = 1e-8  # theta^2 below which two terms of a series have all digits; its second derivative at 0 is finite
_SWITCH = 0.25  # theta^2 at which the closed forms replace the series
_A = (1 / 2, -1 / 24, 1 / 720, -1 / 40320, 1 / 3628800, -1 / 479001600)
_B = (1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800)
_C = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)


def jacobian_coefficients(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the coefficients a and b of J.

    Returns coefficients, [..., 1] each. Shapes: phi [..., 3].
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

    Returns coefficient, [..., 1]. Shapes: phi [..., 3].
    """
    square, small, theta = _angles(phi)
    half = 0.5 * theta
    c = (1.0 - half * torch.cos(half) / torch.sin(half)) / theta.square()
    return torch.where(small, _polynomial(_C, square), c)


def apply_left_jacobian(phi: Tensor, a: Tensor) -> Tensor:
    """Compute J(phi) a.

    Returns vectors, [..., 3]. Shapes: phi [..., 3], a [..., 3].
    """
    first, second = jacobian_coefficients(phi)
    phi, a = torch.broadcast_tensors(phi, a)
    once = torch.linalg.cross(phi, a)
    return a + first * once + second * torch.linalg.cross(phi, once)


def apply_inverse_left_jacobian(phi: Tensor, a: Tensor) -> Tensor:
    """Compute J(phi)^-1 a.

    Returns vectors, [..., 3]. Shapes: phi [..., 3], a [..., 3].
    """
    c = inverse_jacobian_coefficient(phi)
    phi, a = torch.broadcast_tensors(phi, a)
    once = torch.linalg.cross(phi, a)
    return a - 0.5 * once + c * torch.linalg.cross(phi, once)


def _angles(phi: Tensor, switch: float = _SWITCH) -> tuple[Tensor, Tensor, Tensor]:
    """Return theta^2, whether the series holds, and theta with 1 in place of small angles."""
    square = phi.square().sum(-1, keepdim=True)
    small = square < switch
    # a derivative of the branch that is not taken must be finite
    return square, small, torch.where(small, torch.ones_like(square), square).sqrt()


def _polynomial(coefficients: Sequence[float], t: Tensor) -> Tensor:
    """Evaluate a polynomial, lowest order first, by Horner's rule."""
    value = torch.full_like(t, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        value = value * t + coefficient
    return value
