"""Command `pfbench run`: one job, or a sweep."""

from __future__ import annotations

import functools
import os
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any

from pfbench.cli.sweep.application import make_application
from pfbench.cli.sweep.job_errors import (
    hide_hydra_line,
    report_failed_job,
    summarise_failed_jobs,
)
from pfbench.cli.sweep.study_plan import StudyPlan, plan_study
from pfbench.cli.sweep.sweep_progress import SWEEP_JOBS, SweepProgress, note_outcome
from pfbench.cli.sweep.until_decided import GrowingSweep, check_has_sweep, wants_until_decided
from pfbench.cli.terminal import end_with_parent
from pfbench.config.composition import JobConfig, register_experiments
from pfbench.config.named_sets import expand_filter_sets
from pfbench.config.sweep_check import check_words, replace_config_dir
from pfbench.config.trust import ENVIRONMENT
from pfbench.files.work_start import start_work

HELP = """\
pfbench run [-m] key=value ...

Run one job (one filter in one condition), or with -m a sweep over comma-separated values.
Finished jobs are skipped: repeat an interrupted command to resume.

  pfbench run scenario=flight_300s noise=nominal filter=sir runs=100 seed=1
  pfbench run -m scenario=flight_300s filter=ekf,sir noise=nominal,outliers study=mine
  pfbench run -m +experiment=quickstart
  pfbench run -m +experiment=quickstart hydra/launcher=cores     on all cores
  pfbench run -m scenario=flight_300s filter=ekf,sir study=mine runs=until-decided
                             adds runs until each pair of filters is decided

  pfbench list               scenarios, noise regimes, filters and experiments
  pfbench run --cfg job      all keys with their values"""

_RETRIES = 3  # of a sweep that lost a process, as many as Ray allows
# errors of joblib and Ray about a process that another program ended
_LOST_PROCESS = {
    "TerminatedWorkerError", "LocalRayletDiedError", "NodeDiedError", "ObjectLostError",
    "OwnerDiedError", "RaySystemError", "WorkerCrashedError",
}  # fmt: skip
_FLAGS = ("-m", "--multirun")
_PRINTING_FLAGS = {"--cfg", "-c", "--info", "-i", "--hydra-help", "--version", "--resolve"}


def run_jobs(words: Sequence[str]) -> None:
    """Run one job, or a sweep.

    Args:
        words: Overrides and flags of Hydra.
    """
    register_experiments()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    words = replace_config_dir(words)
    flags = [word for word in words if word in _FLAGS]  # first, else argparse drops later overrides
    overrides = expand_filter_sets([word for word in words if word not in flags])
    overrides = delay_keys_of_swept_groups(overrides) if flags else overrides
    first = check_words([*flags, *overrides])
    is_printed = any(word.partition("=")[0] in _PRINTING_FLAGS for word in words)
    plan = None if is_printed else plan_or_none(overrides, first)
    if plan and flags:
        plan.check_comparable()
    if plan and wants_until_decided(plan):
        check_has_sweep(flags)
        sweep = GrowingSweep.from_plan(plan)
        others = [word for word in overrides if not re.match(r"(runs|first_run)=", word)]
        application = make_application(run_task)
        sweep.run(lambda more: run_sweep(application, [*flags, *others, *more], plan, is_part=True))
        return
    if flags:
        print_study_size(plan)
        run_sweep(make_application(run_task), [*flags, *overrides], plan)
        return
    _run_alone(overrides, plan)


def _run_alone(overrides: Sequence[str], plan: StudyPlan | None) -> None:
    """Run one job, and print what its runs can show once its data are valid."""

    @functools.wraps(run_task)
    def run_with_plan(cfg: Any) -> float:
        return run_task(cfg, lambda: print_study_size(plan))

    sys.argv = ["pfbench run", *overrides]
    with hide_hydra_line():
        make_application(run_with_plan)()


def plan_or_none(overrides: Sequence[str], first: JobConfig | None = None) -> StudyPlan | None:
    """Plan a study; None if its configuration is not valid, which Hydra reports.

    Args:
        overrides: Overrides and flags of Hydra.
        first: Configuration of the first job, None if it is not known.
    """
    words = [word for word in overrides if not word.startswith("-")]
    try:
        return plan_study(words, first if len(words) == len(overrides) else None)
    except Exception:
        return None


def print_study_size(plan: StudyPlan | None) -> None:
    """Print what the chosen runs and worlds can show; nothing if the settings of the job are not valid.

    Args:
        plan: Plan of the study, None if it is not valid.
    """
    from pfbench.job.settings import check_settings

    if plan is None:
        return
    try:
        check_settings(plan.first.values)
        sentence = plan.describe_size()
    except Exception:  # a setting or a scenario is not valid: the job reports the error
        return
    if sentence:
        print(sentence, flush=True)


def run_sweep(
    application: Callable[[], Any],
    words: Sequence[str],
    plan: StudyPlan | None,
    *,
    is_part: bool = False,
) -> None:
    """Run all jobs of a sweep and print their counts.

    Args:
        application: Application of Hydra, which reads its words from `sys.argv`.
        words: Flags and overrides.
        plan: Plan of the sweep, None if it is not valid.
        is_part: Whether more runs may follow, so that the next command is not printed.
    """
    sys.argv = ["pfbench run", *words]
    sweep = SweepProgress.start(plan)
    try:
        with hide_hydra_line():
            run_with_retries(application)
    except BaseException as error:
        sweep.finish(is_complete=False, is_part=is_part)
        if isinstance(error, Exception):
            raise summarise_failed_jobs(error, words) from error
        raise
    sweep.finish(is_part=is_part)


def delay_keys_of_swept_groups(words: Sequence[str]) -> list[str]:
    """Write each key below a swept group as a sweep of one value, which Hydra applies to the jobs alone.

    Hydra applies other keys first to a configuration without the swept choices, where they may not
    exist: `scenario=linear_walk,growth scenario.steps=15`.

    Args:
        words: Overrides and flags of a sweep.

    Returns:
        The words in the same order.
    """
    pairs = [word.partition("=") for word in words]
    groups = {key for key, _, value in pairs if "," in value and "." not in key}
    return [
        f"{key}=choice({value})"
        if key.split(".")[0] in groups and "." in key and re.fullmatch(r"[\w.+-]+", value)
        else word
        for word, (key, _, value) in zip(words, pairs, strict=True)
    ]


def run_task(cfg: Any, announce: Callable[[], None] | None = None) -> float:
    """Run one job of a Hydra application.

    Args:
        cfg: Composed configuration.
        announce: Function that is called when the data of the job are valid, before it is computed.

    Returns:
        The root mean square error of the main group, for sweepers that optimise.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from pfbench import job

    application: Any = HydraConfig.get()
    number = OmegaConf.select(
        application, "job.num", throw_on_missing=False
    )  # None outside a sweep
    total, choices = os.environ.get(SWEEP_JOBS), application.runtime.choices
    end_with_parent()
    counter = "" if number is None else f"[{number + 1}{f'/{total}' if total else ''}] "
    try:
        outcome = job.run(cfg, choices, counter, announce)
    except Exception as error:
        note_outcome(number, "failed")
        if number is None:
            raise
        name = " / ".join(str(choices[group]) for group in ("scenario", "noise", "filter"))
        words = list(application.overrides.task)
        raise report_failed_job(error, counter, name, words) from error
    note_outcome(number, outcome.status)
    return outcome.rmse


def run_with_retries(sweep: Callable[[], Any]) -> None:
    """Run a sweep, and repeat it if joblib or Ray lost one of its processes.

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
            if not _LOST_PROCESS & {parent.__name__ for parent in type(error).__mro__}:
                raise
            start_work()
            if not remaining:
                packages = os.environ.get(ENVIRONMENT)
                trusted = [f"trust=[{packages}]"] if packages else []
                raise RuntimeError(
                    "memory must be enough for all processes of the sweep, got a process that was "
                    f"killed {_RETRIES + 1} times. Finished jobs are kept. Use fewer processes "
                    "(hydra.launcher.n_jobs=2 or hydra.launcher.ray.init.num_cpus=2) or limit each "
                    "job by memory_limit_gib=... (GiB). Then repeat the command: "
                    f"{shlex.join(['pfbench', 'run', *sys.argv[1:], *trusted])}"
                ) from error
            message = "warning run: a process of the sweep was killed. Running the remaining jobs"
            print(message, file=sys.stderr)
            if "ray" in sys.modules:
                sys.modules["ray"].shutdown()  # the next attempt starts new processes of Ray
