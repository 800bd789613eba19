"""Memory of a job before it starts, and the number of runs that fit at a time.

The estimate comes from a trial. The filter runs over a few steps of one and of two runs with few
particles, and the bytes of all live tensors are counted. The result is extrapolated to all
particles and runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record, map_inputs
from pfbench.filter.loop import Watch, run_filter
from pfbench.job.system_memory import GIB, MIB, AllocationCounter
from pfbench.model.base import StateSpaceModel

_BASE = 256.0 * MIB  # libraries and compiled code
_TRIAL_STEPS = 8
_TRIAL_PARTICLES = 64  # also twice and four times as many
_SIMULATION_FACTOR = 4  # bytes while simulating per byte of episode: sensors are faster [ours]
_TRACE_COPIES = 3  # of each step's output: the steps, one tensor of all, single precision [ours]
_OVERHEAD = 2.0  # resident bytes per byte of live tensors, for workspace and holes [1.5 to 2.3]
_MAX_EPISODE = 30e6  # bytes per run, above those of all scenarios in conf/


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes of a job.

    Attributes:
        base: Bytes that do not depend on the number of runs.
        run: Bytes of each run at work: its episode, particles and output.
        stepped: Bytes of each run that is stepped together with others.
        result: Bytes of the results of each finished run.
        episode: Bytes of the drawn episode of each run.
        run_batch: Maps a number of runs to the number that is stepped together.
    """

    base: float
    run: float
    stepped: float
    result: float
    episode: float
    run_batch: Callable[[int], int]

    def peak(self, runs: int, total: int | None = None, is_whole: bool = False) -> float:
        """Compute the peak while `runs` of `total` runs are at work.

        Args:
            runs: Runs at work.
            total: All runs of the job. Default: `runs`.
            is_whole: Whether the episodes of the waiting runs are in memory, too.

        Returns:
            The peak in bytes.
        """
        waiting = (total or runs) - runs
        idle = waiting * (self.result + (self.episode if is_whole else 0.0))
        return self.base + runs * self.run + self.run_batch(runs) * self.stepped + idle


def runs_within_limit(
    estimate: MemoryEstimate, runs: int, limit: float, is_whole: bool = False
) -> int:
    """Determine the runs that fit at a time, in batches of about equal size.

    Args:
        estimate: Bytes of the job.
        runs: Runs of the job.
        limit: Bytes that the job may use.
        is_whole: Whether the episodes of all runs are in memory.

    Returns:
        Runs per batch, at most all.

    Raises:
        ValueError: If a single run does not fit.
    """
    if estimate.peak(1, runs, is_whole) > limit:
        if estimate.peak(1) > limit:
            workload, remedy = "a single run", "Use fewer particles or dtype=float32"
        else:
            workload = f"the results of {runs} runs"
            remedy = f"Split the job (runs={runs // 2}, then first_run={runs // 2})"
        size = estimate.peak(1, runs, is_whole) / GIB
        raise ValueError(
            f"memory must be at least {size:.3g} GiB for {workload}, got {limit / GIB:.3g} GiB. "
            f"{remedy}, or set memory_limit_gib=... (GiB) if more is free."
        )
    low, high = 1, runs
    while low < high:
        middle = (low + high + 1) // 2
        fits = estimate.peak(middle, runs, is_whole) <= limit
        low, high = (middle, high) if fits else (low, middle - 1)
    batches = -(-runs // low)
    return -(-runs // batches)


def fits_undrawn(runs: int, limit: float | None) -> bool:
    """Return whether the undrawn episodes of all runs of any scenario fit.

    Args:
        runs: Runs of the job.
        limit: Bytes that the job may use. None if unknown.
    """
    return limit is None or _BASE + runs * _MAX_EPISODE <= limit


def fits_drawn(estimate: MemoryEstimate, runs: int, limit: float) -> bool:
    """Return whether the episodes of all runs fit while they are drawn together.

    Args:
        estimate: Bytes of the job.
        runs: Runs of the job.
        limit: Bytes that the job may use.
    """
    return _BASE + runs * _SIMULATION_FACTOR * estimate.episode <= limit


def needs_memory_trial(method: Any, model: StateSpaceModel, runs: int, limit: float) -> bool:
    """Return whether a job may exceed the limit.

    Most jobs are small enough to skip the trial.

    Args:
        method: Filter.
        model: Model of the filter.
        runs: Runs of the job.
        limit: Bytes that the job may use.
    """
    d = model.chart.dimension
    return runs * (_MAX_EPISODE + 40.0 * _particles(method) * d * (d + 10)) > limit


def estimate_memory(
    method: Any,
    model: StateSpaceModel,
    episode: Episode,
    run_batch: Callable[[int], int],
    watch: Callable[[int, int], Watch | None] | None = None,
) -> MemoryEstimate:
    """Estimate the bytes of a job by a trial.

    Args:
        method: Filter.
        model: Model of the filter, on the device and in the precision of the job.
        episode: Episode of two runs of the job, or of its only run.
        run_batch: Maps a number of runs to the number that is stepped together.
        watch: Maps (runs, steps) to the `watch` of `run_filter` over these runs and steps.

    Returns:
        The estimate.
    """
    record = model.prepare(episode.record)
    runs, steps = record.y.shape[:2]
    simulated = [*tree_leaves(tuple(episode.record[:4])), *episode.truth.values(), episode.track]
    prepared = tree_leaves(tuple(record[:4]))
    n, trial_steps = _particles(method), min(_TRIAL_STEPS, steps)
    sizes = [n] if n <= 4 * _TRIAL_PARTICLES else [_TRIAL_PARTICLES * k for k in (1, 2, 4)]
    rows, output, single_output = [], 0.0, 0.0
    for size in sizes:
        small = method if n == size else replace(method, particles=size)
        single, joint, separate = (
            _measure(
                small,
                model,
                first_steps(record.select_runs(slice(0, r)), trial_steps),
                batch,
                watch,
            )
            for r, batch in ((1, 1), (min(2, runs), 2), (min(2, runs), 1))
        )
        # all bytes, those of each run in a step, those of each run outside of it
        rows.append((single[0], joint[0] - separate[0], separate[0] - single[0]))
        output, single_output = single[1] / trial_steps, single[2] / trial_steps
    columns = zip(*rows, strict=True)
    total, stepped, waiting = (_OVERHEAD * _extrapolate(sizes, column, n) for column in columns)
    if runs == 1:
        waiting = total
    episode_bytes = _run_bytes(simulated, runs)
    simulation = _SIMULATION_FACTOR * episode_bytes + 2 * _run_bytes(prepared, runs)
    return MemoryEstimate(
        base=_BASE + max(0.0, total - stepped - waiting),
        run=max(0.0, waiting) + simulation + _TRACE_COPIES * output * steps,
        stepped=max(0.0, stepped),
        result=single_output * steps,
        episode=episode_bytes,
        run_batch=run_batch if record.feedback is None else int,
    )


def first_steps(record: Record, steps: int) -> Record:
    """Copy the first steps of a record.

    Args:
        record: Measurements and inputs.
        steps: Number of steps.

    Returns:
        The copy, without a feedback process.
    """
    start, spread = (None if a is None else a.clone() for a in (record.start, record.spread))
    u = map_inputs(lambda a: a[:, :steps].clone(), record.u)
    return Record(record.y[:, :steps].clone(), u, start, spread)


def _measure(
    method: Any, model: StateSpaceModel, record: Record, run_batch: int, watch: Any
) -> tuple[int, float, float]:
    """Measure the bytes at the peak, of the output, and of a single-precision output."""
    runs, steps = record.y.shape[:2]
    draws = PhiloxStream(0, torch.arange(runs, device=model.anchor.device), model.anchor.dtype)
    recorder = watch(runs, steps) if watch else None
    with torch.no_grad(), AllocationCounter() as counter:
        estimate = run_filter(method, model, record, draws, recorder, run_batch=run_batch)
    leaves = tree_leaves((estimate.mean, estimate.variance, estimate.trace))
    output: list[Tensor] = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    single = sum(leaf.numel() * min(4, leaf.element_size()) for leaf in output)
    return counter.peak, sum(leaf.nbytes for leaf in output), single


def _run_bytes(leaves: Sequence[Any], runs: int) -> float:
    """Count the bytes per run. Tensors that the runs share are not counted."""
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor) and leaf.dim() > 0]
    return sum(a.numel() * a.element_size() for a in tensors if a.shape[0] == runs) / runs


def _particles(method: Any) -> int:
    """Return the number of particles, 0 for a filter without particles."""
    has_particles = "particles" in {field.name for field in fields(method)}
    return int(method.particles) if has_particles else 0


def _extrapolate(sizes: Sequence[int], values: Sequence[float], n: int) -> float:
    """Extend the parabola through values at sizes a, 2a and 4a to n. It never falls."""
    if len(sizes) == 1:
        return float(values[0])
    a = sizes[0]
    slope, later = (values[1] - values[0]) / a, (values[2] - values[1]) / (2 * a)
    bend = max(0.0, (later - slope) / (3 * a))
    if bend * n * n < 0.05 * abs(later) * n:  # rounding of the allocator
        bend = 0.0
    return float(values[2] + max(0.0, later) * (n - 4 * a) + bend * (n - 4 * a) * (n - 2 * a))
