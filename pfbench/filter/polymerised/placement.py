"""Placement of new particles around the aggregates of their cells."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.filter.particle.point_sets import HaltonPoints, PointSet
from pfbench.filter.whitening import whiten


class CellAggregates(NamedTuple):
    """Particles aggregated by cell.

    A run has N slots for cells. Those without particles have weight 0.

    Attributes:
        weight: Sum W of the weights of a cell, [R, N].
        centre: Weighted mean of its particles minus the overall mean, [R, N, d].
        within: Pooled covariance inside the cells, [R, d, d]. The total covariance is the sum of it
            and the covariance of the centres.
        covariance: Total covariance, [R, d, d].
    """

    weight: Tensor
    centre: Tensor
    within: Tensor
    covariance: Tensor


class ParticlePlacement(Protocol):
    """Placement of new particles, as differences from the mean."""

    def __call__(
        self, polymers: CellAggregates, slot: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        """Place particles.

        Args:
            polymers: Particles aggregated by cell.
            slot: Cell of each new slot, [R, N].
            draws: Random stream of the step.

        Returns:
            Differences from the mean [R, N, d], and the mask of valid runs [R].
        """


@dataclass(frozen=True)
class PooledCovariancePlacement(ParticlePlacement):
    """Normal placement about the polymer with pooled covariance inside cells [ours].

    Mean and covariance of the particles are preserved.

    Attributes:
        points: Point set of the d normal coordinates.
    """

    points: PointSet = field(default_factory=HaltonPoints)

    @override
    def __call__(
        self, polymers: CellAggregates, slot: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        root, ok = factor(polymers.within)
        z = self.points(draws).normal("polymer", slot.shape[1], root.shape[-1])
        return select_rows(polymers.centre, slot) + z @ root.mT, ok


@dataclass(frozen=True)
class ScaledCentrePlacement(ParticlePlacement):
    """Polymer first, other particles at c + c o u [Pu and Qin, eq. 18].

    c is the difference of the polymer from the mean, and u uniform on [`min_scale`, 1) per
    component.

    Attributes:
        min_scale: 0 as printed: every particle moves away from the mean. -1 centres the move
            [ours].
        whiten: Apply to whitened axes instead of the state's. [ours]
        match_moments: Divide by sqrt(E (1 + u)^2), which preserves second moments. [ours]
        points: Point set of u.

    Raises:
        ValueError: If the smallest scale is outside [-1, 1).
    """

    min_scale: float = 0.0
    whiten: bool = False
    match_moments: bool = False
    points: PointSet = field(default_factory=HaltonPoints)

    def __post_init__(self) -> None:
        if not -1.0 <= self.min_scale < 1.0:
            raise ValueError(
                f"resampler.placement.min_scale must be in [-1, 1), got {self.min_scale}. "
                "Use 0 (as printed) or -1 (centred)."
            )

    @override
    def __call__(
        self, polymers: CellAggregates, slot: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor]:
        centre = select_rows(polymers.centre, slot)
        ok = torch.isfinite(polymers.weight.sum(1))
        is_polymer = torch.nn.functional.pad(slot[:, 1:] != slot[:, :-1], (1, 0), value=True)
        # polymers do not consume points of the set
        point_index = ((~is_polymer).cumsum(1) - 1).clamp(min=0)
        u = self.points(draws).uniform("polymer", slot.shape[1], centre.shape[-1]).to(centre)
        u = select_rows(u, point_index)
        growth = self._growth if self.match_moments else 1.0
        stretch = (1.0 + self.min_scale + (1.0 - self.min_scale) * u) / growth
        stretch = torch.where(is_polymer.unsqueeze(-1), 1.0, stretch)
        if not self.whiten:
            return centre * stretch, ok
        root, ok = factor(polymers.covariance)
        return (whiten(centre, root) * stretch) @ root.mT, ok

    @property
    def _growth(self) -> float:
        """Return sqrt(E (1 + u)^2)."""
        mean, width = 1.0 + 0.5 * (1.0 + self.min_scale), 1.0 - self.min_scale
        return float(mean**2 + width**2 / 12.0) ** 0.5


def select_rows(a: Tensor, index: Tensor) -> Tensor:
    """Select rows of a tensor by index.

    Args:
        a: Rows, [R, M, d].
        index: Row of each slot, [R, N].

    Returns:
        Selected rows, [R, N, d].
    """
    return a.gather(1, index.unsqueeze(-1).expand(-1, -1, a.shape[-1]))
