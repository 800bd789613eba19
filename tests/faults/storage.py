"""Storage that refuses: full disks, limits of the file size and folders that cannot be written; then the sweep is repeated."""

import ctypes
import os
import random
import resource
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from faults.children import run_child
from faults.sweeps import is_clear, judge, new_home, run_sweep, undisturbed
from faults.tally import Tally

NEW_NAMESPACE, NEW_USER = 0x20000, 0x10000000
READ_ONLY, REMOUNT, BIND, RECURSIVE, PRIVATE = 1, 32, 4096, 0x4000, 0x40000


def enter_namespace() -> None:
    """Give this process mounts of its own; without root, in a user namespace."""
    libc, user = ctypes.CDLL(None, use_errno=True), os.getuid()
    flags = NEW_NAMESPACE if user == 0 else NEW_NAMESPACE | NEW_USER
    if libc.unshare(flags) != 0:
        raise OSError(ctypes.get_errno(), "a namespace of mounts is not allowed")
    if user != 0:
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
    mount(None, Path("/"), None, RECURSIVE | PRIVATE)


def mount(source: Path | None, target: Path, kind: str | None, flags: int, data: str = "") -> None:
    """Mount a file system for this process and its children."""
    libc = ctypes.CDLL(None, use_errno=True)
    words = [None if a is None else str(a).encode() for a in (source, target, kind)]
    if libc.mount(*words, ctypes.c_ulong(flags), data.encode() or None) != 0:
        raise OSError(ctypes.get_errno(), f"mount of {target} failed")


def fill_disk(home: Path, rng: random.Random) -> Callable[[], None]:
    """Put the folder on a disk of few pages; return the function that enlarges it."""
    enter_namespace()
    mount(Path("none"), home, "tmpfs", 0, f"size={4 * rng.randint(1, 10)}k")
    return lambda: mount(None, home, None, REMOUNT, "size=4m")


def limit_file_size(home: Path, rng: random.Random) -> Callable[[], None]:
    """Limit the size of each file; return the function that lifts the limit."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (rng.randint(1, 15_000), hard))
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def forbid_writing(home: Path, rng: random.Random) -> Callable[[], None]:
    """Make one folder read-only, root included; return the function that allows writing."""
    enter_namespace()
    folder = home / rng.choice(("results", "results/adhoc", "worlds"))
    folder.mkdir(parents=True)
    mount(folder, folder, None, BIND)
    mount(None, folder, None, BIND | REMOUNT | READ_ONLY)
    return lambda: mount(None, folder, None, BIND | REMOUNT)


FAULTS: dict[str, Callable[[Path, random.Random], Callable[[], None]]] = {
    "full disk": fill_disk,
    "limit of the file size": limit_file_size,
    "read-only folder": forbid_writing,
}


def attempt(name: str, seed: int, home: Path) -> list[Any]:
    """Run the sweep with a fault, then without; return outcome, remark and example."""
    try:
        lift = FAULTS[name](home, random.Random(seed))
    except OSError as error:
        return ["skipped", f"{error}", ""]
    said = run_sweep(home)
    lift()
    if said.code == 0:
        outcome, remark, example = judge(home, said)
        return [outcome, f"not affected: {remark}", example]
    if not is_clear(said.err):
        return ["unclear", "stopped", said.err[-500:]]
    outcome, remark, example = judge(home, run_sweep(home))
    return [outcome, f"stopped with a clear message, repeated: {remark}", example]


def run(name: str, count: int, seed: int) -> Tally:
    """Disturb `count` sweeps by one fault of the storage."""
    undisturbed()
    tally = Tally(name)
    for number in range(count):
        with new_home() as home:
            task_seed = seed * 100_003 + number
            ending = run_child(lambda: attempt(name, task_seed, home))  # noqa: B023
        outcome, remark, example = (
            ending.value if ending.state == "done" else ("crash", ending.state, f"{ending.value}")
        )
        if outcome == "skipped":
            tally.skipped = remark
            return tally
        tally.add(outcome, remark, example)
    return tally
