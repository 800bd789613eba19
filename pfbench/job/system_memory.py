"""Memory of this machine, control group or GPU: free, used, counted and released."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from pfbench.kernels import process_memory

GIB, MIB = 1 << 30, 1 << 20
_USABLE_SHARE = 0.8  # of free memory: allocators and libraries are not counted [ours]
_CHECK_STEPS = 10  # steps between two queries of the resident memory


def memory_limit(requested: float | None, device: str) -> float | None:
    """Return the bytes that a job may use.

    Args:
        requested: Limit in GiB. None means a share of the free memory.
        device: Device of the job.

    Returns:
        The limit, or None if the system does not report free memory.
    """
    if requested is not None:
        return requested * GIB
    free = torch.cuda.mem_get_info(device)[0] if device != "cpu" else available_memory()
    return None if free is None else _USABLE_SHARE * free


def available_memory() -> float | None:
    """Return the free bytes of this machine or control group, or None if unknown."""
    return min([*_machine_memory(), *_group_memory()], default=None)


def resident_bytes() -> int | None:
    """Return the resident bytes of this process, or None if unknown."""
    file = Path("/proc/self/statm")
    return int(file.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if file.exists() else None


def start_peak_measurement(device: str) -> int | None:
    """Reset the peak of used memory and return the bytes in use, for `peak_above`."""
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats(device)
    return process_memory.reset_peak_memory()


def peak_above(baseline: int | None, device: str) -> int | None:
    """Return the peak of used memory above a baseline.

    Args:
        baseline: Result of `start_peak_measurement`.
        device: Device of the job.

    Returns:
        Bytes, or None if the system does not report them.
    """
    if device != "cpu":
        return int(torch.cuda.max_memory_allocated(device))
    return None if baseline is None else max(0, process_memory.peak_memory() - baseline)


class AllocationCounter(TorchDispatchMode):
    """Counter of the bytes of live tensors that were made within its context.

    Attributes:
        peak: Largest count so far, in bytes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._alive: dict[int, tuple[StorageWeakRef, int]] = {}
        self.peak = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and count its results."""
        out = func(*args, **(kwargs or {}))
        self._alive = {k: entry for k, entry in self._alive.items() if not entry[0].expired()}
        for leaf in tree_leaves(out):
            if isinstance(leaf, Tensor):
                storage = leaf.untyped_storage()
                self._alive[storage._cdata] = StorageWeakRef(storage), storage.nbytes()
        self.peak = max(self.peak, sum(size for _, size in self._alive.values()))
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
        now = resident_bytes() if self._step % _CHECK_STEPS == 1 else None
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
