"""Results of a study as one long table: one row per job, run, component and metric."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.results import metrics, status, store
from pfbench.results.conditions import (
    Condition,
    JobFile,
    component_groups,
    load_conditions,
    main_component_group,
)
from pfbench.stats.error_measures import convergence_time
from pfbench.stats.run_dependence import select_independent_runs

log = logging.getLogger("pfbench")

_WHOLE_RUN_ARRAYS = ("log_evidence", "evidence_floor", "lost", "health", "pareto_k", "run")
_SHARED_ARRAYS = ("time", "pcrb", "range")  # without an axis of runs


def load_frame(
    study: str,
    results: str | Path = "results",
    *,
    start_time_s: float = 0.0,
    allow_mixed_versions: bool = False,
    convergence_threshold: Mapping[str, float] | None = None,
) -> pd.DataFrame:
    """Read all metrics of all runs of a study.

    Runs with the errors of another run are left out, as in a report, and a warning states them.
    """
    conditions = load_conditions(study, results, allow_mixed_versions=allow_mixed_versions)
    rows = [
        to_long_rows(condition, job, job.load(), start_time_s, convergence_threshold or {})
        for condition in conditions
        for job in condition.jobs
    ]
    table = pd.concat(rows, ignore_index=True)
    independent, sentence = select_independent_runs(table, list_main_groups(conditions))
    if sentence:
        log.warning("warning  study %s: %s", study, sentence)
    return independent


def list_main_groups(conditions: Sequence[Condition]) -> dict[tuple[str, str, str], str]:
    """Return the main group by scenario, noise and model."""
    return {
        (c.scenario, c.noise, c.model): main_component_group(c.jobs[0].meta["state"]).group
        for c in conditions
    }


def select_indices(size: int, most: int = 180) -> np.ndarray:
    """Select at most `most` evenly spaced indices of `size`."""
    return np.unique(np.linspace(0, size - 1, min(size, most)).astype(int))


def drop_before(result: store.JobResult, start_time_s: float) -> store.JobResult:
    """Remove the steps before a time.

    Returns the job without earlier steps.
    """
    time = result.data["time"]
    mask = time >= start_time_s
    require(
        mask.any(),
        "report.start_time_s",
        f"be at most {time[-1]} s, the end of {result.meta['key']}",
        f"{start_time_s} s",
        "Use a smaller value.",
    )
    return select_steps(result, mask)


def select_steps(result: store.JobResult, mask: np.ndarray) -> store.JobResult:
    """Select steps; scores without a selected step are removed.

    Shapes: mask [T].
    """
    if mask.all():
        return result
    selected = {
        name: array
        if name in _WHOLE_RUN_ARRAYS
        else array[mask]
        if name in _SHARED_ARRAYS
        else array[:, mask]
        for name, array in result.data.items()
        if name not in ("score_steps", *metrics.scored_arrays())
    }
    return store.JobResult(result.meta, selected | _select_scores(result.data, mask))


class MetricColumn(NamedTuple):
    """Values of one metric and component.

    Attributes:
        metric: Name of the metric.
        value: Values of the runs, [R].
        group: Name of the group.
        component: Name of the component.
        unit: Unit.
    """

    metric: str
    value: np.ndarray
    group: str
    component: str
    unit: str


def to_long_rows(
    condition: Condition,
    job: JobFile,
    result: store.JobResult,
    start_time_s: float,
    converged: Mapping[str, float],
) -> pd.DataFrame:
    """Return the rows of one job; see `load_frame`."""
    lost = result.data["lost"]
    scored = drop_before(result, start_time_s)
    keeps = status.keeps_track(scored.data, scored.meta)
    columns = [*_metric_rows(scored), *_convergence(result, converged)]
    first, runs, repeats = job.meta.get("first_run", 0), lost.size, len(columns)
    names = {
        name: np.repeat(np.array([getattr(column, name) for column in columns], dtype=object), runs)
        for name in ("group", "component", "unit", "metric")
    }
    value = np.concatenate([column.value for column in columns]).astype(np.float64)
    head = {
        "study": job.meta["study"],
        "key": job.meta["key"],
        "scenario": condition.scenario,
        "family": status.scenario_family(job.meta, condition.scenario),
        "noise": condition.noise,
        "model": condition.model,
        "filter": job.meta["choices"]["filter"],
        "label": job.label,
        "particles": pd.array([job.meta.get("particles")] * len(value), dtype="Int64"),
        "seed": job.meta["seed"],
        "run": np.tile(np.arange(first, first + runs), repeats),
        "lost": np.tile(lost, repeats),
        "keeps_track": np.tile(keeps, repeats),
    }
    return pd.DataFrame({**head, **names, "value": value}, index=range(len(value)))


def _select_scores(data: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Select scores at the steps of a mask [T], with their new step numbers."""
    if "score_steps" not in data or not (remaining := mask[data["score_steps"]]).any():
        return {}
    names = [name for name in metrics.scored_arrays() if name in data]
    scores = {name: data[name][:, remaining] for name in names}
    return {"score_steps": (np.cumsum(mask) - 1)[data["score_steps"][remaining]], **scores}


def _metric_rows(result: store.JobResult) -> Iterator[MetricColumn]:
    """Yield the values of R runs per metric and component."""
    scopes: tuple[metrics.MetricScope, ...] = ("components", "group", "job")
    for scope in scopes:
        entries = [metric for metric in metrics.METRICS if metric.scope == scope]
        for data in metrics.data_by_scope(result, scope):
            group = data.group.group if data.group else data.state_group
            for metric in entries:
                unit = data.group.unit if metric.is_of_group and data.group else metric.unit
                for component, value in metric.compute(data).items():
                    yield MetricColumn(metric.name, value, group, component, unit)


def _convergence(result: store.JobResult, converged: Mapping[str, float]) -> Iterator[MetricColumn]:
    """Yield the convergence time of each group with a bound, from the start of the record."""
    for group in component_groups(result.meta["state"]):
        if group.group in converged:
            error = result.data["error"][..., group.places].astype(np.float64) * group.scale
            time, lost = result.data["time"], result.data["lost"]
            when = convergence_time(time, error, lost, converged[group.group])
            yield MetricColumn("converged", when, group.group, "norm", "s")
            share = np.minimum(when, time[-1]) / time[-1]
            yield MetricColumn("time_to_converge", share, group.group, "norm", "")
