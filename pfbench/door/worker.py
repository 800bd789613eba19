"""Worker processes of a run from Python. A worker reads the configuration of a job and writes a reply.

Workers start from this module and not from the script of the user, so that a script needs no guard.
"""

from __future__ import annotations

import io
import json
import logging
import queue
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, Self

from pfbench import job
from pfbench.cli.progress import SweepJobError, log, name_job, reported_failure
from pfbench.files.foreign_folder import start_python
from pfbench.job.config import JobConfig
from pfbench.job.trust import split_trust

COUNTER = "[...] "  # in the line of a job, replaced where the line is printed
_PROGRAM = "from pfbench.door.worker import serve; serve()"


class JobReply(NamedTuple):
    """Reply of a job: its status finished, skipped or failed, its lines, and the message of a failure."""

    status: str
    lines: list[str]
    message: str = ""


@contextmanager
def logging_to(handler: logging.Handler, *, is_alone: bool = False) -> Iterator[None]:
    """Let a handler receive the lines of jobs, besides others or alone."""
    handlers, propagate, level = list(log.handlers), log.propagate, log.level
    if is_alone:
        log.handlers[:], log.propagate = [], False
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.handlers[:], log.propagate = handlers, propagate
        log.setLevel(level)


def run_request(request: Mapping[str, Any]) -> JobReply:
    """Run the job of the fields of a configuration; an error is a line, as in a sweep of the command line."""
    lines = io.StringIO()
    with logging_to(logging.StreamHandler(lines), is_alone=True):
        try:
            with reported_failure(COUNTER, request["choices"], request["words"]):
                trusted = tuple(request["trusted"])
                split_trust([f"trust=[{','.join(trusted)}]"])  # so that its modules are imported
                config = JobConfig(**{**request, "trusted": trusted})
                status, message = job.run(config, counter=COUNTER).status, ""
        except SweepJobError as error:
            status, message = "failed", f"{error}"
    return JobReply(status, lines.getvalue().splitlines(), message)


def serve() -> None:
    """Answer the requests of the standard input until it ends."""
    replies, sys.stdout = sys.stdout, sys.stderr  # a class of the user may print
    for line in sys.stdin:
        print(json.dumps(run_request(json.loads(line))._asdict()), file=replies, flush=True)


class WorkerPool:
    """Worker processes that take jobs one by one. They end with the pool."""

    def __init__(self, size: int) -> None:
        self._idle: queue.SimpleQueue[subprocess.Popen[str]] = queue.SimpleQueue()
        self._processes = [self._start() for _ in range(size)]
        self._threads = ThreadPoolExecutor(size)
        self._is_closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._is_closed = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in self._processes:
            _end(process)

    def run(self, jobs: Sequence[JobConfig]) -> Iterator[tuple[int, JobReply]]:
        """Run jobs; yield number and reply of each when it ends."""
        replies = {self._threads.submit(self._ask, config): k for k, config in enumerate(jobs)}
        for reply in as_completed(replies):
            yield replies[reply], reply.result()

    def _ask(self, config: JobConfig) -> JobReply:
        """Return the reply of an idle worker; a failure if its process has ended, which is replaced."""
        process = self._idle.get()
        with suppress(OSError, ValueError):  # it may have ended
            assert process.stdin is not None
            print(json.dumps(vars(config)), file=process.stdin, flush=True)
        answer = process.stdout.readline() if process.stdout else ""
        if answer:
            self._idle.put(process)
            return JobReply(**json.loads(answer))
        code = process.wait()
        end = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        message = (
            f"a worker must answer, got one of {len(self._processes)} that ended with {end}. If the system killed it "
            "(SIGKILL), memory is short: use fewer workers, or limit each job by memory_limit_gib=... (GiB). Else its own "
            "lines above state the reason, and workers=1 shows it here."
        )
        _end(process)
        if not self._is_closed:
            self._processes[self._processes.index(process)] = self._start()
        return JobReply(
            "failed", [f"{COUNTER}failed    {name_job(config.choices)}   {message}"], message
        )

    def _start(self) -> subprocess.Popen[str]:
        """Start a worker."""
        pipe = subprocess.PIPE
        process = start_python(_PROGRAM, stdin=pipe, stdout=pipe, text=True)
        self._idle.put(process)
        return process


def _end(process: subprocess.Popen[str]) -> None:
    """End a worker and close its streams."""
    with suppress(OSError):
        process.kill()
    process.wait()
    for stream in filter(None, (process.stdin, process.stdout)):
        with suppress(OSError):
            stream.close()
