"""Filters of the registry by name, their runs on one record, and averages of these runs with standard errors."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import Filter, FilterResult, run_filter
from pfbench.job import compose, instantiate

_PART = 50  # runs at once


def read_data(name: str) -> Tensor:
    """Read a table of this folder, [rows, columns]."""
    file = Path(__file__).with_name(name)
    return torch.from_numpy(np.loadtxt(file, delimiter=",", ndmin=2))


@functools.cache
def build_filter(name: str, particles: int = 500, *words: str) -> Filter:
    """Build a filter of the registry, with other settings as words of the command line."""
    config = compose([f"filter={name}", f"particles={particles}", *words])
    method: Filter = instantiate(config.values["filter"])
    return method


def run_many(method: Filter, model: Any, y: Tensor, runs: int = 1, seed: int = 1) -> FilterResult:
    """Run a filter several times on one record, y [T, Dy], in parts; only means, variances and evidence are joined."""
    parts = []
    for first in range(0, runs, _PART):
        numbers = torch.arange(first, min(first + _PART, runs))
        record = Record(y.expand(len(numbers), -1, -1))
        with torch.no_grad():
            parts.append(run_filter(method, model, record, PhiloxStream(seed, numbers)))
    joined = {
        key: torch.cat([getattr(part, key) for part in parts])
        for key in ("mean", "variance", "log_evidence")
    }
    return parts[0]._replace(**joined)


def average(values: Tensor) -> tuple[float, float]:
    """Return the mean and its standard error."""
    return float(values.mean()), float(values.std()) / len(values) ** 0.5


def spread(values: Tensor) -> tuple[float, float]:
    """Return the standard deviation and its standard error, which follows from the fourth moment."""
    d = values - values.mean()
    sd = float(values.std())
    kurtosis = float((d**4).mean() / (d**2).mean() ** 2)
    return sd, sd * ((kurtosis - 1.0) / (4.0 * len(values))) ** 0.5
