"""Counts of a sweep, printed at its end."""

from __future__ import annotations

import contextlib
import os
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from pfbench.cli.sweep.study_plan import StudyPlan
from pfbench.files.reader_notes import NOTE, SWEEP_LOG, append_line
from pfbench.files.work_start import start_work

SWEEP_JOBS = "PFBENCH_SWEEP_JOBS"  # environment variable: number of jobs, for the counter


@dataclass
class SweepProgress:
    """Counts of a sweep, from a file to which its jobs append.

    Any launcher can run the jobs. Jobs that do not get the environment, on a running cluster, are
    counted by the results that were written meanwhile.

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
        """Count the jobs of a sweep and set the total for the counters of its jobs.

        Args:
            plan: Plan of the sweep, None if it is not valid.
        """
        if plan is None:  # the sweep itself reports the error
            return cls()
        values = plan.first.values
        os.environ[SWEEP_JOBS] = str(plan.jobs)
        study = str(values["study"]) if plan.has_one_study else None
        sweep = cls(plan.jobs, study, Path(values["results_dir"]) / str(values["study"]))
        os.environ[SWEEP_LOG] = str(sweep._log)
        return sweep

    def finish(self, is_complete: bool = True, is_part: bool = False) -> None:
        """Print the counts, and the next command if the study has results.

        Args:
            is_complete: Whether the sweep ended without an error.
            is_part: Whether more runs may follow, so that the next command is not printed.
        """
        os.environ.pop(SWEEP_JOBS, None)
        os.environ.pop(SWEEP_LOG, None)
        if is_complete or self._log.is_file():
            start_work()  # in another process, for most launchers
        if self.study is None or self.jobs is None:
            return
        counts = self._count_outcomes() or self._count_files(is_complete)
        elapsed = time.time() - self.start_time
        has_results = any(self.folder.glob("*.npz"))
        command = (
            f"  Next: pfbench report study={self.study}" if has_results and not is_part else ""
        )
        print(f"sweep: {counts} in {elapsed:.0f} s.{command}")

    @property
    def _log(self) -> Path:
        """File of the outcomes, in the folder of the results because remote jobs see it."""
        name = f".sweep-{os.getpid()}-{self.start_time:.6f}"
        return self.folder.absolute() / name

    def _count_outcomes(self) -> str:
        """Count the jobs by outcome, and remove the file. Empty if there is none."""
        try:
            lines = self._log.read_text().splitlines()
            self._log.unlink()
        except OSError:
            return ""
        with contextlib.suppress(OSError):  # no job wrote a file, or others are there
            self.folder.rmdir()
        outcomes = defaultdict(set)  # a job that a retry skips has two
        for line in lines:
            number, _, status = line.partition(" ")
            if number != NOTE:
                outcomes[number].add(status)
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


def note_outcome(number: int | None, status: str) -> None:
    """Append the outcome of a job to the file of its sweep, if it has one.

    Args:
        number: Number of the job in the sweep, None outside a sweep.
        status: `finished`, `skipped` or `failed`.
    """
    path = os.environ.get(SWEEP_LOG)
    if path is None or number is None:
        return
    with contextlib.suppress(OSError):  # of a full disk: the job reports it
        append_line(path, f"{number} {status}")
