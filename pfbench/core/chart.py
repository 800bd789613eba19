"""Addition, subtraction and means of states: Euclidean components, angles and quaternions.

A chart maps states x [..., D] to differences d [..., d], the coordinates of covariances and kernels.
The dimension d is smaller than D if the state has a quaternion. Each block applies to its components.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core import quaternion


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

        Args:
            x: Components of states, [..., size].
            d: Difference, [..., dimension].

        Returns:
            Components of states, [..., size].
        """

    @abstractmethod
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        """Compute the shortest d with x (+) d = y.

        Args:
            y: Components of states, [..., size].
            x: Components of states, [..., size].

        Returns:
            Difference, [..., dimension].
        """

    def rotation_angles(self, d: Tensor) -> Tensor:
        """Compute the angles of a difference that a full turn does not change.

        Args:
            d: Difference, [..., dimension].

        Returns:
            Absolute angles, [..., A], rad. A block without them has A = 0.
        """
        return d[..., :0]


@dataclass(frozen=True)
class EuclideanBlock(ChartBlock):
    """Real numbers."""

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
        q = quaternion.quaternion_multiply(x, quaternion.quaternion_from_rotation_vector(d))
        return q / q.norm(dim=-1, keepdim=True)

    @override
    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        conjugate = x * x.new_tensor([1.0, -1.0, -1.0, -1.0])
        return quaternion.rotation_vector_from_quaternion(
            quaternion.quaternion_multiply(conjugate, y)
        )

    @override
    def rotation_angles(self, d: Tensor) -> Tensor:
        return d.norm(dim=-1, keepdim=True)


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


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap an angle to [-pi, pi], rad; an angle in this interval is unchanged."""
    # remainder(angle + pi, 2 pi) - pi would leave two digits of an arcsecond in float32
    return angle - 2 * torch.pi * torch.round(angle / (2 * torch.pi))
