"""Chart blocks of the groups SO(3), SE(3) and SE_2(3): a quaternion followed by 0, 1 or 2 vectors.

An element X = (C, a_1, ..., a_k) is the matrix [C a_1 ... a_k; 0 I]. The product of two elements is
(C C', a_i + C a_i'). The exponential of (phi, d_i) is (Exp phi, J(phi) d_i) [Barrau and Bonnabel 2017].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core import quaternion
from pfbench.core.chart import ChartBlock
from pfbench.core.manifold.rotation_series import (
    apply_inverse_left_jacobian,
    apply_left_jacobian,
)

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
        turn = quaternion.quaternion_from_rotation_vector(phi)
        shift = apply_left_jacobian(phi.unsqueeze(-2), exponent)
        if self.side == "left":
            q = quaternion.quaternion_multiply(x[..., :4], turn)
            vectors = _vectors(x[..., 4:]) + _rotate(x[..., :4], shift)
        else:
            q = quaternion.quaternion_multiply(turn, x[..., :4])
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
            turn = quaternion.quaternion_multiply(inverse, y[..., :4])
            vectors = _rotate(inverse, y_vectors - x_vectors)
        else:
            turn = quaternion.quaternion_multiply(y[..., :4], inverse)
            vectors = y_vectors - _rotate(turn, x_vectors)
        phi = quaternion.rotation_vector_from_quaternion(turn)
        exponent = apply_inverse_left_jacobian(phi.unsqueeze(-2), vectors)
        return torch.cat([phi, exponent.flatten(-2)], -1)

    @override
    def rotation_angles(self, d: Tensor) -> Tensor:
        return d[..., :3].norm(dim=-1, keepdim=True)


def _vectors(a: Tensor) -> Tensor:
    """Return components [..., 3 k] as vectors [..., k, 3]."""
    return a.unflatten(-1, (a.shape[-1] // 3, 3))


def _rotate(q: Tensor, a: Tensor) -> Tensor:
    """Rotate vectors [..., k, 3] by unit quaternions [..., 4]."""
    axis, a = torch.broadcast_tensors(q[..., 1:].unsqueeze(-2), a)
    twice = 2.0 * torch.linalg.cross(axis, a)
    return a + q[..., None, :1] * twice + torch.linalg.cross(axis, twice)
