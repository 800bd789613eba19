"""Partitions of the state space into cells, batched, by differences from the mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.filter.whitening import whiten


class CellPartition(Protocol):
    """Partition into cells along each axis."""

    @property
    def side(self) -> int:
        """Number of cells along an axis."""

    def __call__(self, p: Tensor, active_mask: Tensor, covariance: Tensor) -> Tensor:
        """Compute the cell of each particle along each axis.

        Args:
            p: Differences from the mean, [R, N, k].
            active_mask: Mask of active particles, [R, N].
            covariance: Covariance of the particles, [R, k, k].

        Returns:
            Cell numbers from 0 to `side` - 1, int64 [R, N, k].
        """


@dataclass(frozen=True)
class WhitenedCells(CellPartition):
    """Cells of z = chol(P)^-1 p, independent of outliers and units [ours].

    Attributes:
        cell_size: Side of a cell in standard deviations.
        reach: Distance of the outermost cells, which contain all farther particles.

    Raises:
        ValueError: If the cell size is not in (0, reach].
    """

    cell_size: float = 1.0
    reach: float = 6.0

    def __post_init__(self) -> None:
        if not 0.0 < self.cell_size <= self.reach:
            raise ValueError(
                "resampler.partition.cell_size must be in (0, reach], got "
                f"cell_size={self.cell_size}, reach={self.reach}. Set both in standard deviations."
            )

    @property
    @override
    def side(self) -> int:
        return 2 * self._half + 1

    @property
    def _half(self) -> int:
        return int(self.reach / self.cell_size + 0.5)

    @override
    def __call__(self, p: Tensor, active_mask: Tensor, covariance: Tensor) -> Tensor:
        z = whiten(p, factor(covariance)[0]).clamp(-self.reach, self.reach)
        return torch.floor(z / self.cell_size + 0.5).long() + self._half


@dataclass(frozen=True)
class AxisAlignedCells(CellPartition):
    """Equal boxes along the axes of the state, between the outermost particles.

    Attributes:
        cells_per_axis: Number along each axis, not specified in the paper.

    Raises:
        ValueError: If the number is below 1.
    """

    cells_per_axis: int = 8

    def __post_init__(self) -> None:
        if self.cells_per_axis < 1:
            raise ValueError(
                "resampler.partition.cells_per_axis must be at least 1, got "
                f"{self.cells_per_axis}. Set 1 or more."
            )

    @property
    @override
    def side(self) -> int:
        return self.cells_per_axis

    @override
    def __call__(self, p: Tensor, active_mask: Tensor, covariance: Tensor) -> Tensor:
        mask, count = active_mask.unsqueeze(-1), self.cells_per_axis
        low = torch.where(mask, p, torch.inf).amin(1, keepdim=True)
        high = torch.where(mask, p, -torch.inf).amax(1, keepdim=True)
        width = torch.where(high > low, high - low, 1.0)
        return (count * (p - low) / width).clamp(0.0, count - 0.5).long()


def divide_cells(
    partition: CellPartition, p: Tensor, active_mask: Tensor, covariance: Tensor
) -> Tensor:
    """Assign particles to cells that are numbered from 0 without gaps in each run.

    Args:
        partition: Partition.
        p: Differences from the mean, [R, N, k].
        active_mask: Mask of active particles, [R, N].
        covariance: Covariance of the particles, [R, k, k].

    Returns:
        Cell of each particle, [R, N].
    """
    index = partition(p, active_mask, covariance)
    key = index[..., 0]
    for axis in range(1, index.shape[-1]):
        key = key * partition.side + index[..., axis]
    ordered, order = key.sort(1)
    number = torch.nn.functional.pad((ordered[:, 1:] != ordered[:, :-1]).cumsum(1), (1, 0))
    return torch.zeros_like(key).scatter(1, order, number)
