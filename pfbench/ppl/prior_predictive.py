"""Simulation of measurements from a model, for prior predictive draws."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_initial_state, draw_measurements, simulate_steps
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.arguments import check_counts, check_kinds


def simulate(model: StateSpaceModel, record: Record, seed: int) -> tuple[Record, Tensor]:
    """Simulate measurements of a model with the runs and inputs of a record.

    With a model whose parameters come from the prior these are draws from the prior predictive
    distribution. The random numbers are those of the scenario `ModelSimulation`. Run i does not
    depend on the number of runs.

    Args:
        model: State-space model.
        record: Template: shape, inputs, start, spread and missing components are kept.
        seed: Seed.

    Returns:
        Record with simulated measurements, and the states, [R, T, D].

    Raises:
        ValueError: If an argument is of another class, or the seed is negative.
    """
    check_kinds("simulate", {"model": (model, StateSpaceModel), "record": (record, Record)})
    check_counts("simulate", {"seed": (seed, 0)})
    stream = PhiloxStream(seed, torch.arange(len(record.y)), model.anchor.dtype)
    converted = record.to(model.anchor)
    with torch.no_grad():
        inputs = model.prepare(converted).to(model.anchor)
        initial = initial_law(model, len(record.y), converted.spread)
        x = draw_initial_state(model, initial, stream, "world.state", start=converted.start)
        steps = list(simulate_steps(model, inputs, stream, x, "world.state"))
        y = draw_measurements([s.distribution for s in steps], stream, "world.receiver")
    y = torch.where(torch.isnan(record.y), torch.nan, y.to(record.y))
    return record._replace(y=y), torch.cat([step.x for step in steps], 1)
