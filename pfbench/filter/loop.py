"""The only time loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Filter, Info
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record

Watch = Callable[[int, Info], dict[str, Tensor]]


class Estimate(NamedTuple):
    """What a filter made of a record.

    Attributes:
        mean: [R, T, D]; NaN from the instant at which a run is lost.
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
        ValueError: an empty record, or one with infinities.
    """
    if record.y.shape[1] == 0:
        raise ValueError("record: no measurements; give at least one time step")
    if bool(torch.isinf(record.y).any()):
        raise ValueError("record.y holds infinite values: mark a missing component as NaN")
    started = record.to(model.anchor)
    record = model.prepare(record).to(model.anchor)
    belief = method.init(model, record.y.shape[0], draws.at(0), started.start, started.spread)
    means, variances, traces = [], [], []
    for t in range(record.y.shape[1]):
        stage = AtRest(model) if t == 0 and model.observes_initial else model
        belief, info = method.step(stage, belief, record.at(t), draws.at(t + 1))
        alive = torch.isfinite(belief.log_z).unsqueeze(-1)
        means.append(torch.where(alive, info.mean, torch.nan))
        variances.append(torch.where(alive, info.variance, torch.nan))
        traces.append(info.trace | (watch(t, info) if watch else {}))
        if tick:
            tick()
    trace = {name: torch.stack([step[name] for step in traces], 1) for name in traces[0]}
    return Estimate(torch.stack(means, 1), torch.stack(variances, 1), belief.log_z, trace)
