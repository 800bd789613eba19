"""Polymerised resampling: aggregate particles by cell, then place new ones there.

See [Pu and Qin, section 3.2]. The particles of a cell form one polymer with their weight and
weighted mean. Its share of the new particles is placed around it by consecutive points of one
low-discrepancy set. Partition, number of particles per cell and placement are choices. All
steps use the chart about the mean.

References:
    Pu and Qin, Application of quasi Monte Carlo polymerization re-sampling particle filter
    algorithm in airborne passive location.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, normalise_log_weights, select_by_run
from pfbench.filter.particle.gaussian_particle_filter import refuse_history
from pfbench.filter.particle.sqmc import HaltonPoints
from pfbench.filter.particle.stages import PointSet, Resampler, Systematic
from pfbench.filter.whitening import whiten
from pfbench.model.base import StateSpaceModel


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
        require(
            0.0 < self.cell_size <= self.reach,
            "resampler.partition.cell_size",
            "be in (0, reach]",
            f"cell_size={self.cell_size}, reach={self.reach}",
            "Set both in standard deviations.",
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
        require_ranges("resampler.partition", self, cells_per_axis="[1, inf]")

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

    Returns cell of each particle, [R, N]. Shapes: p [R, N, k], active_mask [R, N], covariance
    [R, k, k].
    """
    index = partition(p, active_mask, covariance)
    key = index[..., 0]
    for axis in range(1, index.shape[-1]):
        key = key * partition.side + index[..., axis]
    ordered, order = key.sort(1)
    number = torch.nn.functional.pad((ordered[:, 1:] != ordered[:, :-1]).cumsum(1), (1, 0))
    return torch.zeros_like(key).scatter(1, order, number)


# --------------------------------------------------------------------------------------------------
# Placement of new particles around the aggregates of their cells.


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
        require_ranges(
            "resampler.placement", self, min_scale="[-1, 1) Use 0 (as printed) or -1 (centred)."
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

    Returns selected rows, [R, N, d]. Shapes: a [R, M, d], index [R, N].
    """
    return a.gather(1, index.unsqueeze(-1).expand(-1, -1, a.shape[-1]))


_ESS_ROUNDING = 1e-5  # relative error of ESS for a million equal weights in single precision


class CellAllocation(Protocol):
    """Number of particles per cell."""

    def __call__(
        self, share: Tensor, cell: Tensor, active_mask: Tensor, n: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Allocate slots to cells.

        Args:
            share: Resampling probability of each cell, [R, N].
            cell: Cell of each slot, [R, N].
            active_mask: Mask of active slots, [R, N].
            n: Target number of particles, [R, 1].
            draws: Random stream of the step.

        Returns:
            Cell of each new slot [R, N], non-decreasing, the probability that a cell gets a
            particle [R, N], and the mask of used slots [R or 1, N].
        """


@dataclass(frozen=True)
class ProportionalAllocation(CellAllocation):
    """n W particles for a cell, rounded systematically, which selects cells [ours]."""

    @override
    def __call__(
        self, share: Tensor, cell: Tensor, active_mask: Tensor, n: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor, Tensor]:
        chance = (n * share).clamp(torch.finfo(share.dtype).tiny, 1.0)
        slots = torch.arange(share.shape[1], device=share.device)
        return Systematic()(share, n, draws), chance, slots < n


@dataclass(frozen=True)
class UnchangedAllocation(CellAllocation):
    """As many particles as the cell had, as printed, without selection.

    If the target number differs from the number of particles, or some have become impossible,
    cells get particles in proportion to their previous number [ours].
    """

    @override
    def __call__(
        self, share: Tensor, cell: Tensor, active_mask: Tensor, n: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor, Tensor]:
        previous = torch.zeros_like(share).scatter_add(1, cell, active_mask.to(share))
        previous_share = previous / previous.sum(1, keepdim=True)
        return ProportionalAllocation()(previous_share, cell, active_mask, n, draws)


@dataclass(frozen=True)
class PolymerisedResampler(Resampler):
    """Aggregate the particles of each cell and place new ones around the polymers.

    A new particle of a cell with n_i of them has weight W_i / n_i [Pu and Qin, eq. 19], divided by
    the probability that the cell gets one. Otherwise cells with less than one particle's weight
    would be lost, and with them the tails [ours]. The mass of a cell is then correct on average,
    and exactly so if it is large. The placement assumes a shape inside cells, so `is_exact` is
    False. The defaults preserve mean and covariance on average.

    Attributes:
        partition: Partition. The defaults of all three are the repaired method. [ours]
        allocation: Number of particles per cell.
        placement: Placement.
        axes: Components that the grid divides. None takes the first two of the group `position`,
            else the first two of the state, or its only one. [ours]
        ess_threshold: Resample runs with ESS < threshold n. 1 as published: at every step, except
            runs with equal weights in the target number, such as initial particles.

    Raises:
        ValueError: If the threshold is outside [0, 1] or axes repeat. On the first use, if an axis
            is not a component of the model, or if particles store a history.
    """

    partition: CellPartition = field(default_factory=WhitenedCells)
    allocation: CellAllocation = field(default_factory=ProportionalAllocation)
    placement: ParticlePlacement = field(default_factory=PooledCovariancePlacement)
    axes: Sequence[int] | None = None
    ess_threshold: float = 1.0
    is_exact = False

    def __post_init__(self) -> None:
        rule = "[0, 1] Use 0 to resample never, 1 at every step."
        require_ranges("resampler", self, ess_threshold=rule)
        axes = [0] if self.axes is None else list(self.axes)
        require(
            axes and len(set(axes)) == len(axes) and min(axes) >= 0,
            "resampler.axes",
            "be distinct indices from 0",
            axes,
            "Use null for the default.",
        )

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        refuse_history(belief, "polymerisation")
        w = normalise_log_weights(belief.log_w)
        a = w if log_a is belief.log_w else normalise_log_weights(log_a)
        mean = model.chart.mean(belief.x, w)
        d = model.chart.subtract(belief.x, mean.unsqueeze(1))
        covariance = (w.unsqueeze(-1) * d).mT @ d
        plane = list(self._plane(model))
        active_mask = torch.isfinite(belief.log_w)
        cell = divide_cells(
            self.partition, d[..., plane], active_mask, covariance[:, plane][:, :, plane]
        )
        polymers = aggregate_cells(cell, w, d, covariance)
        share = torch.zeros_like(a).scatter_add(1, cell, a)
        slot, chance, used_mask = self.allocation(share, cell, active_mask, n, draws)
        placed, ok = self.placement(polymers, slot, draws)
        log_w = _log_weights(_log_sums(cell, belief.log_w), chance, slot, used_mask)
        log_w = torch.where(used_mask & ok.unsqueeze(-1), log_w, -torch.inf)
        resampled = belief._replace(x=model.chart.add(mean.unsqueeze(1), placed), log_w=log_w)
        target = n.squeeze(1)
        min_ess = self.ess_threshold * (1.0 - _ESS_ROUNDING) * target
        resampled_mask = 1.0 / a.square().sum(-1) < min_ess
        if self.ess_threshold == 1.0:
            resampled_mask = resampled_mask | ((w > 0).sum(1) != target)
        return select_by_run(resampled_mask, resampled, belief), resampled_mask

    def _plane(self, model: StateSpaceModel) -> Sequence[int]:
        """Return the components that the grid divides."""
        d = model.chart.dimension
        if self.axes is None:
            return model.groups.get("position", tuple(range(d)))[:2]
        require(
            max(self.axes) < d,
            "resampler.axes",
            f"be at most {d - 1} for {type(model).__name__}",
            list(self.axes),
            "Remove larger indices.",
        )
        return self.axes


def aggregate_cells(cell: Tensor, w: Tensor, d: Tensor, covariance: Tensor) -> CellAggregates:
    """Aggregate weighted particles by cell.

    The polymer of a cell with weight 0 is the plain mean of its particles.

    Returns particles aggregated by cell. Shapes: cell [R, N], w [R, N], d [R, N, d], covariance
    [R, d, d].
    """
    zero = torch.zeros_like(w)
    weight = zero.scatter_add(1, cell, w)
    v = torch.where(weight.gather(1, cell) > 0.0, w, 1.0)
    index = cell.unsqueeze(1).expand(-1, d.shape[-1], -1)
    total = torch.zeros_like(d.mT).scatter_add(2, index, (v.unsqueeze(-1) * d).mT).mT
    divisor = zero.scatter_add(1, cell, v)
    centre = total / torch.where(divisor > 0.0, divisor, 1.0).unsqueeze(-1)
    r = d - select_rows(centre, cell)
    return CellAggregates(weight, centre, (w.unsqueeze(-1) * r).mT @ r, covariance)


def _log_sums(cell: Tensor, log_w: Tensor) -> Tensor:
    """Compute log W of each cell [R, N], without underflow."""
    maximum = torch.full_like(log_w, -torch.inf).scatter_reduce(1, cell, log_w, "amax")
    maximum = torch.where(torch.isfinite(maximum), maximum, 0.0)
    scaled_w = torch.exp(log_w - maximum.gather(1, cell))
    return torch.zeros_like(log_w).scatter_add(1, cell, scaled_w).log() + maximum


def _log_weights(log_weight: Tensor, chance: Tensor, slot: Tensor, used_mask: Tensor) -> Tensor:
    """Compute log W_i / (n_i probability_i) of each slot's cell i [R, N]."""
    used = used_mask.to(log_weight).expand_as(log_weight)
    count = torch.zeros_like(log_weight).scatter_add(1, slot, used)
    return (log_weight - chance.log()).gather(1, slot) - count.gather(1, slot).log()
