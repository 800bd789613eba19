"""How states add, subtract and average: Euclidean components, wrapped angles, rotation quaternions.

A chart speaks of states x [..., D] and of differences d [..., d] in which covariances, kernels and means live; d < D where the
state holds a quaternion. Blocks are applied in order, each to its own components.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.nav import attitude


class Block(Protocol):
    """One kind of component: `size` numbers in the state, `dimension` in a difference."""

    @property
    def size(self) -> int: ...

    @property
    def dimension(self) -> int: ...

    def add(self, x: Tensor, d: Tensor) -> Tensor: ...

    def subtract(self, y: Tensor, x: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Euclidean:
    """`size` plain numbers."""

    size: int

    @property
    def dimension(self) -> int:
        return self.size

    def add(self, x: Tensor, d: Tensor) -> Tensor:
        return x + d

    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        return y - x


@dataclass(frozen=True)
class Angles:
    """`size` angles in radians, kept in [-pi, pi]."""

    size: int

    @property
    def dimension(self) -> int:
        return self.size

    def add(self, x: Tensor, d: Tensor) -> Tensor:
        return wrap(x + d)

    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        return wrap(y - x)


@dataclass(frozen=True)
class Quaternion:
    """A unit quaternion, scalar first; differences are rotation vectors on its right: q exp(d)."""

    size: int = 4
    dimension: int = 3

    def add(self, x: Tensor, d: Tensor) -> Tensor:
        q = attitude.quaternion_multiply(x, attitude.quaternion_from_rotation_vector(d))
        return q / q.norm(dim=-1, keepdim=True)

    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        conjugate = x * x.new_tensor([1.0, -1.0, -1.0, -1.0])
        return attitude.rotation_vector_from_quaternion(attitude.quaternion_multiply(conjugate, y))


@dataclass(frozen=True)
class Chart:
    """The chart of a whole state, block after block."""

    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Numbers in a state, D."""
        return sum(block.size for block in self.blocks)

    @property
    def dimension(self) -> int:
        """Numbers in a difference, d."""
        return sum(block.dimension for block in self.blocks)

    @property
    def flat(self) -> bool:
        """True where states add and average as plain numbers."""
        return all(isinstance(block, Euclidean) for block in self.blocks)

    def add(self, x: Tensor, d: Tensor) -> Tensor:
        """x (+) d: [..., D], [..., d] -> [..., D]."""
        if self.flat:
            return x + d
        xs, ds = x.split([b.size for b in self.blocks], -1), d.split([b.dimension for b in self.blocks], -1)
        return torch.cat([b.add(p, q) for b, p, q in zip(self.blocks, xs, ds, strict=True)], -1)

    def subtract(self, y: Tensor, x: Tensor) -> Tensor:
        """The d for which x (+) d = y, the short way round: [..., D], [..., D] -> [..., d]."""
        if self.flat:
            return y - x
        sizes = [b.size for b in self.blocks]
        pairs = zip(self.blocks, y.split(sizes, -1), x.split(sizes, -1), strict=True)
        return torch.cat([b.subtract(p, q) for b, p, q in pairs], -1)

    def mean(self, x: Tensor, w: Tensor, passes: int = 3) -> Tensor:
        """Weighted mean of x [..., N, D] with w [..., N], weights summing to 1 -> [..., D].

        Curved blocks average in the tangent at the heaviest particle, then again at the mean so found (Gauss-Newton).
        """
        if self.flat:
            return (w.unsqueeze(-2) @ x).squeeze(-2)
        heaviest = w.argmax(-1, keepdim=True).unsqueeze(-1).expand(*x.shape[:-2], 1, x.shape[-1])
        m = x.gather(-2, heaviest)
        for _ in range(passes):
            m = self.add(m, (w.unsqueeze(-1) * self.subtract(x, m)).sum(-2, keepdim=True))
        return m.squeeze(-2)


def wrap(angle: Tensor) -> Tensor:
    """Angle in radians to [-pi, pi]; an angle already there keeps all its digits."""
    # not remainder(angle + pi, 2 pi) - pi: in float32 that leaves an arcsecond two digits
    return angle - 2 * torch.pi * torch.round(angle / (2 * torch.pi))
