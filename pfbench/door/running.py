"""Run and training of filters from Python: the jobs of the command line, in this process or in several."""

from __future__ import annotations

import contextlib
import copy
import logging
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import pfbench
from pfbench.cli.list import add_search_path
from pfbench.cli.progress import Sweep, SweepCounter, list_repeats, log
from pfbench.core.parameter_checks import require
from pfbench.door.own_parts import find_group, make_own
from pfbench.door.parts import (
    Part,
    add_changes,
    describe_value,
    format_words,
    get_part,
    place_words,
    plain_errors,
)
from pfbench.door.study import Study, open_study
from pfbench.door.worker import COUNTER, JobReply, WorkerPool, logging_to, run_request
from pfbench.job.config import CHOICES, FILTER_SETS, JobConfig, compose
from pfbench.job.run_job import list_used_packages
from pfbench.job.settings import check_settings
from pfbench.job.trust import trusting
from pfbench.results.conditions import JobFile


def run_filters(  # noqa: PLR0913 - what `help` shows and an editor completes
    scenario: str | Part | list[Any] | Any,
    filters: str | Part | list[Any] | Any,
    *,
    noise: str | Part | list[Any] | Any = "nominal",
    model: str | Part | list[Any] | Any = None,
    runs: int = 50,
    particles: int = 500,
    seed: int = 1,
    study: str = "notebook",
    workers: int = 1,
    progress: bool = True,
    **settings: Any,
) -> Study:
    """Run filters in scenarios, as `pfbench run -m` does: finished jobs are skipped.

    Args:
        scenario: Name, part or class of your own, or a list of them. A model is simulated for 100 steps.
        filters: Names, named sets, parts, or filters and stages of your own; one or a list.
        noise: Noise regime, or a list of them.
        model: Model of the filters. That of the scenario by default.
        runs: Number of Monte Carlo runs, which all filters share.
        particles: Number for each particle filter that states none of its own.
        seed: With the number of a run it determines all random numbers.
        study: Name of the study.
        workers: Number of processes.
        progress: Whether each job prints a line.
        **settings: Other settings by key. What is computed: `first_run`, `oracle_noise`, `pcrb`, `score_steps`, `budget`,
            `checkpoint`. How: `dtype`, `device`, `threads`, `engine`, `memory_limit_gib`, `overwrite`. Where:
            `results_dir`, `reports_dir`, `episode_cache_dir`. Keys of a part have two underscores for a point, such as
            `scenario__steps=200`. `pfbench run --cfg job` prints all with their values.

    Returns:
        The study, which also holds results of earlier runs.

    Raises:
        ValueError: If a name, a value or a class is not valid. Nothing was run.
        RuntimeError: If no job finished.
    """
    require(
        type(workers) is int and (not workers < 1),
        "workers",
        "be a whole number of at least 1",
        f"{workers!r}",
        "Set workers=2.",
    )
    groups = {"scenario": scenario, "noise": noise, "model": model, "filter": filters}
    if model is None:  # that of the scenario
        del groups["model"]
    parts = [list_parts(group, value) for group, value in groups.items()]
    settings_of_all = {"runs": runs, "particles": particles, "seed": seed}
    words = format_words({**settings_of_all, **settings, "study": study})
    jobs = [
        [*(word for item in choice for word in item.words()), *words, *place_words(choice)]
        for choice in product(*parts)
    ]
    configs = [_compose_job(list(job)) for job in dict.fromkeys(map(tuple, jobs))]
    if any(map(list_used_packages, configs)):
        from pfbench.cli.dry_run import try_own_parts

        with preserved_process(), plain_errors(words):
            try_own_parts(configs)
    _run_jobs(configs, workers, progress)
    values = configs[0].values
    packages = dict.fromkeys(name for config in configs for name in config.trusted)
    return open_study(
        values["study"], values["results_dir"], values["reports_dir"], trust=tuple(packages)
    )


@plain_errors()
def list_parts(group: str, value: Any) -> list[Part]:
    """Return the parts of a group that a name, a part, an object or a list of them means."""
    items = list(value) if isinstance(value, list | tuple | set) else [value]
    require(
        items,
        group,
        "be at least one",
        "an empty list",
        f"List the names: pfbench.names({group!r}).",
    )
    sets = FILTER_SETS if group == "filter" else {}
    members = [sets.get(item, (item,)) if isinstance(item, str) else (item,) for item in items]
    return [_make_part(group, item) for several in members for item in several]


def _make_part(group: str, item: Any) -> Part:
    """Return the part of one item."""
    if isinstance(item, str):
        return get_part(group, item)
    if item is None or isinstance(item, bool | int | float | dict):
        raise TypeError(
            f"{group} must be a name, a part or a class, got {describe_value(item)}. List the names: pfbench.names({group!r})."
        )
    kind = item.group if isinstance(item, Part) else find_group(item)[0]
    if group == "scenario" and kind == "model":  # which is simulated for 100 steps
        if isinstance(item, Part) and not item.folders:
            return add_changes(get_part("scenario", item.name), item.changes)
        return make_own(pfbench.scenario.ModelSimulation, model=item, steps=100)
    require(
        kind == group,
        group,
        f"be a {group}",
        f"the {kind} {item if isinstance(item, Part) else describe_value(item)}",
        f"Pass it as {kind}=...",
    )
    return item if isinstance(item, Part) else make_own(item)


def _compose_job(words: list[str]) -> JobConfig:
    """Compose and check the configuration of a job. Raises ValueError with the sentence of the command line."""
    with plain_errors(words):
        config = compose(add_search_path(words))
        check_settings(config.values)
    return config


def continue_jobs(study: Study, runs: int, workers: int, progress: bool) -> None:
    """Run more runs of all jobs of a study, after the last one that each has."""
    configs = [
        _continue_job(job, runs, study.trust)
        for condition in study.conditions()
        for job in condition.jobs
    ]
    for config in configs:
        check_settings(config.values)
    _run_jobs(configs, workers, progress)


def _continue_job(job: JobFile, runs: int, trusted: Sequence[str]) -> JobConfig:
    """Return the configuration of the next runs of a stored job."""
    meta = job.meta
    check_trusted(meta, trusted)
    values = copy.deepcopy(meta["config"])
    values |= {"runs": runs, "first_run": int(meta["first_run"]) + int(meta["runs"])}
    values |= {"overwrite": False}
    choices = {group: str(meta["choices"][group]) for group in CHOICES}
    is_shared = bool(meta.get("budget_allocation"))
    return JobConfig(values, choices, is_shared, tuple(trusted))


def check_trusted(meta: Mapping[str, Any], trusted: Sequence[str]) -> None:
    """Check that a study is opened with trust in the packages whose classes a stored job uses."""
    missing = [name for name in meta.get("trusted", ()) if name not in trusted]
    require(
        not missing,
        "trust",
        f"name the packages whose classes the study uses, {', '.join(missing)}",
        "none of them",
        f"If you still trust them, open it by pfbench.study({meta['study']!r}, trust={tuple(missing)}).",
    )


def _run_jobs(configs: Sequence[JobConfig], workers: int, progress: bool) -> None:
    """Run jobs and print a line of each, the counts, and the words that repeat failed jobs."""
    total, sweep = len(configs), Sweep.of_jobs(configs[0], len(configs))
    failed: list[str] = []
    printed = logging_to(logging.StreamHandler(sys.stdout))
    with printed if progress else contextlib.nullcontext():
        try:
            for number, reply in _replies(configs, workers):
                counter = str(SweepCounter(number, sweep))
                for line in reply.lines:
                    log.info("%s", line.replace(COUNTER, counter))
                sweep.note(number, reply.status)
                failed += [reply.message] if reply.status == "failed" else []
        finally:
            log.info("run: %s in %.0f s", sweep.count(), time.time() - sweep.start_time)
            for line in list_repeats(sweep.folder, sweep.start_time):
                log.info("%s", line)
    if len(failed) == total:
        raise RuntimeError(failed[0])
    if failed and not progress:
        log.warning("%d of %d jobs failed: %s. List them: study.failed()", len(failed), total, failed[0].rstrip("."))  # fmt: skip


def _replies(configs: Sequence[JobConfig], workers: int) -> Iterator[tuple[int, JobReply]]:
    """Yield the numbers and the replies of jobs as they end."""
    if workers > 1 and len(configs) > 1:
        with WorkerPool(min(workers, len(configs))) as pool:
            yield from pool.run(configs)
        return
    with preserved_process():  # which imports torch, that workers import themselves
        for number, config in enumerate(configs):
            yield number, run_request(vars(config))


@contextlib.contextmanager
def preserved_process() -> Iterator[None]:
    """Restore the threads of torch and the environment after jobs, which set both."""
    import torch

    threads, environment = torch.get_num_threads(), dict(os.environ)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        for name in set(os.environ) - set(environment):
            del os.environ[name]
        os.environ.update(environment)


def train_filter(
    scenario: Any,
    method: Any,
    *,
    objective: str = "vsmc",
    noise: Any = "nominal",
    model: Any = None,
    study: str = "notebook",
    progress: bool = True,
    **settings: Any,
) -> Part:
    """Train the network of a filter, or load it if the same training is finished.

    Training runs have other numbers than those that `run` compares.

    Args:
        scenario: Name, part or class of your own.
        method: Filter with a network, such as `neural_sir`, or the class of a network of your own. It is a module of
            torch, made of a number of features and a dimension of the noise. See `pfbench.filter.LearnedProposal`.
        objective: What is trained for: a name of the group `train`.
        noise: Noise regime.
        model: Model of the filter. That of the scenario by default.
        study: Folder of the checkpoint.
        progress: Whether each epoch prints a line.
        **settings: Settings of the training by key, such as `epochs=20` or `training_runs=64`.

    Returns:
        The filter with its trained weights, for `run`.

    Raises:
        ValueError: If a name or a value is not valid, or the filter has nothing to train. Nothing was trained.
    """
    from pfbench.cli.tune import fit_network

    values = {"scenario": scenario, "noise": noise, "model": model, "filter": method}
    parts = [_find_part(group, value) for group, value in values.items() if value is not None]
    words = [word for item in parts for word in item.words()]
    words += [f"train={objective}", *(f"train.{word}" for word in format_words(settings))]
    words += [*format_words({"study": study}), *place_words(parts)]
    packages = [name for item in parts for name in item.packages]
    with plain_errors(words), preserved_process(), trusting(packages):
        path = fit_network(words, print if progress else lambda line: None)
    return add_changes(parts[-1], format_words({"checkpoint": str(path.resolve())}))


def _find_part(group: str, value: Any) -> Part:
    """Return the part of a group that is trained with; several are refused."""
    parts = list_parts(group, value)
    require(
        not len(parts) > 1,
        group,
        f"be one {group}",
        len(parts),
        "Train with each in a call of its own.",
    )
    return parts[0]
