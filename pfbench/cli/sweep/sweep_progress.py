"""Counts of a sweep, printed at its end."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from pfbench.cli.sweep.study_plan import StudyPlan

SWEEP_JOBS = "PFBENCH_SWEEP_JOBS"  # environment variable: number of jobs, for the counter


@dataclass
class SweepProgress:
    """Counts of a sweep, from the files that its jobs write.

    Any launcher can run the jobs.

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
        return cls(plan.jobs, study, Path(values["results_dir"]) / str(values["study"]))

    def finish(self, is_complete: bool = True, is_part: bool = False) -> None:
        """Print the counts and the next command.

        Args:
            is_complete: Whether the sweep ended without an error.
            is_part: Whether more runs may follow, so that the next command is not printed.
        """
        os.environ.pop(SWEEP_JOBS, None)
        if self.study is None or self.jobs is None:
            return
        finished = self._count("*.npz")
        failed = self._count("*.failed.json")
        others = max(0, self.jobs - finished - failed)
        # an error without a note is of the command, which then stopped before these jobs
        state = "skipped" if is_complete or failed else "not run"
        counts = f"{finished} finished, {others} {state}, {failed} failed"
        elapsed = time.time() - self.start_time
        command = "" if is_part else f"  Next: pfbench report study={self.study}"
        print(f"sweep: {counts} in {elapsed:.0f} s.{command}")

    def _count(self, pattern: str) -> int:
        """Count the files that were written since the start."""
        times = (file.stat().st_mtime for file in self.folder.glob(pattern))
        return sum(modified >= self.start_time - 0.05 for modified in times)
