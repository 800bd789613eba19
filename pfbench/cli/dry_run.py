"""Dry run of `pfbench run`: jobs, memory and time, without a result."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from traceback import walk_tb
from typing import Any, NamedTuple

import torch

from pfbench import testing
from pfbench.cli.compose import StudyPlan
from pfbench.cli.messages import format_error, notes_of
from pfbench.cli.progress import format_duration, name_job
from pfbench.core import Episode, PhiloxStream, map_inputs
from pfbench.filter import ParticleFilter, run_filter
from pfbench.job.budget import EpisodeSource, apply_budget, estimate_job_memory
from pfbench.job.config import JobConfig
from pfbench.job.filter_pass import choose_engine, wrap_steps
from pfbench.job.inputs import find_inputs
from pfbench.job.memory import first_steps
from pfbench.job.plan import JobPlan, build_plan
from pfbench.job.run_job import find_result_path, list_used_packages
from pfbench.job.step_timing import TimingTask
from pfbench.job.trust import list_user_packages, list_user_targets, trusted_packages
from pfbench.results.conditions import select_main_group
from pfbench.testing.models import check_regime_in
from pfbench.testing.results import check_is_model

_STEPS = 10  # of the trial of a filter


class JobEstimate(NamedTuple):
    """Estimate of a job.

    Attributes:
        state: new, or skipped because its result exists.
        seconds: Time of the draws and the filter [s]; 0 for a skipped job.
        bytes: Memory at the peak; 0 for a skipped job.
    """

    state: str
    seconds: float = 0.0
    bytes: float = 0.0

    def __str__(self) -> str:
        if self.state != "new":
            return f"{self.state:9}"
        return f"new       about {format_duration(self.seconds):>6}   {self.bytes / 2**30:.2g} GiB"


def print_dry_run(plan: StudyPlan, *, is_sweep: bool) -> None:
    """Print a line for each job, and the sums."""
    configs = plan.compose_jobs() if is_sweep else [plan.first]
    estimates: list[JobEstimate] = []
    worlds = DrawnWorlds()
    for number, config in enumerate(configs):
        name = name_job(config.choices)
        try:
            estimates.append(estimate_job(config, worlds))
        except Exception as error:
            print(
                f"[{number + 1}/{len(configs)}] refused   {name}   {format_error(error, config.words)}"
            )
            continue
        print(f"[{number + 1}/{len(configs)}] {estimates[-1]}   {name}")
    fresh = [estimate for estimate in estimates if estimate.state == "new"]
    print(
        f"dry run: {len(configs)} jobs, {len(fresh)} new, {len(estimates) - len(fresh)} skipped, "
        f"{len(configs) - len(estimates)} refused; about {format_duration(sum(e.seconds for e in fresh))} in one process, "
        f"{max((e.bytes for e in fresh), default=0.0) / 2**30:.2g} GiB at the peak. Nothing was run."
    )


class DrawnWorlds:
    """Draws of a few runs of each world, which all filters share as in a sweep."""

    def __init__(self) -> None:
        self._sources: dict[str, EpisodeSource] = {}

    def draw(self, plan: JobPlan) -> tuple[EpisodeSource, float]:
        """Draw two runs. Returns them, and the time of a draw of all runs [s]; 0 for a world that was drawn.

        The time is that of what all runs share, such as a trajectory, and a part for each run.
        """
        names = ("scenario", "noise", "model", "seed", "first_run", "runs", "oracle_noise", "dtype")
        key = json.dumps([plan.values[name] for name in names], sort_keys=True)
        if key in self._sources:
            return self._sources[key], 0.0
        few, more = (EpisodeSource(replace(plan, runs=plan.runs[:n])) for n in (2, 8))
        self._sources[key] = few
        a, b = (len(source.sample().record.y) for source in (few, more))
        per_run = max(0.0, more.seconds - few.seconds) / max(1, b - a)
        return few, few.seconds + per_run * max(0, len(plan.runs) - a)


def estimate_job(config: JobConfig, worlds: DrawnWorlds) -> JobEstimate:
    """Estimate a job by a trial: all runs of the filter take a few steps of the data of two runs."""
    values = config.values
    file = find_result_path(values, find_inputs(values, config.trusted))
    if file.is_file() and not values["overwrite"]:
        return JobEstimate("skipped")
    scenario = values["scenario"]
    changes = {"cache_dir": None} if "cache_dir" in scenario else {}  # it stores no episodes
    plan = build_plan(replace(config, values={**values, "scenario": {**scenario, **changes}}))
    source, seconds = worlds.draw(plan)
    episode = source.sample()
    small, _ = apply_budget(replace(plan, runs=plan.runs[:2]), source)
    plan = replace(plan, method=small.method)
    seconds += _time_filter(plan, episode)
    return JobEstimate("new", seconds, estimate_job_memory(plan, episode).peak(len(plan.runs)))


def _time_filter(plan: JobPlan, episode: Episode) -> float:
    """Measure some steps of all runs, whose data are copies of those of the episode; return the time of all steps [s]."""
    model, runs = plan.make_filter_model(episode), len(plan.runs)
    steps = episode.record.y.shape[1]
    short = first_steps(model, episode.record, min(_STEPS, steps))
    index = torch.arange(runs) % len(short.y)

    def copy(a: Any) -> Any:
        return a[index] if len(a) > 1 else a

    start, spread = (None if a is None else a[index] for a in (short.start, short.spread))
    record = short._replace(
        y=short.y[index], u=map_inputs(copy, short.u), start=start, spread=spread
    )
    engine = choose_engine(plan.values["engine"], plan.method, model, runs, steps)
    method = wrap_steps("tape" if engine == "tape" else "", plan.method) or plan.method
    task = TimingTask(plan, model, record, engine, method)
    # twice, since the first time also loads what the filter needs
    return steps * min(wall for _, wall in (task.measure(), task.measure()))


# --------------------------------------------------------------------------------------------------
# Trial of own parts: errors of a class of the user come before the first job, and once.


def try_own_parts(configs: Iterable[JobConfig]) -> None:
    """Try the own parts of jobs before the first one starts, so that an error of a part comes at once and once.

    Each world gives two runs. A filter of your own takes three steps of them, else a bootstrap filter does. Errors of other
    parts, such as missing data, are those of their jobs.

    Raises:
        ValueError: If parts break their contracts.
    """
    episodes: dict[str, Episode] = {}
    errors: dict[str, Exception] = {}
    has_line = False  # of the user's code
    for config in configs:
        packages = list_used_packages(config)
        try:
            if packages:
                _try_job(config, episodes)
        except AssertionError as error:
            has_line |= _is_of_user(error, packages, others=())
            classes = dict.fromkeys(t.rpartition(".")[2] for t in list_user_targets(config.values))
            errors[
                f"{' and '.join(classes)} must keep {'its' if len(classes) == 1 else 'their'} contract: {error}."
            ] = error
        except Exception as error:
            has_line = True
            if _is_of_user(error, packages):
                errors[format_error(error, config.words)] = error
    if errors:
        first = next(iter(errors.values()))
        refusal = ValueError("\n".join(errors))
        for note in notes_of(first):
            refusal.add_note(note)
        raise refusal from (first if has_line else None)


def _is_of_user(
    error: BaseException | None,
    packages: Sequence[str],
    others: tuple[str, ...] = (
        "pfbench.testing.",
    ),  # contracts that are checked for own parts only
) -> bool:
    """Return whether code of the user raised an error, or got what it does not take."""
    while error is not None:
        modules = (str(f.f_globals.get("__name__")) for f, _ in walk_tb(error.__traceback__))
        is_own = any(name.startswith((*packages, *others)) for name in modules)
        # of a model and a scenario that do not fit, one is the user's
        if is_own or isinstance(error, TypeError) or str(error).startswith("model must fit the scenario"):  # fmt: skip
            return True
        error = error.__cause__
    return False


def _try_job(config: JobConfig, episodes: dict[str, Episode]) -> None:
    """Try the parts of a job without a result; its world only if no job before has the same."""
    trusted = (*config.trusted, *trusted_packages())
    if find_result_path(config.values, find_inputs(config.values, trusted)).is_file():
        return
    plan = build_plan(config)
    check_is_model("pfbench.run", plan.model)
    groups = ("scenario", "noise", "filter")
    own_groups = {g for g in groups if list_user_packages(config.values[g], trusted)}
    world = json.dumps([plan.values[name] for name in ("scenario", "noise", "seed")], default=str)
    if world not in episodes:
        if "scenario" in own_groups:
            testing.check_scenario(plan.scenario)
        try:
            episodes[world] = plan.draw_episode(plan.runs[:2])
        finally:
            source = plan.recording_regime
            if "noise" in own_groups and source.channels is not None and source.time is not None:
                check_regime_in(source.regime, source.channels, source.time)
    _take_steps(config, plan, episodes[world], own_groups)


def _check_truth(plan: JobPlan, truth: Collection[str]) -> None:
    """Check that a scenario of the user has a truth of the main group, and misspells no other group of the model."""
    groups = plan.model.groups
    lacking = [name for name in groups if name not in truth]
    has_main = select_main_group(list(groups)) in truth
    wrong = [
        name
        for name in truth
        if name not in groups and (not has_main or get_close_matches(name, lacking, cutoff=0.5))
    ]
    if wrong or not has_main:  # as the contracts of `pfbench.testing` do
        raise AssertionError(
            f"{type(plan.scenario).__name__}.draw must name groups of {type(plan.model).__name__} ({', '.join(groups)}), got "
            f"{', '.join(map(repr, wrong or truth))}. Use these names in the truth of the episode"
        )


def _take_steps(
    config: JobConfig, plan: JobPlan, episode: Episode, own_groups: Collection[str]
) -> None:
    """Take three steps of a filter of the user, else of a bootstrap filter."""
    if "scenario" in own_groups:
        _check_truth(plan, episode.truth)
        name = type(plan.scenario).__name__
        assert (episode.time.diff() > 0).all(), f"{name}.draw must return times that increase"
        assert not episode.record.y.isinf().any(), f"{name}.draw must return finite measurements, or NaN for a missing one"  # fmt: skip
    method = plan.method if "filter" in own_groups else ParticleFilter(20)
    draws = PhiloxStream(plan.values["seed"], plan.runs[:2])
    try:
        model = plan.make_filter_model(episode).to("cpu", torch.float64)
        model.assemble(episode.truth)
        with torch.no_grad():
            trial = run_filter(method, model, first_steps(model, episode.record, 3), draws)
        if not trial.mean.isfinite().any():
            raise ValueError(
                "the estimate must be finite in the first steps, got NaN in both runs of the trial. A NaN among the weights or "
                "the states of one particle loses its run: print them"
            )
    except Exception as error:  # a model or a filter of the user took part
        raise AssertionError(format_error(error, config.words).rstrip(".")) from error
