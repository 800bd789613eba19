"""Selection of one run of one job of a study by words: filter, scenario, noise, model, number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.results import store
from pfbench.results.conditions import (
    Condition,
    JobFile,
    load_conditions,
    parse_label,
)
from pfbench.results.joined_runs import select_run
from pfbench.stats.study_runs import natural_sort_key

_GROUPS = ("scenario", "noise", "model")


class StoredRun(NamedTuple):
    """A stored run.

    Attributes:
        condition: Condition of the job.
        job: Job of the run.
        run: Number of the run.
        result: Metadata of the job, and its arrays with this run alone.
    """

    condition: Condition
    job: JobFile
    run: int
    result: store.JobResult


def find_run(
    study: str, results: str | Path, run: int, label: str, choices: Mapping[str, str]
) -> StoredRun:
    """Find one run of a study."""
    plain = {group: parse_label(value)[0] for group, value in choices.items()}
    keys = _matching_keys(Path(results) / study, plain)
    conditions = load_conditions(study, results, allow_mixed_versions=True, keys=keys)
    matches = [
        (condition, job)
        for condition in _select_data(conditions, choices)
        for job in condition.jobs
        if label in (job.label, job.meta["choices"]["filter"])
    ]
    if not matches:
        labels = {job.label for condition in conditions for job in condition.jobs}
        raise ValueError(
            f"filter must be a filter of the study {study}, got {label}. Choose from {_list_names(labels)}."
        )
    _check_single(matches, label)
    condition, job = matches[0]
    result = job.load()
    numbers = _run_numbers(result)
    require(
        run in numbers,
        "run",
        f"be a run of {job.label}, {numbers.min()} to {numbers.max()}",
        run,
        f"Set run={numbers.min()}.",
    )
    return StoredRun(condition, job, run, select_run(result, int(np.argmax(numbers == run))))


def _select_data(
    conditions: Sequence[Condition], choices: Mapping[str, str]
) -> Sequence[Condition]:
    """Select the conditions of settings of scenario and noise such as "flight[gps_sd=2.0]"."""
    for group, value in choices.items():
        names = {str(getattr(condition, group)) for condition in conditions}
        require(
            "[" not in value or value in names,
            group,
            "be one of the study",
            value,
            f"Choose from {_list_names(names)}.",
        )
        conditions = [c for c in conditions if "[" not in value or getattr(c, group) == value]
    return conditions


def _matching_keys(folder: Path, choices: Mapping[str, str]) -> list[str] | None:
    """Return the keys of the jobs of a folder with some choices; None for all."""
    if not choices:
        return None
    names = {path.stem: _read_choices(path) for path in folder.glob("*.npz")}
    for group, value in choices.items():
        values = {job.get(group, "") for job in names.values()}
        require(
            not names or value in values,
            group,
            f"be one of the study {folder.name}",
            value,
            f"Choose from {_list_names(values)}.",
        )
    keys = [
        key
        for key, job in names.items()
        if all(job.get(group) == value for group, value in choices.items())
    ]
    if names and not keys:
        words = " ".join(f"{group}={value}" for group, value in choices.items())
        raise ValueError(
            f"scenario, noise and model must be a condition of the study {folder.name}, got {words}. "
            f"Leave out one of them."
        )
    return keys


def _read_choices(path: Path) -> dict[str, str]:
    """Return the choices of a job by group; empty for a file that is damaged or no result."""
    try:
        choices = store.read_metadata(path)["choices"]
    except (ValueError, OSError):
        return {}
    return {group: str(choices.get(group, "")) for group in _GROUPS}


def _check_single(matches: Sequence[tuple[Condition, JobFile]], label: str) -> None:
    """Raise ValueError if several jobs match."""
    if len(matches) == 1:
        return
    labels = {job.label for _, job in matches}
    conditions = [condition for condition, _ in matches]
    names = {
        group: {str(getattr(condition, group)) for condition in conditions} for group in _GROUPS
    }
    several = [group for group in _GROUPS if len(names[group]) > 1]
    require(
        len({condition.name for condition in conditions}) != 1,
        "filter",
        "name one job",
        f"{label} with {len(labels)} settings",
        f"Choose from {_list_names(labels)}.",
    )
    advice = ", ".join(f"{group}=... ({_list_names(names[group])})" for group in several)
    raise ValueError(
        f"{' and '.join(several)} must be set, since {label} has results in "
        f"{len({c.name for c in conditions})} conditions. Add {advice}."
    )


def _run_numbers(result: store.JobResult) -> np.ndarray:
    """Return the numbers of the runs of a job, [R]."""
    if "run" in result.data:
        return np.asarray(result.data["run"])
    return int(result.meta.get("first_run", 0)) + np.arange(result.data["lost"].size)


def _list_names(names: set[str]) -> str:
    """Format names in natural order."""
    return ", ".join(sorted(names, key=natural_sort_key))
