"""Worker processes of a run from Python. A worker reads the configuration of a job and writes a reply.

Workers start from this module and not from the script of the user, so that a script needs no guard.
"""

from __future__ import annotations

import json
import logging
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, Self

from pfbench.cli.messages import format_error, notes_of
from pfbench.files.foreign_folder import start_python
from pfbench.job.config import JobConfig
from pfbench.job.trust import split_trust

COUNTER = "[...] "  # in the line of a job, replaced where the line is printed
_PROGRAM = "from pfbench.door.worker import serve; serve()"

log = logging.getLogger("pfbench")


class JobReply(NamedTuple):
    """Reply of a job: its status finished, skipped or failed, its lines, and the message of a failure."""

    status: str
    lines: list[str]
    message: str = ""


class _Lines(logging.Handler):
    """Handler that keeps the lines of a job."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        self.texts.append(record.getMessage())


def run_config(config: JobConfig) -> JobReply:
    """Run a job and collect its lines; an error is a line, as in a sweep of the command line."""
    from pfbench import job

    handler, level, propagate = _Lines(), log.level, log.propagate
    handlers = list(log.handlers)
    log.handlers[:], log.propagate = [handler], False
    log.setLevel(logging.INFO)
    try:
        outcome = job.run(config, counter=COUNTER)
        return JobReply(outcome.status, handler.texts)
    except Exception as error:
        message = " ".join(format_error(error, config.words).split())
        name = _name(config)
        line = f"{COUNTER}failed    {'   '.join([name, message, *notes_of(error)])}"
        return JobReply("failed", [*handler.texts, line], message)
    finally:
        log.handlers[:], log.propagate = handlers, propagate
        log.setLevel(level)


def _name(config: JobConfig) -> str:
    """Name a job by its choices."""
    return " / ".join(config.choices[group] for group in ("scenario", "noise", "filter"))


def serve() -> None:
    """Answer the requests of the standard input until it ends."""
    replies, sys.stdout = sys.stdout, sys.stderr  # a class of the user may print
    for line in sys.stdin:
        print(json.dumps(_answer(json.loads(line))._asdict()), file=replies, flush=True)


def _answer(request: dict[str, Any]) -> JobReply:
    """Run the job of a request. A class that this process cannot import is a failure, too."""
    try:
        split_trust([f"trust=[{','.join(request['trusted'])}]"])  # so that its modules are imported
        config = JobConfig(**{**request, "trusted": tuple(request["trusted"])})
    except Exception as error:
        message = format_error(error)
        return JobReply("failed", [f"{COUNTER}failed    {message}"], message)
    return run_config(config)


class WorkerPool:
    """Worker processes that take jobs one by one. They end with the pool."""

    def __init__(self, size: int) -> None:
        self._processes = [self._start() for _ in range(size)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes:
            _end(process)

    def run(self, jobs: Sequence[JobConfig]) -> Iterator[tuple[int, JobReply]]:
        """Run jobs; yield number and reply of each when it ends."""
        pending: queue.SimpleQueue[int] = queue.SimpleQueue()
        replies: queue.SimpleQueue[tuple[int, JobReply]] = queue.SimpleQueue()
        for number in range(len(jobs)):
            pending.put(number)

        def feed(slot: int) -> None:
            while True:
                try:
                    number = pending.get_nowait()
                except queue.Empty:
                    return
                replies.put((number, self._ask(slot, jobs[number])))

        for slot in range(len(self._processes)):
            threading.Thread(target=feed, args=(slot,), daemon=True).start()
        for _ in jobs:
            yield replies.get()

    def _ask(self, slot: int, config: JobConfig) -> JobReply:
        """Return the reply of a worker; a failure if its process has ended, which is replaced."""
        process = self._processes[slot]
        _send(process, vars(config))
        answer = process.stdout.readline() if process.stdout else ""
        if answer:
            return JobReply(**json.loads(answer))
        code = process.wait()
        end = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        message = (
            f"a worker must answer, got one of {len(self._processes)} that ended with {end}. If the system killed it "
            "(SIGKILL), memory is short: use fewer workers, or limit each job by memory_limit_gib=... (GiB). Else its own "
            "lines above state the reason, and workers=1 shows it here."
        )
        name = _name(config)
        _end(process)
        self._processes[slot] = self._start()
        return JobReply("failed", [f"{COUNTER}failed    {name}   {message}"], message)

    def _start(self) -> subprocess.Popen[str]:
        """Start a worker."""
        pipe = subprocess.PIPE
        return start_python(_PROGRAM, stdin=pipe, stdout=pipe, text=True)


def _send(process: subprocess.Popen[str], message: Any) -> None:
    """Send a message to a worker, which may have ended."""
    with suppress(OSError, ValueError):
        assert process.stdin is not None
        process.stdin.write(f"{json.dumps(message)}\n")
        process.stdin.flush()


def _end(process: subprocess.Popen[str]) -> None:
    """End a worker and close its streams."""
    with suppress(OSError):
        process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):
                stream.close()
