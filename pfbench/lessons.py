"""Worlds to learn from: records of a scenario prepared for a model, regimes of noise mixed, the truth beside them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.model.base import StateSpaceModel
from pfbench.noise.regimes import Regime
from pfbench.record import Record, map_inputs
from pfbench.scenario.base import Scenario


class Worlds(NamedTuple):
    """Records to learn from, prepared for the model, and what is true in them.

    Attributes:
        record: R worlds of T steps.
        states: the true states [R, T, D], NaN where not known.
        parents, noises: of imagined worlds [R, T, D], [R, T, W]; else None.
    """

    record: Record
    states: Tensor
    parents: Tensor | None = None
    noises: Tensor | None = None

    def of(self, rows: Tensor) -> Worlds:
        """Some of them."""

        def some(a: Tensor) -> Tensor:
            return a[rows] if len(a) > 1 else a

        record = self.record
        start, spread, parents, noises = (
            None if a is None else a[rows] for a in (record.start, record.spread, self.parents, self.noises)
        )
        return Worlds(Record(record.y[rows], map_inputs(some, record.u), start, spread), self.states[rows], parents, noises)


def draw_worlds(
    scenario: Scenario, regimes: Sequence[Regime], model: StateSpaceModel, runs: int, seed: int, steps: int | None
) -> Worlds:
    """Worlds of all regimes in turn, `runs` of each, with run numbers of their own, in the model's precision and on its device.

    Raises:
        ValueError: a world that filters change.
    """
    records, truths = [], []
    for i, regime in enumerate(regimes):
        episode = scenario.draw(regime, torch.arange(i * runs, (i + 1) * runs), seed)
        if episode.record.loop is not None:
            raise ValueError("train: the filter's estimates change this world; train on the open one (scenario.closed=false)")
        began = episode.record.to(model.anchor)
        record = model.prepare(episode.record).to(model.anchor)._replace(start=began.start, spread=began.spread)
        last = record.y.shape[1] if steps is None else steps
        records.append(record._replace(y=record.y[:, :last], u=map_inputs(lambda a, n=last: a[:, :n], record.u)))
        truths.append(model.assemble(episode.truth).to(model.anchor)[:, :last])
    return Worlds(_together(records), torch.cat(truths))


def _together(records: list[Record]) -> Record:
    """Records one below the other."""
    if len(records) == 1:
        return records[0]

    def leaves(u: Any) -> list[Tensor]:
        found: list[Tensor] = []
        map_inputs(found.append, u)
        return found

    runs = len(records[0].y)
    columns = zip(*(leaves(record.u) for record in records), strict=True)
    joined = iter([torch.cat([a.expand(runs, *a.shape[1:]) for a in column]) for column in columns])
    first = records[0]
    start, spread = (
        None if getattr(first, name) is None else torch.cat([getattr(record, name) for record in records])
        for name in ("start", "spread")
    )
    return Record(torch.cat([record.y for record in records]), map_inputs(lambda _: next(joined), first.u), start, spread)
