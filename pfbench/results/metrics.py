"""Table of metrics: name, function, unit, direction and caption of each, defined once.

The table of a study (`frame`), the tables of a report with their definitions, and the claims read
`METRICS`. To add a metric, add one entry. If it needs an array that no job stores yet, record that
array in the scoring of jobs as well, and name it under `arrays` if it exists at scored steps only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from pfbench.results import store
from pfbench.results.consistency import coverage_per_run
from pfbench.results.error_measures import (
    Array,
    Flags,
    finite_mean,
    max_error,
    mean_per_run,
    mean_score_per_run,
    rmse_per_run,
)
from pfbench.results.state_groups import ComponentGroup, component_groups

COVERAGE_LEVELS = (50, 90, 99)  # percent
GROUP_UNIT = "unit of the group"
_PARTICLE_COUNTS = ("ess", "ancestors", "unique")  # divided by the number of particles

Scope = Literal["components", "group", "job"]
Direction = Literal["lower", "higher", "target"]


class MetricInput(NamedTuple):
    """Data from which a metric is computed.

    Attributes:
        result: Arrays and metadata of a job.
        group: Components of one unit; None unless the scope is "components".
        state_group: Name of a group of the state; empty for the scope "job".
    """

    result: store.JobResult
    group: ComponentGroup | None = None
    state_group: str = ""

    @property
    def arrays(self) -> Mapping[str, Array]:
        """Stored arrays."""
        return self.result.arrays

    @property
    def lost(self) -> Flags:
        """Lost runs, [R]."""
        return self.result.arrays["lost"]

    @property
    def group_index(self) -> int:
        """Index of the group in arrays with one entry per group of the state."""
        return list(self.result.meta["state"]["groups"]).index(self.state_group)

    def select(self, name: str) -> Array:
        """Return the components of the group of an array [..., D], in displayed units."""
        if self.group is None:
            raise ValueError(f"metric of {name} must have the scope 'components', got none.")
        return self.arrays[name][..., self.group.places].astype(np.float64) * self.group.scale


ByComponent = Mapping[str, Array]


@dataclass(frozen=True)
class Metric:
    """Definition of one metric.

    Attributes:
        name: Name in the table of a study.
        compute: Function of the data of a job; returns values [R] by component. An empty mapping
            means that the job does not have the data.
        scope: "components" for each group of one unit, "group" for each group of the state, "job".
        unit: Unit of the value, `GROUP_UNIT` or empty.
        direction: Whether lower or higher is better, or a target value is best.
        caption: Definition shown to readers.
        head: Column head in tables, without unit; empty for no column.
        component: Component shown in that column.
        factor: Factor of the shown value, 100 for percent.
        arrays: Arrays that exist at scored steps only.
        requires: Array without which the column is empty, though the value has a substitute.
    """

    name: str
    compute: Callable[[MetricInput], ByComponent]
    scope: Scope
    unit: str
    direction: Direction
    caption: str
    head: str = ""
    component: str = "norm"
    factor: float = 1.0
    arrays: tuple[str, ...] = ()
    requires: str = ""

    def column_head(self, group_unit: str = "") -> str:
        """Return the column head with its unit."""
        unit = group_unit if self.unit == GROUP_UNIT else self.unit
        shown = {100.0: "%"}.get(self.factor, unit)
        return f"{self.head} [{shown}]" if shown and "[" not in self.head else self.head


def particles_in_use(result: store.JobResult) -> Array | int:
    """Return the number of particles: [R, T] if the filter changes it."""
    arrays = result.arrays
    return arrays["particles"] if "particles" in arrays else int(result.meta["particles"])


def mean_trace(result: store.JobResult, name: str) -> Array:
    """Average a trace over time, as a share of the particles if it counts particles.

    Ancestors and unique particles are counted where a run was resampled. Without moves their
    numbers are equal.

    Args:
        result: Job.
        name: Name of the trace.

    Returns:
        Mean of each run, [R]; NaN without the trace.
    """
    arrays, lost, particles = result.arrays, result.arrays["lost"], result.meta.get("particles")
    is_count = name in _PARTICLE_COUNTS
    stored = "ancestors" if name == "unique" and "unique" not in arrays else name
    trace = arrays.get(stored)
    if trace is None or (is_count and not particles):
        return np.full(lost.size, np.nan)
    if name in ("ancestors", "unique") and "resampled" in arrays:
        trace = np.where(arrays["resampled"], trace, np.nan)
    return mean_per_run(trace / particles_in_use(result) if is_count else trace, lost)


def mean_acceptance(result: store.JobResult) -> Array:
    """Average the MCMC acceptance over resampled steps; [R], NaN without moves."""
    arrays, lost = result.arrays, result.arrays["lost"]
    if "accepted_0" not in arrays:
        return np.full(lost.size, np.nan)
    accepted = np.where(arrays.get("resampled", True), arrays["accepted_0"], np.nan)
    return mean_per_run(accepted, lost)


def compute_metric(name: str, data: MetricInput) -> ByComponent:
    """Compute one metric of the table; values [R] by component."""
    return {metric.name: metric for metric in METRICS}[name].compute(data)


def scored_arrays() -> tuple[str, ...]:
    """List the arrays of scored steps that metrics read."""
    return tuple(dict.fromkeys(name for metric in METRICS for name in metric.arrays))


def table_columns(
    result: store.JobResult, scope: Scope, group: ComponentGroup | None = None
) -> dict[str, float]:
    """Compute the columns that metrics of a scope add to a table, averaged over valid runs.

    Args:
        result: Job.
        scope: Scope of the metrics, "components" or "job".
        group: Group of the scope "components".

    Returns:
        Values by column head, NaN without data.
    """
    data = MetricInput(result, group, group.whole if group else "")
    columns = {}
    for metric in METRICS:
        if metric.scope == scope and metric.head:
            values = metric.compute(data).get(metric.component if scope != "job" else "")
            if values is None and scope != "job":
                continue
            if values is None or (metric.requires and metric.requires not in data.arrays):
                value = np.nan
            else:
                value = _mean_of_valid(values, data.lost)
            columns[metric.column_head(group.unit if group else "")] = metric.factor * value
    return columns


def metric_definitions() -> list[str]:
    """List the definitions of the metrics that have a column in tables."""
    return [f"{metric.head}: {metric.caption}" for metric in METRICS if metric.head]


def _mean_of_valid(values: Array, lost: Flags) -> float:
    """Average values [R] over valid runs."""
    return float(finite_mean(np.asarray(values)[~lost], axis=0))


def _rmse(data: MetricInput) -> ByComponent:
    """Compute the RMSE of each component and of the norm."""
    error, names = data.select("error"), data.group.components if data.group else []
    single = {name: rmse_per_run(error[..., [k]], data.lost) for k, name in enumerate(names)}
    return {**single, "norm": rmse_per_run(error, data.lost)}


def _max_error(data: MetricInput) -> ByComponent:
    """Compute the maximum error of the norm."""
    return {"norm": max_error(data.select("error"), data.lost)}


def _crps(data: MetricInput) -> ByComponent:
    """Compute the CRPS of each component and its mean."""
    if "crps" not in data.arrays or data.group is None:
        return {}
    crps, names = data.select("crps"), data.group.components
    single = {name: mean_score_per_run(crps[..., k], data.lost) for k, name in enumerate(names)}
    return {**single, "mean": mean_score_per_run(crps, data.lost)}


def _energy(data: MetricInput) -> ByComponent:
    """Compute the energy score; a group of mixed units has none."""
    group = data.group
    if "energy" not in data.arrays or group is None or group.group != group.whole:
        return {}
    energy = data.arrays["energy"][..., data.group_index].astype(np.float64) * group.scale
    return {"norm": mean_score_per_run(energy, data.lost)}


def _coverage(data: MetricInput, level: int) -> ByComponent:
    """Compute the coverage of the central interval of `level` percent."""
    if "pit" not in data.arrays or data.group is None:
        return {}
    pit = data.arrays["pit"][..., data.group.places]
    return {"mean": coverage_per_run(pit, data.lost, level / 100)}


def _nees(data: MetricInput) -> ByComponent:
    """Compute the mean NEES of a group."""
    return {"norm": mean_per_run(data.arrays["nees"][..., data.group_index], data.lost)}


def _nis(data: MetricInput) -> ByComponent:
    """Compute the mean NIS per observed component."""
    if "nis" not in data.arrays:
        return {}
    nis, dof = (mean_per_run(data.arrays[name], data.lost) for name in ("nis", "nis_dof"))
    return {"": np.divide(nis, dof, out=np.full(data.lost.size, np.nan), where=dof > 0)}


def _job_value(data: MetricInput, compute: Callable[[store.JobResult], Array]) -> ByComponent:
    """Compute a value of the job; empty if all runs are NaN."""
    values = compute(data.result)
    return {} if np.isnan(values).all() else {"": values}


def _trace(name: str) -> Callable[[MetricInput], ByComponent]:
    """Return the function that averages a trace."""
    return partial(_job_value, compute=partial(mean_trace, name=name))


def _log_evidence(data: MetricInput) -> ByComponent:
    """Return the log evidence of each run."""
    return {"": np.where(data.lost, np.nan, data.arrays["log_evidence"])}


def _seconds_per_step(data: MetricInput) -> ByComponent:
    """Return the time per step of the job, equal for all runs."""
    return {"": np.full(data.lost.size, data.result.meta["seconds"]["per_step"])}


_INTERVAL = (
    "Share of truths between the {low} and {high} % quantiles of the filter's distribution, over "
    "valid runs, components and scored steps. Its nominal value is {level} %."
)

METRICS: tuple[Metric, ...] = (
    Metric(
        "rmse", _rmse, "components", GROUP_UNIT, "lower",
        "Root mean square over time of the error of a component, or of the norm of a group.",
    ),
    Metric(
        "max_error", _max_error, "components", GROUP_UNIT, "lower",
        "Maximum over time of the norm of the error of a group.",
    ),
    Metric(
        "crps", _crps, "components", GROUP_UNIT, "lower",
        "Continuous ranked probability score, mean over valid runs, components and scored steps. "
        "It equals the absolute error for a distribution without spread.",
        head="CRPS", component="mean", arrays=("crps",),
    ),
    Metric(
        "energy", _energy, "components", GROUP_UNIT, "lower",
        "Generalisation of the CRPS to the vector of a group, mean over valid runs and scored "
        "steps.",
        head="energy score", arrays=("energy",),
    ),
    *(
        Metric(
            f"coverage_{level}", partial(_coverage, level=level), "components", "", "target",
            _INTERVAL.format(low=f"{50 - level / 2:g}", high=f"{50 + level / 2:g}", level=level),
            head=f"coverage of the {level} % interval", component="mean", factor=100.0,
            arrays=("pit",),
        )
        for level in COVERAGE_LEVELS
    ),
    Metric(
        "nees", _nees, "group", "", "target",
        "Normalised estimation error squared of a group, mean over time. Its expectation is the "
        "number of components.",
    ),
    Metric(
        "ess", _trace("ess"), "job", "", "higher",
        "Effective sample size, mean over time.",
        head="ESS [% of particles]", factor=100.0,
    ),
    Metric(
        "ancestors", _trace("ancestors"), "job", "", "higher",
        "Share of particles that are ancestors of others, mean over resampled steps.",
        head="distinct ancestors", factor=100.0,
    ),
    Metric(
        "unique", _trace("unique"), "job", "", "higher",
        "Share of particles that differ after resampling and moves, mean over resampled steps.",
        head="unique particles after moves", factor=100.0, requires="unique",
    ),
    Metric(
        "accepted", partial(_job_value, compute=mean_acceptance), "job", "", "target",
        "Share of accepted MCMC proposals, mean over resampled steps.",
        head="MCMC acceptance", factor=100.0,
    ),
    Metric(
        "iterations", _trace("iterations"), "job", "", "lower",
        "Iterations of a particle swarm, mean over time.",
    ),
    Metric(
        "nis", _nis, "job", "", "target",
        "Normalised innovation squared per observed component. Its expectation is 1.",
        arrays=("nis", "nis_dof"),
    ),
    Metric(
        "log_evidence", _log_evidence, "job", "", "higher",
        "Logarithm of the estimated marginal likelihood of a run.",
    ),
    Metric(
        "seconds_per_step", _seconds_per_step, "job", "s", "lower",
        "Time per step of one job, all its runs together.",
    ),
)  # fmt: skip


def data_by_scope(result: store.JobResult, scope: Scope) -> list[MetricInput]:
    """List the inputs of a scope: one per group, or one for the job.

    Args:
        result: Job.
        scope: "components", "group" or "job".

    Returns:
        Inputs in the order of the state.
    """
    state = result.meta["state"]
    if scope == "components":
        groups = component_groups(state)
        return [MetricInput(result, group, group.whole) for group in groups]
    if scope == "group":
        return [MetricInput(result, None, name) for name in state["groups"]]
    return [MetricInput(result)]
