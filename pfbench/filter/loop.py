"""The only time loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Filter, Gaussian, Info
from pfbench.filter.rules import Jacobian, Space
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record, Underway

Watch = Callable[[int, Info], dict[str, Tensor]]


class Estimate(NamedTuple):
    """What a filter made of a record.

    Attributes:
        mean: [R, T, D]; NaN from the instant at which a run is lost. Where the record's loop corrects the world, the estimate
            as it would read without any correction.
        variance: diagonal of the covariance in the chart [R, T, d]; NaN likewise.
        log_evidence: log p(y_1:T) [R]; -inf where the run is lost.
        trace: per step and run, {name: [R, T]}: `ess`, `resampled`, and what was watched for.
    """

    mean: Tensor
    variance: Tensor
    log_evidence: Tensor
    trace: dict[str, Tensor]

    @property
    def lost(self) -> Tensor:
        """Runs whose filter failed [R]."""
        return ~torch.isfinite(self.log_evidence)


def run_filter(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: Draws,
    watch: Watch | None = None,
    tick: Callable[[], object] | None = None,
) -> Estimate:
    """Runs a filter over a record, all runs as one batch.

    Args:
        method: the filter's recipe.
        model: what the filter believes.
        record: measurements [R, T, Dy] and inputs.
        draws: the filter's randomness; step 0 is the initial law, step t the t-th measurement.
        watch: (t, info) -> {name: [R] or [R, ...]}, for what needs more than mean and variance; it cannot influence the filter.
        tick: called after each step (a progress bar).

    Raises:
        ValueError: an empty record, or one with infinities; a world to be corrected by a model or filter that cannot.
    """
    if record.y.shape[1] == 0:
        raise ValueError("record: no measurements; give at least one time step")
    if bool(torch.isinf(record.y).any()):
        raise ValueError("record.y holds infinite values: mark a missing component as NaN")
    started = record.to(model.anchor)
    closed = None if record.loop is None else record.loop.begin(record, _correctable(model))
    record = model.prepare(record).to(model.anchor)
    belief = method.init(model, record.y.shape[0], draws.at(0), started.start, started.spread)
    means, variances, traces = [], [], []
    for t in range(record.y.shape[1]):
        stage = AtRest(model) if t == 0 and model.observes_initial else model
        seen = record.at(t) if closed is None else model.prepare(closed.at(t)).to(model.anchor).at(0)
        belief, info = method.step(stage, belief, seen, draws.at(t + 1))
        alive = torch.isfinite(belief.log_z).unsqueeze(-1)
        if closed is not None:
            belief, info = fed_back(model, closed, belief, info, alive)
        means.append(torch.where(alive, info.mean, torch.nan))
        variances.append(torch.where(alive, info.variance, torch.nan))
        traces.append(info.trace | (watch(t, info) if watch else {}))
        if tick:
            tick()
    trace = {name: torch.stack([step[name] for step in traces], 1) for name in traces[0]}
    return Estimate(torch.stack(means, 1), torch.stack(variances, 1), belief.log_z, trace)


def fed_back(
    model: StateSpaceModel, closed: Underway, belief: Cloud | Gaussian, info: Info, alive: Tensor
) -> tuple[Cloud | Gaussian, Info]:
    """The world corrected by the estimate, of the runs that are alive [R, 1], and the belief about what is then left.

    A Gaussian moves by its mean and, since a rotation of the axes turns its spread, by the derivative there [ours].

    Raises:
        ValueError: a cloud that carries its past, which a corrected world has left behind.
    """
    told, left = closed.correct(torch.where(alive, info.mean, 0.0))
    info = info._replace(mean=torch.where(alive, told.to(info.mean), info.mean))
    if isinstance(belief, Cloud):
        if belief.window or belief.memory:
            raise ValueError(
                "filter: its particles carry their past (for moves, or a proposal's memory), which a corrected INS has left "
                "behind; choose a filter without moves and memory, or scenario.closed=false"
            )
        return belief._replace(x=left(belief.x)), info
    chart, centre = model.chart, belief.mean.unsqueeze(1)

    def moved(xi: Tensor) -> tuple[Tensor, Tensor]:
        return left(chart.add(centre, xi)), xi.new_zeros(1, 1, 1, 1)

    mean, slope, *_ = Jacobian()(moved, belief.mean, chart.dimension, Space(chart.subtract, chart.mean))
    return belief._replace(mean=mean, covariance=slope @ belief.covariance @ slope.mT), info


def _correctable(model: StateSpaceModel) -> dict[str, tuple[int, ...]]:
    """Groups of a model whose states are laid out as their differences; none of another."""
    return model.groups if model.chart.size == len(model.names) else {}
