"""Results of a study as one long table: one row per job, run, component and metric."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.results import metrics, store
from pfbench.results.error_measures import convergence_time
from pfbench.results.state_groups import component_groups

_SHARED_SETTINGS = ("scenario", "noise", "dtype")  # settings that decide the data of a filter
_LOCATION_SETTINGS = ("scenario.cache_dir", "scenario.root")  # settings that do not
_WHOLE_RUN_ARRAYS = ("log_evidence", "lost")
_SHARED_ARRAYS = ("time", "bound", "range")  # without an axis of runs
_Described = tuple[Path, dict[str, Any]]


class JobFile(NamedTuple):
    """Result file of a job; its arrays are read on demand.

    Attributes:
        path: File.
        label: Name of the filter, with the settings that distinguish it within its condition.
        meta: Metadata, see `store.Result`.
    """

    path: Path
    label: str
    meta: dict[str, Any]

    def load(self) -> store.JobResult:
        """Read the arrays and metadata."""
        return store.read_result(self.path)


class Condition(NamedTuple):
    """Jobs of all filters on the same data.

    Attributes:
        scenario: Scenario.
        noise: Noise regime.
        model: Model.
        jobs: Result files.
    """

    scenario: str
    noise: str
    model: str
    jobs: tuple[JobFile, ...]

    @property
    def name(self) -> str:
        """Name as scenario / noise / model."""
        return f"{self.scenario} / {self.noise} / {self.model}"


def load_frame(
    study: str,
    results: str | Path = "results",
    *,
    start_time_s: float = 0.0,
    allow_mixed_versions: bool = False,
    convergence_threshold: Mapping[str, float] | None = None,
) -> pd.DataFrame:
    """Read all metrics of all runs of a study.

    Args:
        study: Name of the folder in `results`.
        results: Folder of all studies.
        start_time_s: Time before which steps are ignored, in seconds.
        allow_mixed_versions: Accept several versions, and several seeds, runs or lengths within a
            condition.
        convergence_threshold: Bounds by group in displayed units. They add the metric "converged",
            in seconds.

    Returns:
        Columns study, key, scenario, noise, model, filter, label, particles, seed, run, lost,
        group, component, unit, metric, value, with the metrics of `metrics.METRICS`. A lost run has
        infinite errors and scores, and NaN elsewhere.

    Raises:
        FileNotFoundError: if the study has no results. The message lists the studies that have.
        ValueError: if files do not belong together. The message lists them.
    """
    rows = [
        to_long_rows(condition, job, job.load(), start_time_s, convergence_threshold or {})
        for condition in load_conditions(study, results, allow_mixed_versions=allow_mixed_versions)
        for job in condition.jobs
    ]
    return pd.concat(rows, ignore_index=True)


def load_conditions(
    study: str, results: str | Path = "results", *, allow_mixed_versions: bool = False
) -> list[Condition]:
    """List the conditions of a study; arguments and errors as `load_frame`.

    Args:
        study: Name of the folder in `results`.
        results: Folder of all studies.
        allow_mixed_versions: Accept several versions, and several seeds, runs or lengths within a
            condition.

    Returns:
        Conditions sorted by scenario, noise and model.
    """
    files = sorted((Path(results) / study).glob("*.npz"))
    items = [(path, store.read_metadata(path)) for path in files]
    if not items:
        raise FileNotFoundError(_no_results_message(study, Path(results)))
    if not allow_mixed_versions:
        _check_equal(items, ("versions.pfbench", "versions.commit"), "the study")
    items.sort(key=lambda item: (_condition_key(item[1]), *_job_order(item[1])))
    conditions = []
    for key, group in groupby(items, key=lambda item: _condition_key(item[1])):
        members = list(group)
        jobs = _label_jobs(members)
        if not allow_mixed_versions:
            where = f"the condition {' / '.join(key)}"
            _check_equal(members, ("seed", "first_run", "runs", "steps"), where)
            settings = [f"config.{name}" for name in unlabelled_settings(jobs)]
            _check_equal(members, settings, where)
        conditions.append(Condition(*key, jobs))
    return conditions


def differing_settings(jobs: Sequence[JobFile]) -> list[str]:
    """List settings of scenario, noise and number type in which jobs of a condition differ."""
    configs = [job.meta["config"] for job in jobs]
    flat = [_flatten({name: c.get(name) for name in _SHARED_SETTINGS}) for c in configs]
    return _differing(flat)


def unlabelled_settings(jobs: Sequence[JobFile]) -> list[str]:
    """List the differing settings that are not in every label."""
    differing = differing_settings(jobs)
    return [name for name in differing if not all(f"{name}=" in job.label for job in jobs)]


def natural_sort_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sorting key that puts 400 before 1600."""
    parts = re.split(r"(\d+)", text)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts]


def drop_before(result: store.JobResult, start_time_s: float) -> store.JobResult:
    """Remove the steps before a time.

    Args:
        result: Job.
        start_time_s: Time of the first step retained, in seconds.

    Returns:
        The job without earlier steps.

    Raises:
        ValueError: if no step remains.
    """
    time = result.arrays["time"]
    mask = time >= start_time_s
    if not mask.any():
        raise ValueError(
            f"report.start_time_s must be at most {time[-1]} s, the end of {result.meta['key']}, "
            f"got {start_time_s} s. Use a smaller value."
        )
    return select_steps(result, mask)


def select_steps(result: store.JobResult, mask: np.ndarray) -> store.JobResult:
    """Select steps by a mask [T]; scores without a selected step are removed."""
    if mask.all():
        return result
    skipped = (*_WHOLE_RUN_ARRAYS, "scored", *metrics.scored_arrays())
    selected = {
        name: array[mask] if name in _SHARED_ARRAYS else array[:, mask]
        for name, array in result.arrays.items()
        if name not in skipped
    }
    shared = {name: result.arrays[name] for name in _WHOLE_RUN_ARRAYS}
    scores = _select_scores(result.arrays, mask)
    return store.JobResult(result.meta, {**selected, **shared, **scores})


def to_long_rows(
    condition: Condition,
    job: JobFile,
    result: store.JobResult,
    start_time_s: float,
    converged: Mapping[str, float],
) -> pd.DataFrame:
    """Return the rows of one job; see `load_frame`.

    Args:
        condition: Condition of the job.
        job: File of the job.
        result: Arrays of the job.
        start_time_s: Time before which steps are ignored, in seconds.
        converged: Bounds by group in displayed units.

    Returns:
        The rows of the job.
    """
    lost = result.arrays["lost"]
    columns = [*_metric_rows(drop_before(result, start_time_s)), *_convergence(result, converged)]
    rows = pd.concat(columns, ignore_index=True)
    first, runs = job.meta.get("first_run", 0), lost.size
    repeats = len(rows) // runs
    head = {
        "study": job.meta["study"],
        "key": job.meta["key"],
        "scenario": condition.scenario,
        "noise": condition.noise,
        "model": condition.model,
        "filter": job.meta["choices"]["filter"],
        "label": job.label,
        "particles": pd.array([job.meta.get("particles")] * len(rows), dtype="Int64"),
        "seed": job.meta["seed"],
        "run": np.tile(np.arange(first, first + runs), repeats),
        "lost": np.tile(lost, repeats),
    }
    return pd.concat([pd.DataFrame(head, index=rows.index), rows], axis=1)


def _select_scores(arrays: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Select scores at the steps of a mask [T], with their new step numbers."""
    if "scored" not in arrays or not (remaining := mask[arrays["scored"]]).any():
        return {}
    names = [name for name in metrics.scored_arrays() if name in arrays]
    scores = {name: arrays[name][:, remaining] for name in names}
    return {"scored": (np.cumsum(mask) - 1)[arrays["scored"][remaining]], **scores}


def _metric_rows(result: store.JobResult) -> Iterator[pd.DataFrame]:
    """Yield one small table of R rows per metric and component."""
    scopes: tuple[metrics.Scope, ...] = ("components", "group", "job")
    for scope in scopes:
        entries = [metric for metric in metrics.METRICS if metric.scope == scope]
        for data in metrics.data_by_scope(result, scope):
            group = data.group.group if data.group else data.state_group
            for metric in entries:
                is_group_unit = metric.unit == metrics.GROUP_UNIT and data.group
                unit = data.group.unit if is_group_unit and data.group else metric.unit
                for component, value in metric.compute(data).items():
                    yield _column(metric.name, value, group, component, unit)


def _convergence(result: store.JobResult, converged: Mapping[str, float]) -> Iterator[pd.DataFrame]:
    """Yield the convergence time of each group with a bound, from the start of the record."""
    for group in component_groups(result.meta["state"]):
        if group.group in converged:
            error = result.arrays["error"][..., group.places].astype(np.float64) * group.scale
            time, lost = result.arrays["time"], result.arrays["lost"]
            when = convergence_time(time, error, lost, converged[group.group])
            yield _column("converged", when, group.group, "norm", "s")


def _column(metric: str, value: np.ndarray, group: str, component: str, unit: str) -> pd.DataFrame:
    """Return the rows of one metric and component."""
    names = {"group": group, "component": component, "unit": unit, "metric": metric}
    return pd.DataFrame({**names, "value": value.astype(np.float64)})


def _condition_key(meta: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return scenario, noise and model of a job."""
    choices = meta["choices"]
    return str(choices["scenario"]), str(choices["noise"]), str(choices.get("model", ""))


def _job_order(meta: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the sorting key of a job within its condition."""
    return meta["label"], meta["seed"], meta["key"]


def _label_jobs(items: Sequence[_Described]) -> tuple[JobFile, ...]:
    """Give each job of a condition a label of its own."""
    names = [str(meta["label"]) for _, meta in items]
    jobs = []
    for (path, meta), name in zip(items, names, strict=True):
        twins = [other for (_, other), label in zip(items, names, strict=True) if label == name]
        jobs.append(JobFile(path, _distinct_label(meta, twins), meta))
    return tuple(sorted(jobs, key=lambda job: natural_sort_key(job.label)))


def _distinct_label(meta: Mapping[str, Any], twins: Sequence[Mapping[str, Any]]) -> str:
    """Extend a label by the settings in which jobs of that label differ.

    Settings of the filter alone are used if they suffice.
    """
    if len(twins) == 1:
        return str(meta["label"])
    flat = [_flatten(twin["config"]) for twin in twins]
    names = _differing(flat)
    of_filter = [name for name in names if name.startswith("filter.")]
    if len({tuple(repr(config.get(name)) for name in of_filter) for config in flat}) == len(flat):
        names = of_filter
    config = _flatten(meta["config"])
    settings = [_setting(name.removeprefix("filter."), config.get(name, "-")) for name in names]
    return f"{meta['label']}[{','.join(settings) or meta['key']}]"


def _setting(name: str, value: Any) -> str:
    """Format a setting of a label; a class is written without its module."""
    if name.endswith("._target_"):
        return f"{name.removesuffix('._target_')}={str(value).rpartition('.')[2]}"
    return f"{name}={value}"


def _differing(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """List the settings in which flat configurations differ, without locations."""
    names = sorted(set().union(*configs) - set(_LOCATION_SETTINGS))
    return [name for name in names if len({repr(config.get(name)) for config in configs}) > 1]


def _flatten(config: Any, path: str = "") -> dict[str, Any]:
    """Flatten a configuration to dotted names; stages of a filter are numbered."""
    if isinstance(config, list) and any(isinstance(part, Mapping) for part in config):
        config = dict(enumerate(config))
    if not isinstance(config, Mapping):
        return {path: config}
    return {
        key: value
        for name, below in config.items()
        for key, value in _flatten(below, f"{path}.{name}" if path else name).items()
    }


def _check_equal(items: Sequence[_Described], names: Sequence[str], where: str) -> None:
    """Raise ValueError if jobs that are compared differ in one of `names`."""
    for name in names:
        by_value: dict[str, list[str]] = {}
        for path, meta in items:
            by_value.setdefault(str(_flatten(meta).get(name)), []).append(path.name)
        if len(by_value) > 1:
            listed = "; ".join(
                f"{value}: {_list_files(files)}" for value, files in sorted(by_value.items())
            )
            raise ValueError(
                f"{name} must be equal in {where}, but its results differ in {name} ({listed}). "
                "Delete the files that do not belong and repeat their jobs, or pass mixed=True."
            )


def _list_files(files: Sequence[str]) -> str:
    """Format up to three names of files."""
    more = f" and {len(files) - 3} more" if len(files) > 3 else ""
    return f"{', '.join(files[:3])}{more}"


def _no_results_message(study: str, results: Path) -> str:
    """State which studies have results, and the command that makes these."""
    folder = results / study
    others = sorted({path.parent.name for path in results.glob("*/*.npz")})
    notes = store.list_failures(folder)
    failed = f" ({len(notes)} jobs failed, the first with {notes[0]['message']})" if notes else ""
    available = f"Studies with results in {results}: {', '.join(others) or 'none'}."
    return f"No results in {folder}{failed}. {available} Run: pfbench run -m +experiment={study}"
