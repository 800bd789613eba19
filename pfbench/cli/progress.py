"""Progress of a sweep: counts, time left and state, from a file to which its jobs append.

Any launcher can run the jobs, and so can Python. The file lies in the folder of the results, because remote jobs see it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shlex
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pfbench.cli.messages import format_error, notes_of
from pfbench.files.reader_notes import NOTE, append_line
from pfbench.job.config import JobConfig
from pfbench.results.store import list_failures

log = logging.getLogger("pfbench")

_SHORT = 60.0  # s; a shorter time left is not printed
_FILE = re.compile(r"\.sweep-(\d+)-(\d+\.\d+)-(\d+)")  # process, start, jobs


@dataclass(frozen=True)
class Sweep:
    """Jobs of a study that run together.

    Attributes:
        folder: Folder of the results of the study.
        jobs: Number of jobs.
        process: Number of the process that started it.
        start_time: Start, seconds since the epoch.
    """

    folder: Path
    jobs: int
    process: int = field(default_factory=os.getpid)
    start_time: float = field(default_factory=time.time)

    @classmethod
    def of_jobs(cls, first: JobConfig, jobs: int) -> Sweep:
        """Return the sweep of a job and of others of its study."""
        folder = Path(first.values["results_dir"]) / str(first.values["study"])
        return cls(folder, jobs)

    @classmethod
    def from_file(cls, file: str | Path) -> Sweep | None:
        """Return the sweep of a file, None if it is not one of a sweep."""
        match = _FILE.fullmatch(Path(file).name)
        if match is None:
            return None
        return cls(Path(file).parent, int(match[3]), int(match[1]), float(match[2]))

    @property
    def file(self) -> Path:
        """File of the outcomes, whose name states process, start and number of jobs."""
        name = f".sweep-{self.process}-{self.start_time:.6f}-{self.jobs}"
        return self.folder.absolute() / name

    def note(self, number: int, status: str) -> None:
        """Append the outcome of a job to the file."""
        with contextlib.suppress(OSError):  # of a full disk: the job reports it
            append_line(self.file, f"{number} {status}")

    def read_outcomes(self) -> dict[str, set[str]]:
        """Read the outcomes of the jobs by number. A job that a retry skips has two."""
        outcomes: dict[str, set[str]] = defaultdict(set)
        with contextlib.suppress(OSError):
            for line in self.file.read_text().splitlines():
                number, _, status = line.partition(" ")
                if number != NOTE:
                    outcomes[number].add(status)
        return outcomes

    def count(self, is_complete: bool = True) -> str:
        """Count the jobs by outcome, and remove the file.

        Jobs that do not know of the file, on a running cluster, are counted by the results that were written meanwhile.
        """
        if not self.file.is_file():
            finished, failed = map(self._count_written, ("*.npz", "*.failed.json"))
            others = max(0, self.jobs - finished - failed)
            # an error without a note is of the command, which then stopped before these jobs
            state = "skipped" if is_complete or failed else "not run"
            return f"{finished} finished, {others} {state}, {failed} failed"
        outcomes = self.read_outcomes()
        self.file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # no job wrote a file, or others are there
            self.folder.rmdir()
        finished = sum("finished" in of_job for of_job in outcomes.values())
        failed = sum(of_job == {"failed"} for of_job in outcomes.values())
        rest = self.jobs - len(outcomes)
        skipped = len(outcomes) - finished - failed
        text = f"{finished} finished, {skipped} skipped, {failed} failed"
        return f"{text}, {rest} not run" if rest > 0 else text

    def _count_written(self, pattern: str) -> int:
        """Count the files that were written since the start."""
        times = (file.stat().st_mtime for file in self.folder.glob(pattern))
        return sum(modified >= self.start_time - 0.05 for modified in times)

    def estimate_time_left(self, own_job: str = "") -> float:
        """Estimate the time that the other jobs need [s], at the speed of those that were computed; 0 if unknown."""
        outcomes = self.read_outcomes()
        outcomes.setdefault(own_job, {"finished"} if own_job else set())
        computed = sum("skipped" not in states and bool(states) for states in outcomes.values())
        rest = self.jobs - sum(map(bool, outcomes.values()))
        elapsed = time.time() - self.start_time
        return max(0.0, elapsed / computed * rest) if computed else 0.0

    def is_at_work(self) -> bool:
        """Return whether the process of the sweep exists on this machine."""
        try:
            os.kill(self.process, 0)
        except PermissionError:  # of another user
            return True
        except ProcessLookupError:
            return False
        return True


class SweepCounter(NamedTuple):
    """Start of the line of a job: its number, the number of jobs and the time left when the line is written.

    Attributes:
        number: Number of the job, from 0.
        sweep: Sweep of the job, None if unknown.
    """

    number: int
    sweep: Sweep | None

    def note(self, status: str) -> None:
        """Append the outcome of the job to the file of its sweep."""
        if self.sweep:
            self.sweep.note(self.number, status)

    def __str__(self) -> str:
        total = f"/{self.sweep.jobs}" if self.sweep else ""
        seconds = self.sweep.estimate_time_left(str(self.number)) if self.sweep else 0.0
        rest = f", {format_duration(seconds)} left" if seconds >= _SHORT else ""
        return f"[{self.number + 1}{total}{rest}] "


def format_duration(seconds: float) -> str:
    """Format a time as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def name_job(choices: Mapping[str, Any]) -> str:
    """Name a job by its choices."""
    return " / ".join(str(choices[group]) for group in ("scenario", "noise", "filter"))


class SweepJobError(Exception):
    """Error of a job that its own line has reported."""


@contextlib.contextmanager
def reported_failure(
    start: object, choices: Mapping[str, Any], words: Sequence[str]
) -> Iterator[None]:
    """Print the line of a job of a sweep that fails, and raise an error with its message alone."""
    try:
        yield
    except Exception as error:
        message = " ".join(format_error(error, words).split())
        texts = [name_job(choices), message, *notes_of(error)]
        log.error("%sfailed    %s", start, "   ".join(texts))
        raise SweepJobError(message) from error


@dataclass(frozen=True, repr=False)
class StudyState:
    """State of a study.

    Attributes:
        study: Name.
        finished: Number of results.
        failures: Notes of failed jobs.
        running: Jobs that are done and all jobs of each sweep that is at work.
        seconds_left: Time that the slowest of these sweeps still needs [s]; 0 if none is at work or it is unknown.
        changed: Time of the newest result, seconds since the epoch; 0 without one.
    """

    study: str
    finished: int
    failures: list[dict[str, Any]]
    running: tuple[tuple[int, int], ...]
    seconds_left: float
    changed: float

    def __repr__(self) -> str:
        texts = [f"{self.finished} finished", f"{len(self.failures)} failed"]
        texts += [f"running {done} of {jobs}" for done, jobs in self.running]
        if self.seconds_left:
            texts.append(f"{format_duration(self.seconds_left)} left")
        return f"{self.study}: {', '.join(texts)}"


def read_state(folder: Path) -> StudyState:
    """Read the state of a study from its folder of results."""
    results = list(folder.glob("*.npz"))
    sweeps = [s for s in map(Sweep.from_file, folder.glob(".sweep-*")) if s and s.is_at_work()]
    return StudyState(
        folder.name,
        len(results),
        list_failures(folder),
        tuple((len(sweep.read_outcomes()), sweep.jobs) for sweep in sweeps),
        max((sweep.estimate_time_left() for sweep in sweeps), default=0.0),
        max((file.stat().st_mtime for file in results), default=0.0),
    )


def list_repeats(folder: Path, since: float = 0.0) -> list[str]:
    """List the failed jobs of a study, each with its message and the words that repeat it."""
    lines = []
    for note in list_failures(folder):
        file = folder / f"{note['key']}.failed.json"
        if since and not (file.is_file() and file.stat().st_mtime >= since - 0.05):
            continue
        lines += [
            f"failed: {name_job(note['choices'])}: {note['message']}",
            f"  repeat: {format_repeat(note)}",
        ]
        lines += [] if since else [f"  if another setting has mended it: remove {file}"]
    return lines


def format_repeat(note: Any) -> str:
    """Format the command that repeats a failed job; without its words only the choices are known."""
    choices: Sequence[str] = [f"{key}={value}" for key, value in note["choices"].items()]
    return shlex.join(["pfbench", "run", *note.get("words", choices)])
