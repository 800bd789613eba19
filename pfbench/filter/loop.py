"""The only time loop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from pfbench.draws import Draws, Source
from pfbench.filter.belief import Cloud, Filter, Gaussian, Info
from pfbench.filter.rules import Jacobian, Space
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record, Underway

_NUMBERS = 1_000_000  # of a block's particles

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


@runtime_checkable
class Walker(Protocol):
    """A filter that may take several steps of a record together."""

    def walk(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: Draws
    ) -> Iterator[tuple[Cloud | Gaussian, Info]]:
        """The belief after each step of a record, and what the step tells; step t = 1, 2, ... has its draws at t."""


def run_filter(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: Source,
    watch: Watch | None = None,
    tick: Callable[[], object] | None = None,
    at_once: int | None = None,
) -> Estimate:
    """Runs a filter over a record, all runs as one batch.

    Args:
        method: the filter's recipe.
        model: what the filter believes.
        record: measurements [R, T, Dy] and inputs.
        draws: the filter's randomness; step 0 is the initial law, step t the t-th measurement.
        watch: (t, info) -> {name: [R] or [R, ...]}, for what needs more than mean and variance; it cannot influence the filter.
        tick: called after each step (a progress bar).
        at_once: runs that a step takes together, one such block after the other; None takes all. The estimate is the same, but
            for rounding; see `runs_at_once`. A world that is corrected is stepped as a whole.

    Raises:
        ValueError: an empty record, or one with infinities; a world to be corrected by a model or filter that cannot.
    """
    if record.y.shape[1] == 0:
        raise ValueError("record: no measurements; give at least one time step")
    if bool(torch.isinf(record.y).any()):
        raise ValueError("record.y holds infinite values: mark a missing component as NaN")
    started = record.to(model.anchor)
    closed = None if record.loop is None else record.loop.begin(record, _correctable(model))
    record = model.prepare(record).to(model.anchor)._replace(start=started.start, spread=started.spread)
    runs = record.y.shape[0]
    size = runs if at_once is None or closed is not None else at_once
    blocks = [slice(first, first + size) for first in range(0, runs, size)]
    parts = [(record.of(block), draws.of(block)) for block in blocks] if len(blocks) > 1 else [(record, draws)]
    means, variances, evidences, traces = [], [], [], []
    for t, found in enumerate(zip(*(_walk(method, model, part, own, closed) for part, own in parts), strict=True)):
        info = _joined([info for _, info in found])
        means.append(info.mean)
        variances.append(info.variance)
        evidences.append(found[0][0].log_z if len(found) == 1 else torch.cat([belief.log_z for belief, _ in found]))
        traces.append(info.trace | (watch(t, info) if watch else {}))
        if tick:
            tick()
    trace = {name: torch.stack([step[name] for step in traces], 1) for name in traces[0]}
    alive = torch.isfinite(torch.stack(evidences, 1)).unsqueeze(-1)
    mean, variance = (torch.where(alive, torch.stack(parts, 1), torch.nan) for parts in (means, variances))
    return Estimate(mean, variance, evidences[-1], trace)


def _walk(
    method: Filter, model: StateSpaceModel, record: Record, draws: Draws, closed: Underway | None
) -> Iterator[tuple[Cloud | Gaussian, Info]]:
    """The belief after each step, and what the step tells."""
    belief: Any = method.init(model, len(record.y), draws.at(0), record.start, record.spread)
    if closed is None and isinstance(method, Walker):
        yield from method.walk(model, belief, record, draws)
        return
    for t in range(record.y.shape[1]):
        seen = record.at(t) if closed is None else model.prepare(closed.at(t)).to(model.anchor).at(0)
        belief, info = method.step(stage(model, t), belief, seen, draws.at(t + 1))
        if closed is not None:
            belief, info = fed_back(model, closed, belief, info)
        yield belief, info


def stage(model: StateSpaceModel, t: int) -> StateSpaceModel:
    """What a step believes before which there were t others."""
    return AtRest(model) if t == 0 and model.observes_initial else model


def runs_at_once(runs: int, particles: int, dimension: int) -> int:
    """How many runs a step should take together on the CPU: blocks of about equal size and of a million numbers each.

    A step's memory then depends on the size of a block and no longer on the number of runs. Smaller blocks would stay in the
    cache of a core, but below some hundred thousand numbers single operations cost more than what they work on [measured on a
    15-state INS with 500 particles: alone on the machine 100 runs together were a tenth faster than 50, beside others who use
    the shared cache a third slower].
    """
    return -(-runs // max(1, round(runs * particles * dimension / _NUMBERS)))


def _joined(infos: list[Info]) -> Info:
    """What the blocks of runs tell, as one."""
    if len(infos) == 1:
        return infos[0]
    mean, variance = (torch.cat([getattr(info, name) for info in infos]) for name in ("mean", "variance"))
    trace = {name: torch.cat([info.trace[name] for info in infos]) for name in infos[0].trace}
    clouds = [info.cloud for info in infos if info.cloud is not None]

    def cloud() -> tuple[Tensor, Tensor]:
        deviations, log_w = zip(*(part() for part in clouds), strict=True)
        return torch.cat(deviations), torch.cat(log_w)

    surprises = [info.nis for info in infos if info.nis is not None]

    def nis() -> tuple[Tensor, Tensor]:
        lengths, counts = zip(*(part() for part in surprises), strict=True)
        return torch.cat(lengths), torch.cat(counts)

    def covariance() -> Tensor:
        return torch.cat([info.covariance() for info in infos])

    def some(groups: Tensor) -> Tensor:
        return torch.cat([info.covariance_of(groups) for info in infos])

    return Info(mean, variance, covariance, trace, cloud if clouds else None, nis if surprises else None, some)


def fed_back(
    model: StateSpaceModel, closed: Underway, belief: Cloud | Gaussian, info: Info
) -> tuple[Cloud | Gaussian, Info]:
    """The world corrected by the estimate, of the runs that are alive, and the belief about what is then left.

    A Gaussian moves by its mean and, since a rotation of the axes turns its spread, by the derivative there [ours].

    Raises:
        ValueError: a cloud that carries its past, which a corrected world has left behind.
    """
    alive = torch.isfinite(belief.log_z).unsqueeze(-1)
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
