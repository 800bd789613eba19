"""Polymerisation: particles of one cell are drawn together, and quasi-Monte-Carlo points spread out again from there.

[Pu and Qin, "Application of quasi Monte Carlo polymerization re-sampling particle filter algorithm in airborne passive location",
section 3.2.] A cell's particles make one polymer, of their weight and at their weighted mean; its share of the new particles is
placed around it by consecutive points of one low-discrepancy set. How cells are cut, how many particles each gets and how these
are displaced are three choices. All of it happens in the chart about the cloud's mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter import belief
from pfbench.filter.belief import Cloud
from pfbench.filter.cells import Grid, Whitened, divide
from pfbench.filter.gaussian_particles import no_past
from pfbench.filter.points import Halton, Points
from pfbench.filter.resamplers import Systematic
from pfbench.filter.whitening import whiten
from pfbench.model.base import StateSpaceModel

_EQUAL = 1e-5  # rounding of the effective size of a million equal weights in single precision


class Polymers(NamedTuple):
    """A cloud by its cells; of the N places for cells those without particles weigh nothing.

    Attributes:
        weight: W [R, N], the sum of a cell's weights.
        centre: weighted mean of its particles, as a difference from the cloud's mean [R, N, d].
        within: covariance inside cells, pooled [R, d, d]; that of the cloud is the centres' plus this.
        covariance: of the cloud [R, d, d].
    """

    weight: Tensor
    centre: Tensor
    within: Tensor
    covariance: Tensor


class Counts(Protocol):
    """Cells' shares of the resampling probability [R, N], each slot's cell and whether it holds a particle [R, N], the number
    n [R, 1] wanted.

    Returns: the cell of each slot of the new cloud [R, N], non-decreasing; the chance that a cell gets any [R, N]; which slots
    are taken [R or 1, N].
    """

    def __call__(
        self, share: Tensor, cell: Tensor, alive: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Tensor, Tensor, Tensor]: ...


class Displacement(Protocol):
    """Polymers and the cell of each slot [R, N] -> differences from the mean [R, N, d], and whether there are any [R]."""

    def __call__(self, polymers: Polymers, slot: Tensor, draws: Draws) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Proportional:
    """n W particles for a cell, rounded systematically: this selects, as any resampling does. [ours]"""

    def __call__(
        self, share: Tensor, cell: Tensor, alive: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Tensor, Tensor, Tensor]:
        chance = (n * share).clamp(torch.finfo(share.dtype).tiny, 1.0)
        slots = torch.arange(share.shape[1], device=share.device)
        return Systematic()(share, n, draws), chance, slots < n


@dataclass(frozen=True)
class Kept:
    """As many particles as the cell had, as printed: nothing is selected.

    Where another number is wanted than there are particles, or some have become impossible, cells share it in proportion to what
    they had [ours].
    """

    def __call__(
        self, share: Tensor, cell: Tensor, alive: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Tensor, Tensor, Tensor]:
        had = torch.zeros_like(share).scatter_add(1, cell, alive.to(share))
        return Proportional()(had / had.sum(1, keepdim=True), cell, alive, n, draws)


@dataclass(frozen=True)
class Pooled:
    """Normal about the polymer with the covariance inside cells, pooled: mean and covariance of the cloud are kept. [ours]

    Args:
        points: where the d normal coordinates come from.
    """

    points: Points = field(default_factory=Halton)

    def __call__(self, polymers: Polymers, slot: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        root, ok = factor(polymers.within)
        z = self.points(draws).normal("polymer", slot.shape[1], root.shape[-1])
        return _rows(polymers.centre, slot) + z @ root.mT, ok


@dataclass(frozen=True)
class Stretched:
    """The first particle of a cell is the polymer itself, the others lie at c + c o u, u uniform on [low, 1) in each component,
    c the polymer's difference from the mean [Pu and Qin, eq. 18].

    Args:
        low: 0 as printed: every particle moves away from the mean. -1 centres the move. [ours]
        whitened: component-wise in whitened axes instead of the state's. [ours]
        matched: divided by sqrt(E (1 + u)^2), so that second moments are kept. [ours]
        points: where u comes from.
    """

    low: float = 0.0
    whitened: bool = False
    matched: bool = False
    points: Points = field(default_factory=Halton)

    def __post_init__(self) -> None:
        if not -1.0 <= self.low < 1.0:
            raise ValueError(f"resampler.displacement.low={self.low}: give 0 (as printed), -1 (centred), or a number between")

    def __call__(self, polymers: Polymers, slot: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        centre = _rows(polymers.centre, slot)
        ok = torch.isfinite(polymers.weight.sum(1))
        polymer = torch.nn.functional.pad(slot[:, 1:] != slot[:, :-1], (1, 0), value=True)
        nth = ((~polymer).cumsum(1) - 1).clamp(min=0)  # polymers use up no point of the set
        u = _rows(self.points(draws).uniform("polymer", slot.shape[1], centre.shape[-1]).to(centre), nth)
        stretch = (1.0 + self.low + (1.0 - self.low) * u) / (self._growth if self.matched else 1.0)
        stretch = torch.where(polymer.unsqueeze(-1), 1.0, stretch)
        if not self.whitened:
            return centre * stretch, ok
        root, ok = factor(polymers.covariance)
        return (whiten(centre, root) * stretch) @ root.mT, ok

    @property
    def _growth(self) -> float:
        """sqrt(E (1 + u)^2)"""
        return float((1.0 + 0.5 * (1.0 + self.low)) ** 2 + (1.0 - self.low) ** 2 / 12.0) ** 0.5


@dataclass(frozen=True)
class Polymerised:
    """Aggregation of the particles of each cell, and new ones around the polymers.

    A new particle of a cell with n_i of them weighs W_i / n_i [Pu and Qin, eq. 19], over the chance that the cell gets any: cells
    of less than one particle's weight would be lost otherwise, and the cloud's tails with them [ours]. The cell's mass is then
    right on average, and exactly so where it is large. Within cells the move presumes a shape, hence this is not exact; with the
    defaults mean and covariance are kept on average.

    Args:
        grid, counts, displacement: the defaults are the repaired method. [ours]
        axes: components of a difference that the grid divides; None takes the first two of the group `position`, else the first
            two of the state (the first, where there is but one). [ours]
        threshold: polymerise the runs with ESS < threshold n; 1 as published: always, but for a cloud of equal weights in the
            number wanted, such as the initial one, which no measurement has touched.

    Raises:
        ValueError: a threshold outside [0, 1]; axes that repeat; on the first use, axes that the model does not have, or
            particles with a past.
    """

    grid: Grid = field(default_factory=Whitened)
    counts: Counts = field(default_factory=Proportional)
    displacement: Displacement = field(default_factory=Pooled)
    axes: Sequence[int] | None = None
    threshold: float = 1.0
    exact = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"resampler.threshold={self.threshold}: give a ratio of ESS to N between 0 (never) and 1 (always)")
        if self.axes is not None and (not self.axes or len(set(self.axes)) < len(self.axes) or min(self.axes) < 0):
            raise ValueError(f"resampler.axes={list(self.axes)}: give different numbers of components, from 0")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        no_past(cloud, "polymerisation")
        w = belief.weights(cloud.log_w)
        a = w if log_a is cloud.log_w else belief.weights(log_a)
        mean = model.chart.mean(cloud.x, w)
        d = model.chart.subtract(cloud.x, mean.unsqueeze(1))
        covariance = (w.unsqueeze(-1) * d).mT @ d
        plane = list(self._plane(model))
        alive = torch.isfinite(cloud.log_w)
        cell = divide(self.grid, d[..., plane], alive, covariance[:, plane][:, :, plane])
        polymers = aggregate(cell, w, d, covariance)
        share = torch.zeros_like(a).scatter_add(1, cell, a)
        slot, chance, taken = self.counts(share, cell, alive, n, draws)
        moved, ok = self.displacement(polymers, slot, draws)
        log_w = torch.where(taken & ok.unsqueeze(-1), _log_weights(_log_sums(cell, cloud.log_w), chance, slot, taken), -torch.inf)
        fresh = cloud._replace(x=model.chart.add(mean.unsqueeze(1), moved), log_w=log_w)
        wanted = n.squeeze(1)
        hit = 1.0 / a.square().sum(-1) < self.threshold * (1.0 - _EQUAL) * wanted
        if self.threshold == 1.0:
            hit = hit | ((w > 0).sum(1) != wanted)
        return belief.where(hit, fresh, cloud), hit

    def _plane(self, model: StateSpaceModel) -> Sequence[int]:
        d = model.chart.dimension
        if self.axes is None:
            return model.groups.get("position", tuple(range(d)))[:2]
        if max(self.axes) >= d:
            raise ValueError(f"resampler.axes={list(self.axes)}: {type(model).__name__} has components 0 to {d - 1}")
        return self.axes


def aggregate(cell: Tensor, w: Tensor, d: Tensor, covariance: Tensor) -> Polymers:
    """Polymers of particles with weights w [R, N] at differences d [R, N, d] from their mean.

    A cell whose particles weigh nothing has its polymer at their plain mean.
    """
    zero = torch.zeros_like(w)
    weight = zero.scatter_add(1, cell, w)
    v = torch.where(weight.gather(1, cell) > 0.0, w, 1.0)
    index = cell.unsqueeze(1).expand(-1, d.shape[-1], -1)
    total = torch.zeros_like(d.mT).scatter_add(2, index, (v.unsqueeze(-1) * d).mT).mT
    over = zero.scatter_add(1, cell, v)
    centre = total / torch.where(over > 0.0, over, 1.0).unsqueeze(-1)
    r = d - _rows(centre, cell)
    return Polymers(weight, centre, (w.unsqueeze(-1) * r).mT @ r, covariance)


def _log_sums(cell: Tensor, log_w: Tensor) -> Tensor:
    """log W of each cell [R, N], of cells too whose W is too small for a number."""
    most = torch.full_like(log_w, -torch.inf).scatter_reduce(1, cell, log_w, "amax")
    most = torch.where(torch.isfinite(most), most, 0.0)
    parts = torch.exp(log_w - most.gather(1, cell))
    return torch.zeros_like(log_w).scatter_add(1, cell, parts).log() + most


def _log_weights(log_weight: Tensor, chance: Tensor, slot: Tensor, taken: Tensor) -> Tensor:
    """log W_i / (n_i chance_i) of each slot's cell i [R, N]."""
    count = torch.zeros_like(log_weight).scatter_add(1, slot, taken.to(log_weight).expand_as(log_weight))
    return (log_weight - chance.log()).gather(1, slot) - count.gather(1, slot).log()


def _rows(a: Tensor, index: Tensor) -> Tensor:
    """a [R, M, d] by index [R, N] -> [R, N, d]."""
    return a.gather(1, index.unsqueeze(-1).expand(-1, -1, a.shape[-1]))
