"""Command `pfbench run`: run one job, or a sweep with -m."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pfbench.cli.command import Command
from pfbench.cli.compose import (
    StudyPlan,
    check_words,
    given_keys,
    plan_study,
    replace_config_dir,
    wants_until_decided,
)
from pfbench.cli.progress import Sweep, SweepCounter, SweepJobError, list_repeats, reported_failure
from pfbench.cli.terminal import end_with_parent
from pfbench.files.command_start import start_work
from pfbench.files.reader_notes import SWEEP_LOG
from pfbench.job.config import JobConfig, register_experiments
from pfbench.job.settings import check_settings
from pfbench.job.trust import ENVIRONMENT, trusted_packages
from pfbench.results.paper_block import conf_dir

_RETRIES = 3  # of a sweep that lost a process, as many as Ray allows

# errors of joblib and Ray about a process that another program ended
_LOST_PROCESS = {
    "TerminatedWorkerError", "LocalRayletDiedError", "NodeDiedError", "ObjectLostError",
    "OwnerDiedError", "RaySystemError", "WorkerCrashedError",
}  # fmt: skip

DRY_RUN = "--dry-run"


def run_jobs(words: Sequence[str]) -> None:
    """Run one job, or a sweep."""
    register_experiments()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    args, plan = check_words(replace_config_dir([word for word in words if word != DRY_RUN]))
    overrides, is_sweep = args.overrides, args.multirun
    if args.cfg or args.info:
        print_configuration(args)
        return
    if plan and is_sweep:
        plan.check_comparable()
    if DRY_RUN in words:
        from pfbench.cli.dry_run import print_dry_run

        print_dry_run(plan or plan_study(overrides), is_sweep=is_sweep)
        return
    if plan:
        _try_parts(plan)
        print_surprise(plan, overrides, is_sweep=is_sweep)
    if plan and wants_until_decided(plan):
        _run_until_decided(overrides, plan, is_sweep=is_sweep)
    elif is_sweep:
        print_study_size(plan)
        run_sweep(overrides, plan)
    else:
        _run_alone(overrides, plan)


def _try_parts(plan: StudyPlan) -> None:
    """Try the own parts of a plan before its first job."""
    if plan.first.trusted or trusted_packages():
        from pfbench.cli.dry_run import try_own_parts  # which imports torch

        try_own_parts(plan.compose_parts())


def _run_until_decided(overrides: Sequence[str], plan: StudyPlan, *, is_sweep: bool) -> None:
    """Run a sweep that adds runs until its pairs are decided."""
    from pfbench.cli.until_decided import GrowingSweep

    sweep = GrowingSweep.from_plan(plan, is_sweep=is_sweep)
    others = [word for word in overrides if not re.match(r"(runs|first_run)=", word)]
    sweep.run(lambda more: run_sweep([*others, *more], plan, is_part=True))


def _run_alone(overrides: Sequence[str], plan: StudyPlan | None) -> None:
    """Run one job, and print what its runs can show once its data are valid."""
    # what was checked is what runs, unless a word may have another value in Hydra's application
    checked = plan.first if plan and not any("${" in word for word in overrides) else None

    with hide_hydra_line():
        run_application(
            lambda cfg: run_task(cfg, lambda: print_study_size(plan), checked),
            overrides,
            is_sweep=False,
        )


def print_surprise(plan: StudyPlan, words: Sequence[str], *, is_sweep: bool) -> None:
    """Say first what a command does that its words do not show: defaults alone, or one job of an experiment."""
    keys, choices = given_keys(words), plan.first.choices
    if not is_sweep and "experiment" in keys and plan.jobs > 1:
        note = (
            f"{plan.jobs} jobs belong to the experiment, and without -m one of them runs. "
            f"Run all: pfbench run -m {shlex.join(words)}"
        )
    elif not keys & {"scenario", "filter", "experiment"}:
        names = " ".join(f"{key}={choices[key]}" for key in ("scenario", "noise", "filter"))
        note = f"one job of the defaults runs: {names} runs={plan.first.values['runs']}. Choose others: pfbench list"
    else:
        return
    print(f"note: {note}", file=sys.stderr, flush=True)


def print_study_size(plan: StudyPlan | None) -> None:
    """Print what the chosen runs and worlds can show; nothing if the settings of the job are not valid."""
    with contextlib.suppress(Exception):  # a setting or a scenario: the job reports the error
        if plan is not None:
            check_settings(plan.first.values)
            if sentence := plan.describe_size():
                print(sentence, flush=True)


def run_sweep(overrides: Sequence[str], plan: StudyPlan | None, *, is_part: bool = False) -> None:
    """Run all jobs of a sweep and print their counts."""
    sys.argv = ["pfbench run", "-m", *overrides]  # what is to be repeated if a process is lost
    sweep = None
    if plan is not None:  # else the sweep itself reports the error
        sweep = Sweep.of_jobs(plan.first, plan.jobs)
        os.environ[SWEEP_LOG] = str(sweep.file)
    is_complete = False
    try:
        with hide_hydra_line():
            run_with_retries(lambda: run_application(run_task, overrides, is_sweep=True))
        is_complete = True
    except Exception as error:
        raise summarise_failed_jobs(error, overrides) from error
    finally:
        os.environ.pop(SWEEP_LOG, None)
        if is_complete or (sweep and sweep.file.is_file()):
            start_work()  # in another process, for most launchers
        if sweep and plan and plan.has_one_study:
            _print_end(sweep, is_complete=is_complete, is_part=is_part)


def _print_end(sweep: Sweep, *, is_complete: bool, is_part: bool) -> None:
    """Print the counts of a sweep, the failed jobs with the words that repeat them, and the next command."""
    counts = f"{sweep.count(is_complete)} in {time.time() - sweep.start_time:.0f} s."
    has_page = any(sweep.folder.glob("*.npz")) and not is_part
    command = f"  Next: pfbench report study={sweep.folder.name}" if has_page else ""
    print(f"sweep: {counts}{command}", *list_repeats(sweep.folder, sweep.start_time), sep="\n")


def run_task(
    cfg: Any, announce: Callable[[], None] | None = None, checked: JobConfig | None = None
) -> float:
    """Run one job of a Hydra application, by its configuration that is resolved and checked if there is one.

    Returns the median over runs of the RMS error of the main group, for sweepers that optimise.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from pfbench import job

    application: Any = HydraConfig.get()
    choices, words = application.runtime.choices, list(application.overrides.task)
    end_with_parent()

    def run_job(counter: object) -> job.JobOutcome:
        # of the words that Hydra does not count to the task of a job
        path = [
            w for w in map(str, application.overrides.hydra) if w.startswith("hydra.searchpath=")
        ]
        packages = os.environ.get(ENVIRONMENT)
        places = [*path, *([f"trust=[{packages}]"] if packages else [])]
        config = checked or job.resolve_config(cfg, choices, words=[*words, *places])
        return job.run(config, choices, counter, announce)

    number = OmegaConf.select(application, "job.num", throw_on_missing=False)
    if number is None:  # outside of a sweep
        return run_job("").rmse
    counter = SweepCounter(number, Sweep.from_file(os.environ.get(SWEEP_LOG, "")))
    try:
        with reported_failure(counter, choices, words):
            outcome = run_job(counter)
    except SweepJobError:
        counter.note("failed")
        raise
    counter.note(outcome.status)
    return outcome.rmse


def run_with_retries(sweep: Callable[[], Any]) -> None:
    """Run a sweep, and repeat it if joblib or Ray lost one of its processes."""
    for remaining in reversed(range(_RETRIES + 1)):
        try:
            sweep()
            return
        except Exception as error:
            if not _LOST_PROCESS & {parent.__name__ for parent in type(error).__mro__}:
                raise
            start_work()
            loss = (
                str(error).strip().split("\n")[-1] or type(error).__name__
            )  # joblib's has the exit codes
            if not remaining:
                packages = os.environ.get(ENVIRONMENT)
                trusted = [f"trust=[{packages}]"] if packages else []
                raise RuntimeError(
                    f"the processes of a sweep must last, got lost ones {_RETRIES + 1} times ({loss}). "
                    "Finished jobs are kept. If the system killed them (SIGKILL), memory is short: use fewer processes "
                    "(hydra.launcher.n_jobs=2 or hydra.launcher.ray.init.num_cpus=2), or limit each job by "
                    "memory_limit_gib=... (GiB). Else their own lines above state the reason. Repeat the command: "
                    f"{shlex.join(['pfbench', 'run', *sys.argv[1:], *trusted])}"
                ) from error
            message = f"warning run: the sweep lost a process ({loss}). Running the remaining jobs"
            print(message, file=sys.stderr)
            if "ray" in sys.modules:
                sys.modules["ray"].shutdown()  # the next attempt starts new processes of Ray


_HYDRA_LINE = "Error executing job with overrides"

_OTHER_TERMINAL = ("slurm", "ray_cluster")  # launchers whose jobs print elsewhere


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


def summarise_failed_jobs(error: Exception, words: Sequence[str]) -> Exception:
    """Return the error that ends a sweep."""
    if isinstance(error, SweepJobError):
        start_work()  # a job that cannot start fails in a sweep: the other jobs run
    launcher = next((w.partition("=")[2] for w in words if w.startswith("hydra/launcher=")), "")
    if not isinstance(error, SweepJobError) or launcher in _OTHER_TERMINAL:
        return error
    return SweepJobError(
        "all jobs of the sweep must finish, got failed jobs. Their lines above give the reasons. "
        "Correct them, and repeat the command to run them again."
    )


# --------------------------------------------------------------------------------------------------
# Hydra's application, by the loader of pfbench.


@contextmanager
def _application() -> Iterator[Any]:
    """Open Hydra's application, whose loader checks what it loads."""
    from hydra import version
    from hydra._internal import utils
    from hydra._internal.hydra import Hydra
    from hydra.core.global_hydra import GlobalHydra

    from pfbench.job.shared_loader import SharedLoader

    version.setbase("1.3")
    application = Hydra("run", SharedLoader(utils.create_config_search_path(str(conf_dir()))))
    GlobalHydra.instance().initialize(application)
    try:
        yield application
    finally:
        GlobalHydra.instance().clear()


def run_application(
    task: Callable[[Any], Any], overrides: Sequence[str], *, is_sweep: bool
) -> None:
    """Run a task for each job of overrides, as `hydra.main` does."""
    from hydra._internal import utils

    with _application() as application:
        words = list(overrides)
        utils._run_app(
            run=not is_sweep,
            multirun=is_sweep,
            mode=application.get_mode("config", words) if _can_set_mode(words) else None,
            hydra=application,
            config_name="config",
            task_function=task,
            overrides=words,
        )


def print_configuration(args: Any) -> None:
    """Print what the flags `--cfg` and `--info` ask for."""
    with _application() as application:
        if args.cfg:
            more = args.cfg, args.package, args.resolve
            application.show_cfg("config", args.overrides, *more)
        else:
            application.show_info(args.info, "config", args.overrides)


def _can_set_mode(overrides: Sequence[str]) -> bool:
    """Return whether overrides can set `hydra.mode`, which no file of pfbench sets. Other files need a search path."""
    return any(re.match(r"[+~]*hydra\b", word) for word in overrides)


COMMAND = Command(
    run_jobs,
    """\
pfbench run [-m] key=value ...

Run one job (one filter in one condition), or with -m a sweep over comma-separated values.
Finished jobs are skipped: repeat an interrupted command to resume.

  pfbench run scenario=flight_300s noise=nominal filter=sir runs=100 seed=1
  pfbench run -m scenario=flight_300s filter=ekf,sir noise=nominal,outliers study=mine
  pfbench run -m +experiment=quickstart
  pfbench run -m +experiment=quickstart hydra/launcher=cores     on all cores
  pfbench run --dry-run -m scenario=flight_300s filter=ekf,sir runs=100
                             prints jobs, memory and time, and runs nothing
  pfbench run -m scenario=flight_300s filter=ekf,sir study=mine runs=until-decided
                             adds runs until each pair of filters is decided

  pfbench list               scenarios, noise regimes, filters and experiments
  pfbench run --cfg job      all keys with their values""",
)
