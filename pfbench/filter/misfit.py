"""Distance of estimates from the raw measurements, for the health of runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from pfbench.core.record import Record, map_inputs
from pfbench.filter.particle.particle_moments import compute_nis
from pfbench.model.base import ModelWrapper, StateSpaceModel


@contextmanager
def uncounted_observation(model: StateSpaceModel) -> Iterator[None]:
    """Evaluate `observation` by the method of the class.

    A counter of likelihood evaluations replaces that of the object. Checks are not charged to the
    filter.

    Args:
        model: State-space model.
    """
    inner = model
    while isinstance(inner, ModelWrapper):
        inner = inner.model
    counted = inner.__dict__.pop("observation", None)
    try:
        yield
    finally:
        if counted is not None:
            inner.__dict__["observation"] = counted


def compute_misfit(model: StateSpaceModel, record: Record, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the NIS of estimates under the measurement noise alone.

    Args:
        model: State-space model of the step.
        record: Prepared record of the step.
        mean: Estimates, [R, D].

    Returns:
        NIS and the number of observed components, [R] each.
    """
    with uncounted_observation(model):
        return compute_nis(model, mean.unsqueeze(1), torch.zeros_like(mean[:, :1]), record)


def compute_misfits(
    model: StateSpaceModel, record: Record, mean: Tensor, steps: list[int]
) -> tuple[Tensor, Tensor]:
    """Compute `compute_misfit` in several steps.

    Args:
        model: State-space model; `at_step` gives the model of a step.
        record: Prepared record of all steps.
        mean: Estimates, [R, T, D].
        steps: Numbers of C steps.

    Returns:
        NIS and the number of observed components, [C, R] each.
    """
    if len(mean) == 1 and all(model.at_step(t) is model for t in steps):
        # the steps of a single run as runs: ten calls would take a third of a small filter's time
        u = map_inputs(lambda a: a[0, steps], record.u)
        misfit, observed = compute_misfit(model, Record(record.y[0, steps], u), mean[0, steps])
        return misfit.unsqueeze(1), observed.unsqueeze(1)
    results = [compute_misfit(model.at_step(t), record.at_step(t), mean[:, t]) for t in steps]
    misfits, observed_counts = zip(*results, strict=True)
    return torch.stack(misfits), torch.stack(observed_counts)
