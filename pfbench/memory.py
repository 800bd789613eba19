"""What a job will take of the memory, told before it starts, and how many of its runs fit at a time.

Nothing is known of a filter beforehand: it is run over a few steps of one and of two worlds with few particles while the bytes
of all live tensors are counted, and what it would take with all particles and runs follows from that.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pfbench.draws import MonteCarlo
from pfbench.filter.loop import Estimate, Watch, run_filter
from pfbench.model.base import StateSpaceModel
from pfbench.record import Episode, Record, map_inputs

GIB, MIB = 1 << 30, 1 << 20
_SHARE = 0.8  # of what is free: the estimate does not see allocators and libraries [ours]
_STEPS = 8  # of the trial
_ASKED = 10  # steps from one look at what is held to the next
_FEW = 64  # particles of the trial; also twice and four times as many
_DRAWN = 4  # bytes at work for each byte of a world that is drawn: sensors run faster than receivers [ours]
_KEPT = 3  # copies of what each step tells: the steps, all of them in one tensor, in single precision [ours]
_HELD = 2.0  # bytes that are held for each of live tensors: what operations use inside, and holes [measured: 1.5 to 2.3]
_WORLD = 30e6  # bytes of a run's world beyond those of any scenario at hand: what decides whether to look at all


class Counted(TorchDispatchMode):
    """Counts the bytes of tensors that are made within it and still alive.

    Attributes:
        most: the largest count so far.
    """

    def __init__(self) -> None:
        super().__init__()
        self._alive: dict[int, tuple[StorageWeakRef, int]] = {}
        self.most = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self._alive = {key: held for key, held in self._alive.items() if not held[0].expired()}
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                storage = leaf.untyped_storage()
                self._alive[storage._cdata] = StorageWeakRef(storage), storage.nbytes()
        self.most = max(self.most, sum(size for _, size in self._alive.values()))
        return out


@dataclass(frozen=True)
class Needs:
    """Bytes of a job.

    Attributes:
        base: whatever the number of runs.
        run: of each run: its world, its cloud, what each step tells.
        stepped: of each run that a step takes together with others.
        left: of each run in the end.
        at_once: runs -> how many of them a step takes together.
    """

    base: float
    run: float
    stepped: float
    left: float
    at_once: Callable[[int], int]

    def of(self, runs: int, whole: int | None = None) -> float:
        """Most that is held at a time: by `runs` runs, beside what the `whole` job's other runs have left."""
        return self.base + runs * self.run + self.at_once(runs) * self.stepped + ((whole or runs) - runs) * self.left


def fitting(needs: Needs, runs: int, limit: float) -> int:
    """How many of the job's runs fit at a time, at best all.

    Raises:
        ValueError: not even one does.
    """
    if needs.of(1, runs) > limit:
        what = "one run alone" if needs.of(1) > limit else f"what {runs} runs leave"
        remedy = "fewer particles, dtype=float32" if needs.of(1) > limit else f"the runs in several jobs (first_run={runs // 2})"
        raise ValueError(
            f"memory: {what} would take about {needs.of(1, runs) / GIB:.3g} GiB, and {limit / GIB:.3g} GiB may be taken here; "
            f"give {remedy}, or memory=... (GiB) if you know better"
        )
    low, high = 1, runs
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if needs.of(middle, runs) <= limit else (low, middle - 1)
    parts = -(-runs // low)
    return -(-runs // parts)


def worth_asking(method: Any, model: StateSpaceModel, runs: int, limit: float) -> bool:
    """May the job be too large at all? Most are so small that nobody need try."""
    d = model.chart.dimension
    return runs * (_WORLD + 40.0 * _particles(method) * d * (d + 10)) > limit


def needs(
    method: Any,
    model: StateSpaceModel,
    episode: Episode,
    at_once: Callable[[int], int],
    watch: Callable[[int, int], Watch | None] | None = None,
) -> Needs:
    """What a job will take, from a trial.

    Args:
        method: the filter.
        model: what it believes in, on the device and in the precision of the job.
        episode: the worlds of two runs of the job, or of its only one.
        at_once: runs -> how many of them a step takes together.
        watch: (runs, steps) -> what watches the filter over the first steps of the first runs.
    """
    record = model.prepare(episode.record)
    runs, length = record.y.shape[:2]
    drawn = [*tree_leaves(tuple(episode.record[:4])), *episode.truth.values(), episode.track]
    world = _DRAWN * _each(drawn, runs) + 2 * _each(tree_leaves(tuple(record[:4])), runs)
    steps = min(_STEPS, length)
    n = _particles(method)
    sizes = [n] if n <= 4 * _FEW else [_FEW, 2 * _FEW, 4 * _FEW]
    found, told, told_single = [], 0.0, 0.0
    for size in sizes:
        small = method if n == size else replace(method, particles=size)
        one, two, apart = (_trial(small, model, record, min(r, runs), steps, b, watch) for r, b in ((1, 1), (2, 2), (2, 1)))
        found.append((one[0], two[0] - apart[0], apart[0] - one[0]))  # all, of each run in a step, of each run besides
        told, told_single = one[1] / steps, one[2] / steps
    every, stepped, besides = (_HELD * _extended(sizes, [row[part] for row in found], n) for part in range(3))
    if runs == 1:
        besides = every
    return Needs(
        base=256 * MIB + max(0.0, every - stepped - besides),
        run=max(0.0, besides) + world + _KEPT * told * length,
        stepped=max(0.0, stepped),
        left=told_single * length,
        at_once=at_once if record.loop is None else int,
    )


class Tidy:
    """Gives freed memory back to the system where there is much of it; to be called at each step.

    `native.keep_memory` has the C library keep it, and small things that stay then lie between holes into which the next step's
    tensors do not fit: within a hundred steps a job with 60 MB of live tensors held 850 MB [measured]. Giving all back costs some
    milliseconds, so it happens only where a half more is held than at the step after the last time, and 256 MiB more. Asking the
    system takes as long as a small step, so it is asked at every tenth.
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        self._floor: int | None = None  # what the first step leaves
        self._step = 0

    def __call__(self) -> None:
        self._step += 1
        now = held() if self._step % _ASKED == 1 else None
        if self._trim is None or now is None:
            return
        if self._floor is None:
            self._floor = now
        elif now > self._floor + max(256 * MIB, self._floor // 2):
            self._trim(0)
            self._floor = None


def held() -> int | None:
    """Bytes of memory that this process holds; None where the system does not tell."""
    file = Path("/proc/self/statm")
    return int(file.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if file.exists() else None


def limit(wanted: float | None, device: str) -> float | None:
    """Bytes that a job may take: what was wanted (GiB), else a share of what is free; None where the system does not tell."""
    if wanted is not None:
        return wanted * GIB
    free = torch.cuda.mem_get_info(device)[0] if device != "cpu" else available()
    return None if free is None else _SHARE * free


def available() -> float | None:
    """Free bytes of this machine's memory, or of the control group that this process is confined to."""
    found = [*_of_the_machine(), *_of_the_groups()]
    return min(found, default=None)


def _trial(
    method: Any, model: StateSpaceModel, record: Record, runs: int, steps: int, at_once: int, watch: Any
) -> tuple[int, float, float]:
    """Most bytes of a filter over the first steps of the first runs; bytes that it leaves, and in single precision."""
    part = cut(record.of(slice(0, runs)), steps)
    draws = MonteCarlo(0, torch.arange(runs, device=model.anchor.device), model.anchor.dtype)
    with torch.no_grad(), Counted() as count:
        estimate = run_filter(method, model, part, draws, watch(runs, steps) if watch else None, at_once=at_once)
    left: list[Tensor] = [leaf for leaf in tree_leaves(_parts(estimate)) if isinstance(leaf, Tensor)]
    return count.most, sum(leaf.nbytes for leaf in left), sum(leaf.numel() * min(4, leaf.element_size()) for leaf in left)


def _parts(estimate: Estimate) -> tuple[Any, ...]:
    return estimate.mean, estimate.variance, estimate.trace


def cut(record: Record, steps: int) -> Record:
    """A record's first steps, in storages of their own."""
    start, spread = (None if a is None else a.clone() for a in (record.start, record.spread))
    return Record(record.y[:, :steps].clone(), map_inputs(lambda a: a[:, :steps].clone(), record.u), start, spread)


def _each(parts: Sequence[Any], runs: int) -> float:
    """Bytes of each of one or two runs; what two have in common belongs to none."""
    own = [part for part in parts if isinstance(part, Tensor) and part.dim() > 0 and part.shape[0] == runs]
    return sum(part.numel() * part.element_size() for part in own) / runs


def _particles(method: Any) -> int:
    return int(method.particles) if "particles" in {part.name for part in fields(method)} else 0


def _extended(sizes: Sequence[int], values: Sequence[float], n: int) -> float:
    """The parabola through values at sizes a, 2a and 4a, further on at n; most are lines, and none falls."""
    if len(sizes) == 1:
        return float(values[0])
    a = sizes[0]
    slope, later = (values[1] - values[0]) / a, (values[2] - values[1]) / (2 * a)
    bend = max(0.0, (later - slope) / (3 * a))
    if bend * n * n < 0.05 * abs(later) * n:  # roundings of an allocation, no law
        bend = 0.0
    return float(values[2] + max(0.0, later) * (n - 4 * a) + bend * (n - 4 * a) * (n - 2 * a))


def _of_the_machine() -> Iterator[float]:
    """Free memory as the system tells it."""
    info = Path("/proc/meminfo")
    if info.exists():
        lines = [line.split() for line in info.read_text().splitlines()]
        yield from (1024.0 * float(words[1]) for words in lines if words[0] == "MemAvailable:")
    elif "SC_PHYS_PAGES" in os.sysconf_names:
        yield 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")  # nobody tells what is free: half of it [ours]


def _of_the_groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[float]:
    """What control groups leave, version 2 of the interface and version 1: a container's limit, a batch system's."""
    if not own.exists():
        return
    for line in own.read_text().splitlines():
        _, controllers, place = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        names = ("memory.max", "memory.current") if controllers == "" else ("memory.limit_in_bytes", "memory.usage_in_bytes")
        top = root if controllers == "" else root / "memory"
        for folder in (top, *(top.joinpath(*Path(place).parts[1 : k + 1]) for k in range(1, len(Path(place).parts)))):
            ceiling, taken = (_number(folder / name) for name in names)
            if ceiling is not None and taken is not None and ceiling < 1 << 60:
                yield max(0.0, ceiling - taken + _reclaimable(folder / "memory.stat"))


def _number(file: Path) -> float | None:
    text = file.read_text().strip() if file.exists() else ""
    return float(text) if text.isdigit() else None


def _reclaimable(file: Path) -> float:
    """Pages of files that nobody looked at lately: they count as taken and are given back on demand."""
    words = file.read_text().split() if file.exists() else []
    stated = dict(zip(words[::2], words[1::2], strict=True))
    return float(stated.get("total_inactive_file", stated.get("inactive_file", 0)))
