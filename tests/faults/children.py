"""Child processes of the harness: forked with all modules loaded, limited in time and memory, and killed as a group."""

import json
import os
import resource
import select
import signal
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

QUIET = (1, 2)  # stdout and stderr of a child that is to be silent


class Ending(NamedTuple):
    """End of a child.

    Attributes:
        state: `done`, `raised`, `timed out`, or `signal N` if a signal ended it.
        value: Value of the task, the traceback if it raised, else None.
    """

    state: str
    value: Any


def fork() -> int:
    """Fork this process; the child leads a session of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12: torch has threads
        process = os.fork()
    if process == 0:
        os.setsid()
        null = os.open(os.devnull, os.O_WRONLY)
        for stream in QUIET:
            os.dup2(null, stream)
    return process


def start(task: Callable[[], int]) -> int:
    """Run a task in a child and return its process number; the task returns the exit code."""
    process = fork()
    if process == 0:
        code = 99
        with suppress(BaseException):
            code = task()
        os._exit(code)
    return process


def kill(process: int) -> None:
    """Kill a child and its group without notice."""
    with suppress(ProcessLookupError):
        os.killpg(process, signal.SIGKILL)
    with suppress(ProcessLookupError):  # it may not lead its group yet
        os.kill(process, signal.SIGKILL)


def has_ended(process: int, timeout: float) -> bool:
    """Wait for a child at most `timeout` seconds, without collecting its status."""
    until = time.monotonic() + timeout
    while True:
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        if os.waitid(os.P_PID, process, options) is not None:
            return True
        if time.monotonic() >= until:
            return False
        time.sleep(0.005)


def collect(process: int) -> str:
    """Return how a child ended: `exit N` or `signal N`."""
    code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return f"exit {code}" if code >= 0 else f"signal {-code}"


def used_addresses() -> int:
    """Return the size of the addresses of this process, in bytes."""
    statm = Path("/proc/self/statm")
    pages = int(statm.read_text().split()[0]) if statm.exists() else 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def run_child(
    task: Callable[[], Any], timeout: float = 120.0, memory_gib: float | None = None
) -> Ending:
    """Run a task in a child and return its value, which JSON can represent.

    `memory_gib` limits the addresses that the child adds to those of this process.
    """
    reader, writer = os.pipe()
    process = fork()
    if process == 0:
        os.close(reader)
        if memory_gib is not None:
            limit = used_addresses() + int(memory_gib * 2**30)
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        try:
            reply = {"state": "done", "value": task()}
        except BaseException:
            reply = {"state": "raised", "value": traceback.format_exc()}
        with os.fdopen(writer, "w") as pipe:
            json.dump(reply, pipe)
        os._exit(0)
    os.close(writer)
    try:
        text = _read_all(reader, timeout)
    finally:
        os.close(reader)
        kill(process)
        state = collect(process)
    if text is None:
        return Ending("timed out", None)
    try:
        reply = json.loads(text)
    except ValueError:
        return Ending(state, None)
    return Ending(reply["state"], reply["value"])


def _read_all(reader: int, timeout: float) -> str | None:
    """Read a pipe to its end; None if that takes longer than `timeout` seconds."""
    until, chunks = time.monotonic() + timeout, []
    while (rest := until - time.monotonic()) > 0:
        if select.select([reader], [], [], rest)[0]:
            if not (chunk := os.read(reader, 1 << 16)):
                return b"".join(chunks).decode(errors="replace")
            chunks.append(chunk)
    return None
