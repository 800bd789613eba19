"""Progress of a sweep: counts, time left and state, from a file to which its jobs append.

Any launcher can run the jobs, and so can Python. The file lies in the folder of the results, because remote jobs see it.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pfbench.files.command_start import start_work
from pfbench.files.reader_notes import NOTE, SWEEP_LOG, append_line

if TYPE_CHECKING:
    from pfbench.cli.compose import StudyPlan

SWEEP_JOBS = "PFBENCH_SWEEP_JOBS"  # environment variable: number of jobs, for the counter
_SHORT = 60.0  # s; a shorter time left is not printed
_FILE = re.compile(r"\.sweep-(\d+)-(\d+\.\d+)-(\d+)")  # process, start, jobs


@dataclass
class SweepProgress:
    """Counts of a sweep, from a file to which its jobs append.

    Jobs that do not get the environment, on a running cluster, are counted by the results that were
    written meanwhile.

    Attributes:
        jobs: Number of jobs, or None if unknown.
        study: Name of the study, or None if it cannot be determined.
        folder: Folder of the results.
        start_time: Start of the sweep, seconds since the epoch.
    """

    jobs: int | None = None
    study: str | None = None
    folder: Path = Path()
    start_time: float = field(default_factory=time.time)

    @classmethod
    def start(cls, plan: StudyPlan | None) -> SweepProgress:
        """Count the jobs of a sweep and set the total for the counters of its jobs."""
        if plan is None:  # the sweep itself reports the error
            return cls()
        values = plan.first.values
        os.environ[SWEEP_JOBS] = str(plan.jobs)
        study = str(values["study"]) if plan.has_one_study else None
        sweep = cls(plan.jobs, study, Path(values["results_dir"]) / str(values["study"]))
        os.environ[SWEEP_LOG] = str(sweep.file)
        return sweep

    def finish(self, is_complete: bool = True, is_part: bool = False) -> None:
        """Print the counts, the failed jobs with the words that repeat them, and the next command."""
        os.environ.pop(SWEEP_JOBS, None)
        os.environ.pop(SWEEP_LOG, None)
        if is_complete or self.file.is_file():
            start_work()  # in another process, for most launchers
        if self.study is None or self.jobs is None:
            return
        counts = self.count(is_complete)
        elapsed = time.time() - self.start_time
        has_results = any(self.folder.glob("*.npz"))
        command = (
            f"  Next: pfbench report study={self.study}" if has_results and not is_part else ""
        )
        print(f"sweep: {counts} in {elapsed:.0f} s.{command}")
        for line in list_repeats(self.folder, self.start_time):
            print(line)

    def count(self, is_complete: bool = True) -> str:
        """Count the jobs by outcome, and remove the file."""
        return self._count_outcomes() or self._count_files(is_complete)

    @property
    def file(self) -> Path:
        """File of the outcomes, whose name states process, start and number of jobs."""
        name = f".sweep-{os.getpid()}-{self.start_time:.6f}-{self.jobs or 0}"
        return self.folder.absolute() / name

    def _count_outcomes(self) -> str:
        """Count the jobs by outcome, and remove the file. Empty if there is none."""
        outcomes = read_outcomes(self.file)
        if outcomes is None:
            return ""
        self.file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # no job wrote a file, or others are there
            self.folder.rmdir()
        finished = sum("finished" in of_job for of_job in outcomes.values())
        failed = sum(of_job == {"failed"} for of_job in outcomes.values())
        skipped = len(outcomes) - finished - failed
        rest = (self.jobs or 0) - len(outcomes)
        text = f"{finished} finished, {skipped} skipped, {failed} failed"
        return f"{text}, {rest} not run" if rest > 0 else text

    def _count_files(self, is_complete: bool) -> str:
        """Count the jobs by the files that were written since the start."""
        finished, failed = self._count("*.npz"), self._count("*.failed.json")
        others = max(0, (self.jobs or 0) - finished - failed)
        # an error without a note is of the command, which then stopped before these jobs
        state = "skipped" if is_complete or failed else "not run"
        return f"{finished} finished, {others} {state}, {failed} failed"

    def _count(self, pattern: str) -> int:
        """Count the files that were written since the start."""
        times = (file.stat().st_mtime for file in self.folder.glob(pattern))
        return sum(modified >= self.start_time - 0.05 for modified in times)


def read_outcomes(file: str | Path) -> dict[str, set[str]] | None:
    """Read the outcomes of the jobs of a sweep by number; None without a file."""
    try:
        lines = Path(file).read_text().splitlines()
    except OSError:
        return None
    outcomes: dict[str, set[str]] = defaultdict(set)  # a job that a retry skips has two
    for line in lines:
        number, _, status = line.partition(" ")
        if number != NOTE:
            outcomes[number].add(status)
    return outcomes


def note_outcome(number: int | None, status: str, file: str | Path | None = None) -> None:
    """Append the outcome of a job to the file of its sweep, if it has one."""
    path = file or os.environ.get(SWEEP_LOG)
    if path is None or number is None:
        return
    with contextlib.suppress(OSError):  # of a full disk: the job reports it
        append_line(path, f"{number} {status}")


class SweepCounter(NamedTuple):
    """Start of the line of a job: its number, the number of jobs and the time left when the line is written.

    Attributes:
        number: Number of the job, from 0.
        jobs: Number of jobs; empty if unknown.
        file: File of the sweep; empty if unknown.
    """

    number: int
    jobs: str
    file: str

    @classmethod
    def from_environment(cls, number: int) -> SweepCounter:
        """Make the counter of a job whose sweep runs in another process."""
        return cls(number, os.environ.get(SWEEP_JOBS, ""), os.environ.get(SWEEP_LOG, ""))

    def __str__(self) -> str:
        total = f"/{self.jobs}" if self.jobs else ""
        seconds = estimate_time_left(self.file, own_job=str(self.number))
        rest = f", {format_duration(seconds)} left" if seconds >= _SHORT else ""
        return f"[{self.number + 1}{total}{rest}] "


def estimate_time_left(file: str | Path, own_job: str = "") -> float:
    """Estimate the time that the other jobs of a sweep need [s], at the speed of those that were computed; 0 if unknown."""
    match = _FILE.fullmatch(Path(file).name)
    if match is None:
        return 0.0
    outcomes = dict(read_outcomes(file) or {})
    outcomes.setdefault(own_job or "", {"finished"} if own_job else set())
    computed = sum("skipped" not in states and bool(states) for states in outcomes.values())
    done = sum(bool(states) for states in outcomes.values())
    elapsed, rest = time.time() - float(match[2]), int(match[3]) - done
    return max(0.0, elapsed / computed * rest) if computed else 0.0


def format_duration(seconds: float) -> str:
    """Format a time as "40 s", "12 min" or "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


# --------------------------------------------------------------------------------------------------
# State of a study: finished, failed and running jobs, of the command line and of Python.


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
    from pfbench.results.store import list_failures

    results = list(folder.glob("*.npz"))
    sweeps = [file for file in folder.glob(".sweep-*") if _is_at_work(file)]
    running = tuple(
        (len(read_outcomes(file) or {}), int(_FILE.fullmatch(file.name)[3]))  # type: ignore[index]
        for file in sweeps
    )
    return StudyState(
        folder.name,
        len(results),
        list_failures(folder),
        running,
        max(map(estimate_time_left, sweeps), default=0.0),
        max((file.stat().st_mtime for file in results), default=0.0),
    )


def _is_at_work(file: Path) -> bool:
    """Return whether the process of a sweep exists on this machine."""
    match = _FILE.fullmatch(file.name)
    if match is None:
        return False
    try:
        os.kill(int(match[1]), 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # of another user
        return True
    return True


def list_repeats(folder: Path, since: float = 0.0) -> list[str]:
    """List the failed jobs of a study, each with its message and the words that repeat it."""
    from pfbench.results.store import list_failures

    lines = []
    for note in list_failures(folder):
        file = folder / f"{note['key']}.failed.json"
        if since and not (file.is_file() and file.stat().st_mtime >= since - 0.05):
            continue
        names = " / ".join(str(note["choices"][key]) for key in ("scenario", "noise", "filter"))
        lines += [f"failed: {names}: {note['message']}", f"  repeat: {format_repeat(note)}"]
        lines += [] if since else [f"  if another setting has mended it: remove {file}"]
    return lines


def format_repeat(note: Any) -> str:
    """Format the command that repeats a failed job; without its words only the choices are known."""
    import shlex

    choices: Sequence[str] = [f"{key}={value}" for key, value in note["choices"].items()]
    return shlex.join(["pfbench", "run", *note.get("words", choices)])
