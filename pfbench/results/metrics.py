"""Table of metrics: name, function, unit, direction and caption of each, defined once.

The table of a study (`frame`), metrics.csv with its definitions, judgements and the claims read
`METRICS`. To add a metric, add one entry. If it needs an array that no job stores yet, record
that array in the scoring of jobs too. Name it under `scored_names` if it exists at scored steps only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from pfbench.results import store
from pfbench.results.error_measures import Array, Flags, finite_mean
from pfbench.results.metric_values import (
    ByComponent,
    MetricInput,
    average_trace,
    compute_acceptance,
    compute_bound,
    compute_crps,
    compute_energy_score,
    compute_interval_coverage,
    compute_log_evidence,
    compute_log_probability,
    compute_log_score,
    compute_max_error,
    compute_mean_nees,
    compute_mean_nis,
    compute_nees_ratio,
    compute_overconfidence,
    compute_rmse,
    compute_seconds_per_step,
    sum_trace,
)
from pfbench.results.state_groups import ComponentGroup, component_groups

COVERAGE_LEVELS = (50, 90, 99)  # percent
GROUP_UNIT = "unit of the group"
MetricScope = Literal["components", "group", "job"]
Direction = Literal["lower", "higher", "target"]


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
        head: Column head in tables of judgements, without unit; empty for no column.
        component: Component shown in that column.
        factor: Factor of the shown value, 100 for percent.
        scored_names: Arrays that exist at scored steps only.
    """

    name: str
    compute: Callable[[MetricInput], ByComponent]
    scope: MetricScope
    unit: str
    direction: Direction
    caption: str
    head: str = ""
    component: str = "norm"
    factor: float = 1.0
    scored_names: tuple[str, ...] = ()

    def column_head(self, group_unit: str = "") -> str:
        """Return the column head with its unit."""
        unit = group_unit if self.unit == GROUP_UNIT else self.unit
        unit = {100.0: "%"}.get(self.factor, unit)
        return f"{self.head} [{unit}]" if unit and "[" not in self.head else self.head


def compute_metric(name: str, data: MetricInput) -> ByComponent:
    """Compute one metric of the table.

    Args:
        name: Name of the metric.
        data: Data of the job.

    Returns:
        Values [R] by component.
    """
    return {metric.name: metric for metric in METRICS}[name].compute(data)


def scored_arrays() -> tuple[str, ...]:
    """List the arrays of scored steps that metrics read."""
    return tuple(dict.fromkeys(name for metric in METRICS for name in metric.scored_names))


def table_columns(result: store.JobResult, group: ComponentGroup) -> dict[str, float]:
    """Compute the columns that metrics of a group add to a table, averaged over valid runs.

    Args:
        result: Job.
        group: Group.

    Returns:
        Values by column head, without metrics of missing data.
    """
    data = MetricInput(result, group, group.state_group)
    columns = {}
    for metric in METRICS:
        if metric.scope == "components" and metric.head:
            values = metric.compute(data).get(metric.component)
            if values is not None:
                mean = _mean_of_valid(values, data.lost)
                columns[metric.column_head(group.unit)] = metric.factor * mean
    return columns


def metric_definitions() -> list[str]:
    """List the definitions of the metrics that have a column in tables."""
    return [f"{metric.head}: {metric.caption}" for metric in METRICS if metric.head]


def _mean_of_valid(values: Array, lost: Flags) -> float:
    """Average values [R] over valid runs."""
    return float(finite_mean(np.asarray(values)[~lost], axis=0))


_INTERVAL = (
    "Share of truths between the {low} and {high} % quantiles of the filter's distribution, over "
    "valid runs, components and scored steps. Its nominal value is {level} %."
)

METRICS: tuple[Metric, ...] = (
    Metric(
        "rmse", compute_rmse, "components", GROUP_UNIT, "lower",
        "Root mean square over time of the error of a component, or of the norm of a group.",
    ),
    Metric(
        "max_error", compute_max_error, "components", GROUP_UNIT, "lower", "Maximum of the norm of the error.",
    ),
    Metric(
        "pcrb", compute_bound, "components", GROUP_UNIT, "target",
        "Posterior Cramér-Rao bound of the RMSE, from a norm of the standard deviations of the bound.",
    ),
    Metric(
        "crps", compute_crps, "components", GROUP_UNIT, "lower",
        "Continuous ranked probability score, mean over valid runs, components and scored steps. "
        "It equals the absolute error for a distribution without spread.",
        head="CRPS", component="mean", scored_names=("crps",),
    ),
    Metric(
        "energy", compute_energy_score, "components", GROUP_UNIT, "lower",
        "Generalisation of the CRPS to the vector of a group, mean over valid runs and scored "
        "steps.",
        head="energy score", scored_names=("energy_score",),
    ),
    *(
        Metric(
            f"coverage_{level}", partial(compute_interval_coverage, level=level), "components", "", "target",
            _INTERVAL.format(low=f"{50 - level / 2:g}", high=f"{50 + level / 2:g}", level=level),
            head=f"coverage of the {level} % interval", component="mean", factor=100.0,
            scored_names=("pit",),
        )
        for level in COVERAGE_LEVELS
    ),
    Metric(
        "nees", compute_mean_nees, "group", "", "target",
        "Normalised estimation error squared of a group, mean over time. Its expectation is the "
        "number of components.",
    ),
    Metric("nees_ratio", compute_nees_ratio, "group", "", "target", "Mean NEES over its expectation."),
    Metric("overconfident", compute_overconfidence, "group", "", "lower", "1 if NEES is above its 0.999 quantile."),
    Metric(
        "ess", average_trace("ess"), "job", "", "higher",
        "Effective sample size, mean over time.",
    ),
    Metric(
        "ancestors", average_trace("ancestors"), "job", "", "higher",
        "Share of particles that are ancestors of others, mean over resampled steps.",
    ),
    Metric(
        "unique", average_trace("unique"), "job", "", "higher",
        "Share of particles that differ after resampling and moves, mean over resampled steps.",
    ),
    Metric(
        "accepted", compute_acceptance, "job", "", "target",
        "Share of accepted MCMC proposals, mean over resampled steps.",
    ),
    Metric(
        "iterations", average_trace("iterations"), "job", "", "lower",
        "Iterations of a particle swarm, mean over time.",
    ),
    Metric(
        "rejected", sum_trace("rejected"), "job", "", "target",
        "Fixes that a gate rejected, sum over the run. A fix is one group of components.",
    ),
    Metric(
        "downweighted", sum_trace("downweighted"), "job", "", "target",
        "Fixes whose weight in a robust update is below 1/2, sum over the run. A fix is one group "
        "of components.",
    ),
    Metric(
        "nis", compute_mean_nis, "job", "", "target",
        "Normalised innovation squared per observed component. Its expectation is 1.",
        scored_names=("nis", "nis_dof"),
    ),
    Metric(
        "log_evidence", compute_log_evidence, "job", "", "higher",
        "Logarithm of the estimated marginal likelihood of a run. A filter whose weights or noise "
        "depend on the measurement does not estimate it.",
    ),
    Metric(
        "log_probability", compute_log_probability, "job", "", "higher",
        "Logarithm of the estimated probability of the counts of a run. It is not compared with the "
        "log evidence, which is a density.",
    ),
    Metric("log_score", compute_log_score, "job", "", "higher", "Log evidence per step."),
    Metric(
        "seconds_per_step", compute_seconds_per_step, "job", "s", "lower",
        "Time per step of all runs: one timing of the job, or median and quartiles of `pfbench cost`.",
    ),
)  # fmt: skip


def data_by_scope(result: store.JobResult, scope: MetricScope) -> list[MetricInput]:
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
        return [MetricInput(result, group, group.state_group) for group in groups]
    if scope == "group":
        return [MetricInput(result, None, name) for name in state["groups"]]
    return [MetricInput(result)]
