"""Cells: how the space of a cloud is divided, in differences from its mean. All batched; cells are numbers, not lists."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.filter.whitening import whiten


class Grid(Protocol):
    """Differences p [R, N, k] from the mean, which particles weigh anything [R, N], covariance [R, k, k] -> numbers of cells.

    Returns: int64 [R, N, k], each from 0 to `side` - 1.
    """

    @property
    def side(self) -> int: ...

    def __call__(self, p: Tensor, alive: Tensor, covariance: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Whitened:
    """Cells of the whitened plane z = chol(P)^-1 p, so that no outlier and no unit decides their size. [ours]

    Args:
        cell: side of a cell in standard deviations.
        reach: particles farther out go to the outermost cells.
    """

    cell: float = 1.0
    reach: float = 6.0

    def __post_init__(self) -> None:
        if not 0.0 < self.cell <= self.reach:
            raise ValueError(f"resampler.grid: cell={self.cell}, reach={self.reach}; give 0 < cell <= reach, in deviations")

    @property
    def side(self) -> int:
        return 2 * self._half + 1

    @property
    def _half(self) -> int:
        return int(self.reach / self.cell + 0.5)

    def __call__(self, p: Tensor, alive: Tensor, covariance: Tensor) -> Tensor:
        z = whiten(p, factor(covariance)[0]).clamp(-self.reach, self.reach)
        return torch.floor(z / self.cell + 0.5).long() + self._half


@dataclass(frozen=True)
class Raw:
    """Equal boxes between the outermost particles, along the axes of the state; the paper gives no number.

    Args:
        cells: along each axis.
    """

    cells: int = 8

    def __post_init__(self) -> None:
        if self.cells < 1:
            raise ValueError(f"resampler.grid.cells={self.cells}: give at least one cell along each axis")

    @property
    def side(self) -> int:
        return self.cells

    def __call__(self, p: Tensor, alive: Tensor, covariance: Tensor) -> Tensor:
        living = alive.unsqueeze(-1)
        low = torch.where(living, p, torch.inf).amin(1, keepdim=True)
        high = torch.where(living, p, -torch.inf).amax(1, keepdim=True)
        width = torch.where(high > low, high - low, 1.0)
        return (self.cells * (p - low) / width).clamp(0.0, self.cells - 0.5).long()


def divide(grid: Grid, p: Tensor, alive: Tensor, covariance: Tensor) -> Tensor:
    """Particles' cells [R, N], numbered from 0 without gaps in each run. Arguments as for Grid."""
    index = grid(p, alive, covariance)
    key = index[..., 0]
    for axis in range(1, index.shape[-1]):
        key = key * grid.side + index[..., axis]
    ordered, order = key.sort(1)
    number = torch.nn.functional.pad((ordered[:, 1:] != ordered[:, :-1]).cumsum(1), (1, 0))
    return torch.zeros_like(key).scatter(1, order, number)
