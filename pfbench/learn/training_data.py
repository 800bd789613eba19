"""Training data: records under several noise regimes, with true states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.record import Record, map_inputs
from pfbench.model.base import StateSpaceModel
from pfbench.noise.base import NoiseRegime
from pfbench.scenario.base import Scenario


class TrainingData(NamedTuple):
    """Records to train on, prepared for the model, with true states.

    Attributes:
        record: Measurements and inputs of R runs, T steps.
        states: True states, [R, T, D]; NaN where unknown.
        parents: Previous true states of simulated data, [R, T, D]; None for other data.
        noises: Driving noise of simulated data, [R, T, W]; None for other data.
    """

    record: Record
    states: Tensor
    parents: Tensor | None = None
    noises: Tensor | None = None

    def select_runs(self, rows: Tensor) -> TrainingData:
        """Return the runs with these indices."""

        def select(a: Tensor) -> Tensor:
            return a[rows] if len(a) > 1 else a

        record = self.record
        start, spread, parents, noises = (
            None if a is None else a[rows]
            for a in (record.start, record.spread, self.parents, self.noises)
        )
        selected = Record(record.y[rows], map_inputs(select, record.u), start, spread)
        return TrainingData(selected, self.states[rows], parents, noises)


def draw_training_data(
    scenario: Scenario,
    regimes: Sequence[NoiseRegime],
    model: StateSpaceModel,
    runs: int,
    seed: int,
    steps: int | None,
) -> TrainingData:
    """Draw training data of several noise regimes.

    Args:
        scenario: Scenario that draws the episodes.
        regimes: Noise regimes.
        model: Model that prepares the records; its dtype and device are used.
        runs: Runs of each regime; run numbers continue from regime to regime.
        seed: Seed.
        steps: Number of steps of each record to use. None for all.

    Returns:
        Training data of all regimes in turn.

    Raises:
        ValueError: If the filter's estimates change the data (closed loop).
    """
    records, states = [], []
    for i, regime in enumerate(regimes):
        episode = scenario.draw(regime, torch.arange(i * runs, (i + 1) * runs), seed)
        require(
            episode.record.feedback is None,
            "scenario.closed_loop",
            "be false for training",
            "true",
            "A closed loop depends on the filter. Set scenario.closed_loop=false.",
        )
        converted = episode.record.to(model.anchor)
        record = model.prepare(episode.record).to(model.anchor)
        record = record._replace(start=converted.start, spread=converted.spread)
        last = record.y.shape[1] if steps is None else steps
        u = map_inputs(lambda a, n=last: a[:, :n], record.u)
        records.append(record._replace(y=record.y[:, :last], u=u))
        states.append(model.assemble(episode.truth).to(model.anchor)[:, :last])
    return TrainingData(_concatenated(records), torch.cat(states))


def _concatenated(records: list[Record]) -> Record:
    """Concatenate records along the runs."""
    first = records[0]
    if len(records) == 1:
        return first

    def leaves(u: Any) -> list[Tensor]:
        tensors: list[Tensor] = []
        map_inputs(tensors.append, u)
        return tensors

    runs = len(first.y)
    columns = zip(*(leaves(record.u) for record in records), strict=True)
    joined = iter([torch.cat([a.expand(runs, *a.shape[1:]) for a in column]) for column in columns])
    start, spread = (
        None
        if getattr(first, name) is None
        else torch.cat([getattr(record, name) for record in records])
        for name in ("start", "spread")
    )
    y = torch.cat([record.y for record in records])
    return Record(y, map_inputs(lambda _: next(joined), first.u), start, spread)
