"""Batches of runs, which a filter takes together."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pfbench.core.random_stream import BatchRandomStream, RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import StepInfo

_BATCH_NUMBERS = 600_000  # numbers (runs x particles x components) of a batch of runs


def choose_run_batch(runs: int, particles: int, dimension: int) -> int:
    """Choose how many runs a step takes together on the CPU.

    Batches have about equal sizes of some 600 000 numbers, so memory depends on the size of a batch
    and not on the number of runs. Smaller batches stay in the cache of a core, but below some 100 000
    numbers the overhead of single operations dominates. [Measured with other processes on the shared
    cache. Growth model, 10 000 particles, 100 runs, float64: batches of 100, 50, 20, 10 runs took
    4.1, 3.1, 3.0, 3.2 s, in float32 2.2, 2.3, 2.3, 2.5 s. 15-state INS, 500 particles, float64: 100 and
    50 runs took 2.0 and 2.4 s.]

    Returns runs per batch.
    """
    return -(-runs // max(1, round(runs * particles * dimension / _BATCH_NUMBERS)))


def split_runs(
    record: Record, draws: BatchRandomStream, run_batch: int | None
) -> list[tuple[Record, RandomStream]]:
    """Split a record and its random stream into batches of runs.

    Returns Record and random stream of each batch.
    """
    runs = len(record.y)
    if run_batch is None or run_batch >= runs:
        return [(record, draws)]
    batches = [slice(first, first + run_batch) for first in range(0, runs, run_batch)]
    return [(record.select_runs(batch), draws.select_runs(batch)) for batch in batches]


def join_runs(batches: list[Tensor]) -> Tensor:
    """Concatenate batches of runs; return a single batch unchanged."""
    return batches[0] if len(batches) == 1 else torch.cat(batches)


def join_infos(infos: list[StepInfo]) -> StepInfo:
    """Join the infos of batches of runs."""
    if len(infos) == 1:
        return infos[0]
    mean, variance = (
        join_runs([getattr(info, name) for info in infos]) for name in ("mean", "variance")
    )
    trace = {name: join_runs([info.trace[name] for info in infos]) for name in infos[0].trace}

    def join_pairs(name: str) -> Callable[[], tuple[Tensor, Tensor]] | None:
        functions = [getattr(info, name) for info in infos if getattr(info, name) is not None]

        def evaluate() -> tuple[Tensor, Tensor]:
            first, second = zip(*(function() for function in functions), strict=True)
            return torch.cat(first), torch.cat(second)

        return evaluate if functions else None

    def covariance() -> Tensor:
        return torch.cat([info.covariance() for info in infos])

    def group_covariance(groups: Tensor) -> Tensor:
        return torch.cat([info.covariance_of(groups) for info in infos])

    return StepInfo(
        mean, variance, covariance, trace, join_pairs("cloud"), join_pairs("nis"), group_covariance,
        infos[0].has_covariance,
    )  # fmt: skip
