"""Builds of compiled steps in the background, of steps that jobs wanted often enough to repay them.

A job that runs by `kernels` notes the step that it wanted, and the time that the step would save. Once the noted times
reach those of a build, a process of low priority builds the step while the job continues. The next job of this step loads it.
"""

from __future__ import annotations

import json
import logging
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from pfbench.files.atomic_write import write_atomically
from pfbench.files.foreign_folder import start_python
from pfbench.filter.particle import step_store
from pfbench.job.memory import GIB, available_memory
from pfbench.kernels import dispatch
from pfbench.kernels.cpp_library import check_private, code_folder, load_library

if TYPE_CHECKING:
    from pfbench.filter.particle.compiled_filter import StepParts

log = logging.getLogger("pfbench")

#: environment variable that prevents builds in the background if it is 0
SWITCH = "PFBENCH_BACKGROUND_BUILDS"
#: processor time of a build, s: 10 to 14 s [measured], and 4 to 8 s of a step in the cache of torch's compiler
BUILD_SECONDS = 10.0
_LEAST_SAVING = 0.02  # s of a job: the name of its step takes as long
_LONGEST_WISH, _LONGEST_FAILURE = 30 * 86400.0, 7 * 86400.0  # s
_LARGEST_LEDGER = 500  # steps
_LEAST_MEMORY = 4 * GIB  # free; a build takes less than 1 GiB
_LONGEST_BUILD = 1800  # s
_QUOTA = Path("/sys/fs/cgroup/cpu.max")
# The low priority holds for the imports too.
_PROGRAM = "import os; os.nice(19); from pfbench.job.step_builds import build_step; build_step()"
_started: list[subprocess.Popen[bytes]] = []  # never waited for

# --------------------------------------------------------------------------------------------------
# Wishes of jobs


def are_builds_allowed() -> bool:
    """Return whether jobs of this process may start builds."""
    return os.environ.get(SWITCH) != "0" and sys.platform != "win32"


def want_step(name: str, saving: float, parts: StepParts) -> None:
    """Note that a job wanted a step, and start its build if jobs have wanted it often enough.

    No failure reaches the job: a line of the log states it.

    Args:
        name: Name of the step.
        saving: Time that the step would have saved, s.
        parts: Parts of the step.
    """
    if saving < _LEAST_SAVING or not are_builds_allowed():
        return
    try:
        wish = _note(name, saving)
        if wish["reason"]:
            say_once(f"engine=auto: its compiled step cannot be built ({wish['reason']})")
        elif wish["saving"] >= BUILD_SECONDS and _has_idle_core():
            _start_build(name, parts)
    except OSError as error:
        say_once(f"engine=auto: no compiled step, since none can be stored ({error})")


@cache
def say_once(line: str) -> None:
    """Log a line, once in a process."""
    log.info(line)


def _note(name: str, saving: float = 0.0, reason: str | None = None) -> dict[str, Any]:
    """Add to the noted saving of a step, and note a failure of its build; an empty reason is a build that starts.

    A build that starts takes the noted saving: if it is killed, the next one needs as much again.

    Returns what is noted.
    """
    file, now = code_folder() / "wishes.json", time.time()
    wishes = _read_wishes(file, now)
    wish = wishes.pop(name, {"saving": 0.0, "reason": "", "tried": now})
    wish |= {"saving": wish["saving"] + saving, "time": now}
    if reason is not None:
        wish |= {"saving": 0.0, "reason": reason, "tried": now}
    wishes[name] = wish
    text = json.dumps(dict(list(wishes.items())[-_LARGEST_LEDGER:]))
    write_atomically(file, lambda stream: stream.write(text.encode()))
    return wish


def _read_wishes(file: Path, now: float) -> dict[str, dict[str, Any]]:
    """Read the wishes that are not old, the latest last. A damaged file has none."""
    try:
        check_private(file)
        wishes = json.loads(file.read_text())
        recent = {k: a for k, a in wishes.items() if abs(now - a["time"]) < _LONGEST_WISH}
        for wish in recent.values():
            is_recent = abs(now - wish["tried"]) < _LONGEST_FAILURE
            wish |= {"saving": float(wish["saving"]), "reason": wish["reason"] * is_recent}
        return recent
    except (FileNotFoundError, ValueError, TypeError, KeyError, AttributeError):
        return {}


def _has_idle_core() -> bool:
    """Return whether this process may use a core that is idle, and memory for a build."""
    usable = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    free = available_memory()
    return (
        min(usable, _read_quota()) >= torch.get_num_threads() + 1
        and os.getloadavg()[0] < (os.cpu_count() or 1) - 0.5
        and (free is None or free >= _LEAST_MEMORY)
    )


def _read_quota() -> float:
    """Return the cores that the control group may use."""
    try:
        quota, period = _QUOTA.read_text().split()
        return float(quota) / float(period)
    except (OSError, ValueError):  # no control group, or "max"
        return float("inf")


# --------------------------------------------------------------------------------------------------
# Start of a build. A lock lets one run at a time. The process of the build holds it, so it is free once this ends.


def _start_build(name: str, parts: StepParts) -> None:
    """Start the build of a step, unless another build runs."""
    with _lock() as lock:
        if lock is None or step_store.has_step(name):
            return
        step_store.clear_workshop()  # of a build that was killed
        with tempfile.TemporaryFile() as request:  # without a name, so that nothing remains of it
            try:
                for item in ((name, torch.get_num_threads()), parts):
                    pickle.dump(item, request)
            except (pickle.PicklingError, AttributeError, TypeError, RecursionError) as error:
                _note(name, reason=f"another process cannot receive it: {error}"[:200])
                return
            request.seek(0)
            _note(name, reason="")
            _started.append(
                start_python(
                    _PROGRAM,
                    {**_ENVIRONMENT, "TORCHINDUCTOR_CACHE_DIR": str(step_store.workshop())},
                    stdin=request,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    pass_fds=(lock,),
                )
            )
    log.info("engine=auto: a background process compiles the step, which later jobs load")


# One thread, no trial of each set of vector instructions, and no headers that are compiled in advance for later steps.
_ENVIRONMENT = {
    "TORCHINDUCTOR_COMPILE_THREADS": "1",
    "TORCHINDUCTOR_VEC_ISA_OK": "1",
    "TORCHINDUCTOR_CPP_CACHE_PRECOMPILE_HEADERS": "0",
    SWITCH: "0",
}


@contextmanager
def _lock() -> Iterator[int | None]:
    """Take the lock of builds; yield its file, or None if another build runs."""
    import fcntl  # not on Windows

    file = os.open(code_folder() / "build.lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield None
        else:
            yield file
    finally:
        os.close(file)  # a process that received it holds the lock


# --------------------------------------------------------------------------------------------------
# The process of a build


def build_step() -> None:
    """Build the step that standard input describes. Note the reason if that fails."""
    signal.alarm(_LONGEST_BUILD)
    _offer_to_be_killed()
    name, threads = pickle.load(sys.stdin.buffer)
    lines = _LastLine()
    log.addHandler(lines)
    log.setLevel(logging.INFO)
    try:
        torch.set_num_threads(threads)
        _build(name, pickle.load(sys.stdin.buffer))
        reason = "" if step_store.has_step(name) else lines.last
    except Exception as error:  # torch raises many kinds
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    step_store.clear_workshop()
    if reason:
        _note(name, reason=reason)


def _build(name: str, parts: StepParts) -> None:
    """Compile and store a step, if its name is the same here."""
    from pfbench.filter.particle.compiled_filter import compile_step

    if parts.name() != name:
        raise ValueError("its name must be the same in another process")
    load_library()
    with torch.no_grad(), dispatch.use_kernels():
        compile_step(parts)


class _LastLine(logging.Handler):
    """Handler of a log that keeps the last line."""

    last = "it is not stored"

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.last = record.getMessage()[:200]


def _offer_to_be_killed() -> None:
    """Let the system end this process before any other if memory is short."""
    try:
        Path("/proc/self/oom_score_adj").write_text("1000")
    except OSError:
        return
