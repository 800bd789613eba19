"""Command `pfbench run`: one job, or a sweep."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pfbench.cli.compose import given_keys, read_sweep
from pfbench.config.composition import compose, register_experiments
from pfbench.config.folders import conf_dir
from pfbench.config.sweep_check import check_words, expand_sweep

HELP = """\
pfbench run [-m] key=value ...

Run one job (one filter in one condition), or with -m a sweep over comma-separated values.
Finished jobs are skipped: repeat an interrupted command to resume.

  pfbench run scenario=flight_300s noise=nominal filter=sir runs=100 seed=1
  pfbench run -m scenario=flight_300s filter=ekf,sir noise=nominal,outliers study=mine
  pfbench run -m +experiment=quickstart
  pfbench run -m +experiment=quickstart hydra/launcher=cores     on all cores

  pfbench list               scenarios, noise regimes, filters and experiments
  pfbench run --cfg job      all keys with their values"""

_RETRIES = 3  # of a sweep that lost a process, as many as Ray allows
_SWEEP_JOBS = "PFBENCH_SWEEP_JOBS"  # environment variable: number of jobs, for the counter
_FLAGS = ("-m", "--multirun")


def run_jobs(words: Sequence[str]) -> None:
    """Run one job, or a sweep.

    Args:
        words: Overrides and flags of Hydra.
    """
    import hydra

    register_experiments()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    flags = [word for word in words if word in _FLAGS]  # first, else argparse drops later overrides
    overrides = [word for word in words if word not in flags]
    check_words([*flags, *overrides])
    sys.argv = ["pfbench run", *flags, *overrides]
    decorate = hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")
    application = decorate(run_task)
    if not flags:
        application()
        return
    sweep = SweepProgress.start([word for word in overrides if not word.startswith("-")])
    try:
        run_with_retries(application)
    finally:
        sweep.finish()


def run_task(cfg: Any) -> float:
    """Run one job of a Hydra application.

    Args:
        cfg: Composed configuration.

    Returns:
        The root mean square error of the main group, for sweepers that optimise.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from pfbench import job

    application: Any = HydraConfig.get()
    counter = ""
    if total := os.environ.get(_SWEEP_JOBS):
        number = OmegaConf.select(application, "job.num", throw_on_missing=False)
        counter = "" if number is None else f"[{number + 1}/{total}] "
    return job.run(cfg, application.runtime.choices, counter).rmse


def run_with_retries(sweep: Callable[[], Any]) -> None:
    """Run a sweep, and repeat it if joblib lost one of its processes.

    Args:
        sweep: Runs all jobs.

    Raises:
        RuntimeError: If a process was lost in all attempts.
    """
    for remaining in reversed(range(_RETRIES + 1)):
        try:
            sweep()
            return
        except Exception as error:
            if type(error).__name__ != "TerminatedWorkerError":
                raise
            if not remaining:
                raise RuntimeError(
                    "memory must be enough for all processes of the sweep, got a process that was "
                    f"killed {_RETRIES + 1} times. Finished jobs are kept. Use fewer processes "
                    "(hydra.launcher.n_jobs=2) or limit each job by memory_limit_gib=... (GiB)."
                ) from error
            message = "warning run: a process of the sweep was killed. Running the remaining jobs"
            print(message, file=sys.stderr)


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
    def start(cls, overrides: Sequence[str]) -> SweepProgress:
        """Count the jobs of a sweep and set the total for the counters of its jobs.

        Args:
            overrides: Overrides of the sweep.
        """
        names = [word.partition("=")[2] for word in overrides if word.startswith("+experiment=")]
        params = [word for name in names for word in read_sweep(name)]
        try:
            alternatives = expand_sweep([*params, *overrides])
            first = [values[0] for values in alternatives]
            values = compose(
                [word for word in first if not re.match(r"[+~]*hydra[/.](?!searchpath)", word)]
            ).values
        except Exception:  # the sweep itself reports the error
            return cls()
        jobs = 1
        for options in alternatives:
            jobs *= len(options)
        os.environ[_SWEEP_JOBS] = str(jobs)
        is_swept = any(
            len(options) > 1 and "study" in given_keys(options) for options in alternatives
        )
        study = None if is_swept or len(names) > 1 else str(values["study"])
        return cls(jobs, study, Path(values["results_dir"]) / str(values["study"]))

    def finish(self) -> None:
        """Print the counts and the next command."""
        os.environ.pop(_SWEEP_JOBS, None)
        if self.study is None or self.jobs is None:
            return
        finished = self._count("*.npz")
        failed = self._count("*.failed.json")
        skipped = max(0, self.jobs - finished - failed)
        counts = f"{finished} finished, {skipped} skipped, {failed} failed"
        elapsed = time.time() - self.start_time
        command = f"pfbench report study={self.study}"
        print(f"sweep: {counts} in {elapsed:.0f} s.  Next: {command}")

    def _count(self, pattern: str) -> int:
        """Count the files that were written since the start."""
        times = (file.stat().st_mtime for file in self.folder.glob(pattern))
        return sum(modified >= self.start_time - 0.05 for modified in times)
