"""Records, runs and comparisons of filters whose steps are compiled."""

import shutil
from typing import Any

import pytest
import torch

from pfbench.core import PhiloxStream, Record
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.kernels import dispatch
from pfbench.model.base import StateSpaceModel
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation

RUNS, STEPS = 4, 12
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no C++ compiler"
)


def record_of(model: StateSpaceModel) -> Record:
    """A record with a component missing at times, in some runs."""
    record = ModelSimulation(model, STEPS).draw(NominalNoise(), torch.arange(RUNS), 1).record
    record.y[1, 4] = record.y[3, 7:9] = torch.nan
    return record


def run(
    method: Any, model: StateSpaceModel, record: Record, at_once: int | None = None
) -> FilterResult:
    with dispatch.use_kernels(), torch.no_grad():
        return run_filter(
            method, model, record, PhiloxStream(1, torch.arange(RUNS)), run_batch=at_once
        )


def agree(one: FilterResult, other: FilterResult) -> None:
    """Every number of two estimates, to rounding."""
    for name in ("mean", "variance", "log_evidence"):
        torch.testing.assert_close(
            getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9, equal_nan=True
        )
    assert one.trace.keys() == other.trace.keys()
    for name, value in one.trace.items():
        torch.testing.assert_close(value.double(), other.trace[name].double(), rtol=1e-9, atol=1e-9)
