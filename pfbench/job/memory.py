"""Memory of a job before it starts, and the number of runs that fit at a time.

The estimate comes from a trial. The filter runs over a few steps of one and of two runs with few
particles, and the bytes of all live tensors are counted. The result is extrapolated to all
particles and runs.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record, map_inputs
from pfbench.filter.loop import Watch, run_filter
from pfbench.model.base import StateSpaceModel
from pfbench.scenario.oracle_noise import OracleNoiseModel

GIB, MIB = 1 << 30, 1 << 20

_USABLE_SHARE = 0.8  # of free memory: allocators and libraries are not counted [ours]

_CHECK_STEPS = 10  # steps between two queries of the resident memory


def memory_limit(requested: float | None, device: str) -> float | None:
    """Return the bytes that a job may use."""
    if requested is not None:
        return requested * GIB
    free = torch.cuda.mem_get_info(device)[0] if device != "cpu" else available_memory()
    return None if free is None else _USABLE_SHARE * free


def available_memory() -> float | None:
    """Return the free bytes of this machine or control group, or None if unknown."""
    return min([*_machine_memory(), *_group_memory()], default=None)


def start_peak_measurement(device: str) -> int | None:
    """Reset the peak of used memory and return the bytes in use, for `peak_above`."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # freed memory of earlier jobs would hide the memory of this one
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:  # not on Linux
        return None
    return read_memory("VmRSS")


def peak_above(baseline: int | None, device: str) -> int | None:
    """Return the peak of used memory above a baseline."""
    if device != "cpu":
        return int(torch.cuda.max_memory_allocated(device))
    peak = read_memory("VmHWM")
    return None if baseline is None or peak is None else max(0, peak - baseline)


class AllocationCounter(TorchDispatchMode):
    """Counter of the bytes of live tensors that were made within its context.

    Attributes:
        peak: Largest count so far, in bytes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._alive: dict[int, tuple[StorageWeakRef, int]] = {}
        self._size = 0  # of all of them, among which are some that are freed
        self.peak = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and count its results; freed ones are looked for where they would make a new peak."""
        out = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                storage = leaf.untyped_storage()
                _, before = self._alive.get(storage._cdata, (None, 0))
                self._alive[storage._cdata] = StorageWeakRef(storage), storage.nbytes()
                self._size += storage.nbytes() - before
        if self._size > self.peak:
            self._alive = {k: entry for k, entry in self._alive.items() if not entry[0].expired()}
            self._size = sum(size for _, size in self._alive.values())
            self.peak = max(self.peak, self._size)
        return out


class MemoryTrimmer:
    """Callable that returns large amounts of freed memory to the system.

    `keep_freed_memory` makes the C library keep freed memory. Small objects then lie between
    holes that are too small for the tensors of the next step. A job with 60 MB of live tensors grew
    to 850 MB within a hundred steps [measured]. A release takes milliseconds, so it happens only if
    the resident memory is 50 % and 256 MiB above the first step after the last release. A query
    takes as long as a small step, so it happens at every tenth step.
    """

    def __init__(self) -> None:
        self._release = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._baseline: int | None = None  # after the first step
        self._step = 0

    def __call__(self) -> None:
        """Release memory if necessary. Call this function once per time step."""
        self._step += 1
        now = read_memory("VmRSS") if self._step % _CHECK_STEPS == 1 else None
        if self._release is None or now is None:
            return
        if self._baseline is None:
            self._baseline = now
        elif now > self._baseline + max(256 * MIB, self._baseline // 2):
            self._release(0)
            self._baseline = None


def _machine_memory() -> Iterator[float]:
    """Yield the free memory of the machine."""
    info = Path("/proc/meminfo")
    if info.exists():
        lines = [line.split() for line in info.read_text().splitlines()]
        yield from (1024.0 * float(words[1]) for words in lines if words[0] == "MemAvailable:")
    elif "SC_PHYS_PAGES" in os.sysconf_names:
        # free memory is not reported: half of all memory [ours]
        yield 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _group_memory(
    root: Path = Path("/sys/fs/cgroup"), membership: Path = Path("/proc/self/cgroup")
) -> Iterator[float]:
    """Yield the free memory of each control group, interface versions 2 and 1."""
    if not membership.exists():
        return
    for line in membership.read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        names = ("memory.max", "memory.current")
        if controllers:
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        top = root / "memory" if controllers else root
        parts = Path(path).parts[1:]
        for folder in (top, *(top.joinpath(*parts[: k + 1]) for k in range(len(parts)))):
            ceiling, used = (_read_number(folder / name) for name in names)
            if ceiling is not None and used is not None and ceiling < 1 << 60:
                yield max(0.0, ceiling - used + _reclaimable(folder / "memory.stat"))


def _read_number(file: Path) -> float | None:
    """Read a number. None if the file is missing or does not hold one."""
    text = file.read_text().strip() if file.exists() else ""
    return float(text) if text.isdigit() else None


def _reclaimable(file: Path) -> float:
    """Read the bytes of inactive file pages, which are freed on demand."""
    words = file.read_text().split() if file.exists() else []
    values = dict(zip(words[::2], words[1::2], strict=True))
    return float(values.get("total_inactive_file", values.get("inactive_file", 0)))


_BASE = 256.0 * MIB  # libraries and compiled code

_TRIAL_STEPS = 8

_TRIAL_PARTICLES = 64  # also twice and four times as many

_SIMULATION_FACTOR = 4  # bytes while simulating per byte of episode: sensors are faster [ours]

_TRACE_COPIES = 3  # of each step's output: the steps, one tensor of all, single precision [ours]

_OVERHEAD = 2.0  # resident bytes per byte of live tensors, for workspace and holes [1.5 to 2.3]

_MAX_EPISODE = 30e6  # bytes per run, above those of all scenarios in conf/

# bytes per sample of inertial sensors: of a run, and of the flight that all share [400 and 1400 to 1600 measured]
_RUN_SAMPLE, _FLIGHT_SAMPLE = 600.0, 1600.0


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
        """Compute the peak while `runs` of `total` runs are at work."""
        waiting = (total or runs) - runs
        idle = waiting * (self.result + (self.episode if is_whole else 0.0))
        return self.base + runs * self.run + self.run_batch(runs) * self.stepped + idle


def runs_within_limit(
    estimate: MemoryEstimate, runs: int, limit: float, is_whole: bool = False
) -> int:
    """Determine the runs that fit at a time, in batches of about equal size.

    Returns runs per batch, at most all.
    """
    if estimate.peak(1, runs, is_whole) > limit:
        if estimate.peak(1) > limit:
            workload, remedy = "a single run", "Use fewer particles or dtype=float32"
        else:
            workload = f"the results of {runs} runs"
            remedy = f"Split the job (runs={runs // 2}, then first_run={runs // 2})"
        raise _refusal(workload, estimate.peak(1, runs, is_whole), limit, remedy)
    low, high = 1, runs
    while low < high:
        middle = (low + high + 1) // 2
        fits = estimate.peak(middle, runs, is_whole) <= limit
        low, high = (middle, high) if fits else (low, middle - 1)
    batches = -(-runs // low)
    return -(-runs // batches)


def undrawn_bytes(scenario: Any, model: StateSpaceModel, limit: float | None) -> float:
    """Return the bytes of a run that is not drawn, by its stated steps and samples, at least those of `conf/`.

    Counted are what is drawn and the moments, errors and NEES of each step.

    Raises:
        ValueError: If one run and the flight that all runs share do not fit into memory.
    """
    steps, samples = (getattr(scenario, name, 0) for name in ("steps", "samples"))
    numbers, moments = model.chart.size + 2, 3 * model.chart.dimension + 3
    numbers = (_SIMULATION_FACTOR * numbers + _TRACE_COPIES * moments) * steps
    run = max(_MAX_EPISODE, 8.0 * numbers + _RUN_SAMPLE * samples)
    size = _BASE + run + _FLIGHT_SAMPLE * samples
    if limit is not None and run > _MAX_EPISODE and size > limit:
        workload = "a single run"
        raise _refusal(workload, size, limit, "Use fewer steps or a shorter flight")
    return run


def fits_undrawn(runs: int, limit: float | None, run: float) -> bool:
    """Return whether the undrawn episodes of all runs fit, each of as many bytes as `run`."""
    return limit is None or _BASE + runs * run <= limit


def _refusal(workload: str, size: float, limit: float, remedy: str) -> ValueError:
    """Return the error of a job that does not fit."""
    return ValueError(
        f"memory must be at least {size / GIB:.3g} GiB for {workload}, got {limit / GIB:.3g} GiB. "
        f"{remedy}, or set memory_limit_gib=... (GiB) if more is free."
    )


def fits_drawn(estimate: MemoryEstimate, runs: int, limit: float) -> bool:
    """Return whether the episodes of all runs fit while they are drawn together."""
    return _BASE + runs * _SIMULATION_FACTOR * estimate.episode <= limit


def needs_memory_trial(
    method: Any, model: StateSpaceModel, runs: int, limit: float, run: float = _MAX_EPISODE
) -> bool:
    """Return whether a job may exceed the limit.

    Most jobs are small enough to skip the trial.
    """
    d = model.chart.dimension
    return runs * (run + 40.0 * _particles(method) * d * (d + 10)) > limit


def estimate_memory(
    method: Any,
    model: StateSpaceModel,
    episode: Episode,
    run_batch: Callable[[int], int],
    watch: Callable[[int, int], Watch | None] | None = None,
) -> MemoryEstimate:
    """Estimate the bytes of a job by a trial.

    Returns the estimate.
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
                first_steps(model, record.select_runs(slice(0, r)), trial_steps),
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


def first_steps(model: StateSpaceModel, record: Record, steps: int) -> Record:
    """Copy the first steps of a record.

    Oracle noise is that of the whole record, which its model prepares before.

    Returns the copy, without a feedback process.
    """
    inputs = model.prepare(record) if isinstance(model, OracleNoiseModel) else record
    start, spread = (None if a is None else a.clone() for a in (inputs.start, inputs.spread))
    u = map_inputs(lambda a: a[:, :steps].clone(), inputs.u)
    return Record(inputs.y[:, :steps].clone(), u, start, spread)


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


@cache
def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next step; without effect for other C libraries.

    Otherwise it returns blocks of some megabytes to the system and maps them again at each step. This
    took a sixth of the time of a bootstrap filter with 100 runs of 500 particles.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
            set_option(option, 1 << 30)


def read_memory(name: str) -> int | None:
    """Return the present (VmRSS) or the largest (VmHWM) memory of the process, bytes; None if not on Linux."""
    file = Path("/proc/self/status")
    lines = file.read_text().splitlines() if file.exists() else []
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(name)), None)
