"""Quantities of runs that claims compare."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from pfbench.results import metrics, status, store
from pfbench.results.conditions import ComponentGroup, component_groups
from pfbench.results.frame import drop_before, select_steps
from pfbench.stats.error_measures import convergence_time, mean_per_run, rmse_per_run

# metrics of the error of a group, those of the results and those of claims alone
_OF_GROUPS = {
    *(metric.name for metric in metrics.METRICS if metric.scope == "components"),
    *("mean_abs", "settled", "growth", "sd"),
}

OFF_TRACK = "off_track"
MOVED = "moved_cloud"  # of particles, which no result stores
METRIC_WORDS = {
    "rmse": "RMS error", "max_error": "largest error", "mean_abs": "mean size of the error", "settled": "time until the error stays",
    "growth": "growth of the error", "remaining": "share of the first error that remains", "sd": "standard deviation that the filter states",
    "nees": "NEES", "crps": "CRPS", "ess": "effective number", "unique": "distinct particles", "accepted": "acceptance rate",
    "seconds_per_step": "time per step", OFF_TRACK: "loss of track, 1 without and 2 with it",
    MOVED: "likelihood of the cloud before its move over that after it",
}  # fmt: skip


@dataclass(frozen=True)
class Measure:
    """Quantity of a run.

    Attributes:
        metric: Name of the metric.
        group: Group of the state, as named in reports; empty for a metric of the whole run.
        component: Component of the group, or "norm".
        start: First time, s.
        end: Last time, s.
        settled: Bound of the metric "settled", in displayed units.
    """

    metric: str
    group: str = ""
    component: str = "norm"
    start: float = 0.0
    end: float = math.inf
    settled: float = math.nan

    @property
    def name(self) -> str:
        """Name that no other quantity has."""
        return " ".join(
            f"{value:g}" if isinstance(value, float) else str(value)
            for value in (getattr(self, item.name) for item in fields(self))
        )


def measure_runs(result: store.JobResult, measure: Measure) -> np.ndarray:
    """Measure a quantity of a job.

    Returns value of each run, [R]. It is positive, and infinite or NaN where the run is lost.
    """
    complete, lost = result, np.asarray(result.data["lost"], dtype=bool)
    if measure.metric == OFF_TRACK:
        return np.where(status.keeps_track(result.data, result.meta), 1.0, 2.0)
    result = _drop_after(drop_before(result, measure.start), measure.end)
    if measure.metric == "remaining":
        first = _select_errors(complete, measure)[:, 0]
        return _measure_errors(result, replace(measure, metric="rmse")) / _norm(first)
    if measure.metric in _OF_GROUPS:
        return _measure_errors(result, measure)
    data = metrics.MetricInput(result)
    if measure.metric == "nees":
        data = data._replace(state_group=measure.group)
    values = metrics.compute_metric(measure.metric, data)
    return next(iter(values.values()), np.full(lost.size, np.nan))


def _measure_errors(result: store.JobResult, measure: Measure) -> np.ndarray:
    """Measure a metric of the errors of a group or of one component."""
    group = _select_group(result, measure)
    data = metrics.MetricInput(result, group, group.state_group)
    error, lost, time = data.select("error"), result.data["lost"], result.data["time"]
    if measure.metric == "settled":
        return convergence_time(time, error, lost, measure.settled)
    if measure.metric == "growth":
        return np.exp(_log_growth(time, error, lost))
    if measure.metric == "sd":
        return np.where(lost, np.nan, rmse_per_run(data.select("sd"), lost))
    if measure.metric == "mean_abs":
        return np.where(lost, np.inf, mean_per_run(_norm(error), lost))
    values = metrics.compute_metric(measure.metric, data)
    return list(values.values())[-1] if values else np.full(lost.size, np.nan)


def _select_errors(result: store.JobResult, measure: Measure) -> np.ndarray:
    """Select the errors of a quantity, [R, T, D]."""
    group = _select_group(result, measure)
    return metrics.MetricInput(result, group, group.state_group).select("error")


def _norm(error: np.ndarray) -> np.ndarray:
    """Compute the norm over components, shapes [..., D] to [...]."""
    return np.asarray(np.sqrt((error**2).sum(-1)))


def _select_group(result: store.JobResult, measure: Measure) -> ComponentGroup:
    """Return the group of a quantity, reduced to its component."""
    key = result.meta["key"]
    groups = {group.group: group for group in component_groups(result.meta["state"])}
    if measure.group not in groups:
        options = ", ".join(groups)
        raise ValueError(f"{key}: group must be one of {options}, got no group {measure.group!r}.")
    group = groups[measure.group]
    if measure.component == "norm":
        return group
    if measure.component not in group.components:
        options = ", ".join(("norm", *group.components))
        raise ValueError(f"{key}: component must be one of {options}, got {measure.component!r}.")
    index = group.components.index(measure.component)
    return group._replace(places=[group.places[index]], components=[measure.component])


def _log_growth(time: np.ndarray, error: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Compute the change of the log error from first to last step on the regression line [R]."""
    with np.errstate(divide="ignore"):
        log = np.log(_norm(error))
    centred = time - time.mean()
    slope = (log * centred).sum(1) / (centred**2).sum()
    return np.where(lost | ~np.isfinite(slope), np.nan, slope * (time[-1] - time[0]))


def _drop_after(result: store.JobResult, end: float) -> store.JobResult:
    """Remove the steps after a time in seconds."""
    mask = result.data["time"] <= end
    return select_steps(result, mask) if mask.any() else result
