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
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief, normalise_log_weights, select_by_run
from pfbench.filter.particle.gaussian_particle_filter import refuse_history
from pfbench.filter.particle.resampling import Resampler
from pfbench.filter.particle.resampling_schemes import Systematic
from pfbench.filter.polymerised.partition import CellPartition, WhitenedCells, divide_cells
from pfbench.filter.polymerised.placement import (
    CellAggregates,
    ParticlePlacement,
    PooledCovariancePlacement,
    select_rows,
)
from pfbench.model.base import StateSpaceModel

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
        if not 0.0 <= self.ess_threshold <= 1.0:
            raise ValueError(
                f"resampler.ess_threshold must be from 0 to 1, got {self.ess_threshold}. "
                "Use 0 to resample never, 1 at every step."
            )
        if self.axes is not None and (
            not self.axes or len(set(self.axes)) < len(self.axes) or min(self.axes) < 0
        ):
            raise ValueError(
                f"resampler.axes must be distinct indices from 0, got {list(self.axes)}. "
                "Use null for the default."
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
        if max(self.axes) >= d:
            raise ValueError(
                f"resampler.axes must be at most {d - 1} for {type(model).__name__}, "
                f"got {list(self.axes)}. Remove larger indices."
            )
        return self.axes


def aggregate_cells(cell: Tensor, w: Tensor, d: Tensor, covariance: Tensor) -> CellAggregates:
    """Aggregate weighted particles by cell.

    The polymer of a cell with weight 0 is the plain mean of its particles.

    Args:
        cell: Cell of each particle, [R, N].
        w: Weights, [R, N].
        d: Differences from the weighted mean, [R, N, d].
        covariance: Covariance of the particles, [R, d, d].

    Returns:
        Particles aggregated by cell.
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
