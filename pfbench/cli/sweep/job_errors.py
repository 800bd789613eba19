"""Report of a failed job: once, on its line in a sweep, else as the error of the command."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from pfbench.cli.messages import format_error, notes_of
from pfbench.files.work_start import start_work

log = logging.getLogger("pfbench")

_HYDRA_LINE = "Error executing job with overrides"
_OTHER_TERMINAL = ("slurm", "ray_cluster")  # launchers whose jobs print elsewhere


class SweepJobError(Exception):
    """Error of a job that its own line has reported."""


class _WithoutHydraLine:
    """Stream that leaves out Hydra's list of overrides before an error."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text, unless it is Hydra's line."""
        return len(text) if text.startswith(_HYDRA_LINE) else int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def hide_hydra_line() -> Iterator[None]:
    """Leave Hydra's line about a failed job out of the error stream: the message follows it."""
    stream: Any = _WithoutHydraLine(sys.stderr)
    with contextlib.redirect_stderr(stream):
        yield


def report_failed_job(error: Exception, start: str, name: str, words: Sequence[str]) -> Exception:
    """Print the line of a failed job of a sweep.

    Args:
        error: Error of the job.
        start: Start of the line, such as `[3/40] `.
        name: Scenario, noise regime and filter.
        words: Overrides of the job.

    Returns:
        Error to raise in its place, with the same message.
    """
    message = " ".join(format_error(error, words).split())
    log.error("%sfailed    %s", start, "   ".join([name, message, *notes_of(error)]))
    return SweepJobError(message)


def summarise_failed_jobs(error: Exception, words: Sequence[str]) -> Exception:
    """Return the error that ends a sweep.

    Args:
        error: First error of a job, or another error of the sweep.
        words: Words of the command.

    Returns:
        A reference to the lines of the jobs, if they were printed in the same terminal. Else the
        error itself.
    """
    if isinstance(error, SweepJobError):
        start_work()  # a job that cannot start fails in a sweep: the other jobs run
    launcher = next((w.partition("=")[2] for w in words if w.startswith("hydra/launcher=")), "")
    if not isinstance(error, SweepJobError) or launcher in _OTHER_TERMINAL:
        return error
    return SweepJobError(
        "all jobs of the sweep must finish, got failed jobs. Their lines above give the reasons. "
        "Correct them, and repeat the command to run them again."
    )
