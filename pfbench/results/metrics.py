"""Table of metrics: name, function, unit, direction and caption of each, defined once.

The table of a study (`frame`), metrics.csv with its definitions, judgements and the claims read
`METRICS`. Pages of a study show those with a `page_name`. To add a metric, add one entry. If it needs
an array that no job stores yet, record that array in the scoring of jobs too. Name it under `scored_names`
if it exists at scored steps only.

References:
    T. Gneiting and A. E. Raftery (2007), Strictly proper scoring rules, prediction, and estimation.
    F. X. Diebold and R. S. Mariano (1995), Comparing predictive accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.results import store
from pfbench.results.conditions import ComponentGroup, component_groups
from pfbench.results.status import coverage_per_run, is_overconfident
from pfbench.results.step_times import STEP_TIME
from pfbench.stats.error_measures import (
    Array,
    Flags,
    finite_mean,
    max_error,
    mean_per_run,
    mean_score_per_run,
    rmse_per_run,
)

_PARTICLE_COUNTS = ("ess", "ancestors", "unique")  # divided by the number of particles


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
    def lost(self) -> Flags:
        """Lost runs, [R]."""
        return self.result.data["lost"]

    @property
    def group_index(self) -> int:
        """Index of the group in arrays with one entry per group of the state."""
        return list(self.result.meta["state"]["groups"]).index(self.state_group)

    @property
    def group_size(self) -> int:
        """Number of components of the group of the state."""
        return len(self.result.meta["state"]["groups"][self.state_group])

    def select(self, name: str) -> Array:
        """Return the components of the group of an array [..., D], in displayed units."""
        if self.group is None:
            raise ValueError(f"metric of {name} must have the scope 'components', got none.")
        return self.result.data[name][..., self.group.places].astype(np.float64) * self.group.scale


ByComponent = Mapping[str, Array]  #: values by the name of a component


def mean_trace(result: store.JobResult, name: str) -> Array:
    """Average a trace over time, as a share of the particles if it counts particles.

    Ancestors and unique particles are counted where a run was resampled. Without moves their
    numbers are equal.

    Returns mean of each run, [R]; NaN without the trace.
    """
    data, lost, particles = result.data, result.data["lost"], result.meta.get("particles")
    is_count = name in _PARTICLE_COUNTS
    stored = "ancestors" if name == "unique" and "unique" not in data else name
    trace = data.get(stored)
    if trace is None or (is_count and not particles):
        return np.full(lost.size, np.nan)
    if name in ("ancestors", "unique") and "resampled" in data:
        trace = np.where(data["resampled"], trace, np.nan)
    # [R, T] if the filter changes its number of particles
    return mean_per_run(trace / data.get("particles", particles) if is_count else trace, lost)


def compute_rmse(data: MetricInput) -> ByComponent:
    """Compute the RMSE of each component and of the norm."""
    error, names = data.select("error"), data.group.components if data.group else []
    single = {name: rmse_per_run(error[..., [k]], data.lost) for k, name in enumerate(names)}
    return {**single, "norm": rmse_per_run(error, data.lost)}


def compute_max_error(data: MetricInput) -> ByComponent:
    """Compute the maximum error of the norm."""
    return {"norm": max_error(data.select("error"), data.lost)}


def compute_bound(data: MetricInput) -> ByComponent:
    """Compute the root mean square of the PCRB of the norm, over the steps with truth of each run."""
    if "pcrb" not in data.result.data:
        return {}
    bound = (data.select("pcrb") ** 2).sum(axis=-1)
    square = np.where(np.isnan(data.select("error")).any(axis=-1), np.nan, bound)
    return {"norm": np.where(data.lost, np.nan, np.sqrt(finite_mean(square, axis=1)))}


def compute_crps(data: MetricInput) -> ByComponent:
    """Compute the CRPS of each component and its mean."""
    if "crps" not in data.result.data or data.group is None:
        return {}
    crps, names = data.select("crps"), data.group.components
    single = {name: mean_score_per_run(crps[..., k], data.lost) for k, name in enumerate(names)}
    return {**single, "mean": mean_score_per_run(crps, data.lost)}


def compute_energy_score(data: MetricInput) -> ByComponent:
    """Compute the energy score; a group of mixed units has none."""
    group = data.group
    if "energy_score" not in data.result.data or group is None or group.group != group.state_group:
        return {}
    energy = (
        data.result.data["energy_score"][..., data.group_index].astype(np.float64) * group.scale
    )
    return {"norm": mean_score_per_run(energy, data.lost)}


def compute_interval_coverage(data: MetricInput, level: int) -> ByComponent:
    """Compute the coverage of a central interval."""
    if "pit" not in data.result.data or data.group is None:
        return {}
    pit = data.result.data["pit"][..., data.group.places]
    return {"mean": coverage_per_run(pit, data.lost, level / 100)}


def compute_mean_nees(data: MetricInput) -> ByComponent:
    """Compute the mean NEES of a group; empty for a filter without a covariance."""
    if not data.result.meta.get("has_covariance", True):
        return {}
    return {"norm": mean_per_run(data.result.data["nees"][..., data.group_index], data.lost)}


def compute_nees_ratio(data: MetricInput) -> ByComponent:
    """Compute the mean NEES of a group over its expectation, the number of components."""
    return {name: mean / data.group_size for name, mean in compute_mean_nees(data).items()}


def compute_overconfidence(data: MetricInput) -> ByComponent:
    """Return 1 for an overconfident run, 0 for another, NaN for a lost one; empty without covariance."""
    if not data.result.meta.get("has_covariance", True):
        return {}
    nees = data.result.data["nees"][..., data.group_index]
    flags = is_overconfident(nees, data.group_size, data.lost)
    return {"norm": np.where(data.lost, np.nan, flags.astype(np.float64))}


def compute_mean_nis(data: MetricInput) -> ByComponent:
    """Compute the mean NIS per observed component."""
    if "nis" not in data.result.data:
        return {}
    nis, dof = (mean_per_run(data.result.data[name], data.lost) for name in ("nis", "nis_dof"))
    return {"": np.divide(nis, dof, out=np.full(data.lost.size, np.nan), where=dof > 0)}


def _job_value(data: MetricInput, compute: Callable[[store.JobResult], Array]) -> ByComponent:
    """Compute a value of the job; empty if all runs are NaN."""
    values = compute(data.result)
    return {} if np.isnan(values).all() else {"": values}


def average_trace(name: str) -> Callable[[MetricInput], ByComponent]:
    """Return the function that averages a trace."""
    return partial(_job_value, compute=partial(mean_trace, name=name))


def compute_acceptance(data: MetricInput) -> ByComponent:
    """Compute the mean MCMC acceptance over resampled steps; empty without moves."""
    traces = data.result.data
    accepted = np.where(traces.get("resampled", True), traces.get("accepted_0", np.nan), np.nan)
    return _job_value(data, lambda _: mean_per_run(np.atleast_2d(accepted), data.lost))


def run_log_evidence(result: store.JobResult) -> Array:
    """Return the log evidence [R]; NaN for lost runs, and without a density of the measurements."""
    hidden = result.data["lost"] | (not _has_evidence(result, of_counts=False))
    return np.where(hidden, np.nan, result.data["log_evidence"])


def compute_log_evidence(data: MetricInput) -> ByComponent:
    """Return the log evidence of each run; empty without a density of the measurements."""
    is_density = _has_evidence(data.result, of_counts=False)
    return {"": run_log_evidence(data.result)} if is_density else {}


def compute_evidence_floor(data: MetricInput) -> ByComponent:
    """Return the stored floor of the log evidence for each run; empty without a density of the measurements."""
    floor = data.result.data.get("evidence_floor")
    if floor is None or not _has_evidence(data.result, of_counts=False):
        return {}
    return {"": np.where(data.lost, np.nan, floor)}


def compute_log_probability(data: MetricInput) -> ByComponent:
    """Return the log probability of the counts of each run; empty for other measurements."""
    if not _has_evidence(data.result, of_counts=True):
        return {}
    return {"": np.where(data.lost, np.nan, data.result.data["log_evidence"])}


def _has_evidence(result: store.JobResult, of_counts: bool) -> bool:
    """Return whether the filter has an evidence, and the model measurements of this kind."""
    meta = result.meta
    return meta.get("has_evidence", True) and bool(meta.get("has_counts")) == of_counts


def count_trace(result: store.JobResult, name: str) -> Array:
    """Sum a trace of counts over time.

    Returns sum of each run, [R]; NaN for lost runs, and without the trace.
    """
    lost, trace = result.data["lost"], result.data.get(name)
    if trace is None:
        return np.full(lost.size, np.nan)
    return np.where(lost, np.nan, np.asarray(trace, dtype=np.float64).sum(-1))


def sum_trace(name: str) -> Callable[[MetricInput], ByComponent]:
    """Return the function that sums a trace of counts over time."""
    return partial(_job_value, compute=partial(count_trace, name=name))


def compute_log_score(data: MetricInput) -> ByComponent:
    """Return the log evidence per step of the record; empty for a filter without evidence."""
    steps = data.result.meta.get("steps", len(data.result.data["time"]))
    return _job_value(data, lambda result: run_log_evidence(result) / steps)


def compute_seconds_per_step(data: MetricInput) -> ByComponent:
    """Return the time per step of the job, equal for all runs; median and quartiles of its rounds if any."""
    meta = data.result.meta
    rounds = meta.get(STEP_TIME, {"median": meta["seconds"]["per_step"]})
    names = {"": "median", "quartile_25": "low", "quartile_75": "high"}
    return {k: np.full(data.lost.size, rounds[n]) for k, n in names.items() if n in rounds}


COVERAGE_LEVELS = (50, 90, 99)  # percent
GROUP_UNIT = "unit of the group"  #: unit of a metric that is in the unit of its group, such as m
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
        component: Component shown in that column and on pages.
        factor: Factor of the shown value, 100 for percent.
        scored_names: Arrays that exist at scored steps only.
        page_name: Name on pages, where smaller values are better; empty for a metric that cannot decide a study.
        only_decides: Whether pages show it only if it decides the study.
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
    page_name: str = ""
    only_decides: bool = False

    @property
    def is_of_group(self) -> bool:
        """True if it is a value of a group of components, in the unit of the group."""
        return self.unit == GROUP_UNIT

    def column_head(self, group_unit: str = "") -> str:
        """Return the column head with its unit."""
        unit = group_unit if self.unit == GROUP_UNIT else self.unit
        unit = {100.0: "%"}.get(self.factor, unit)
        return f"{self.head} [{unit}]" if unit and "[" not in self.head else self.head


def compute_metric(name: str, data: MetricInput) -> ByComponent:
    """Compute one metric of the table.

    Returns values [R] by component.
    """
    return {metric.name: metric for metric in METRICS}[name].compute(data)


def page_metrics() -> dict[str, Metric]:
    """List the metrics that can decide a study, by name."""
    return {metric.name: metric for metric in METRICS if metric.page_name}


def check_page_metric(name: str) -> None:
    """Check the name of the metric that decides a study."""
    require(
        name in page_metrics(),
        "report.metric",
        f"be one of {', '.join(page_metrics())}",
        name,
        "Choose rmse for estimates, or crps for posterior distributions.",
    )


def scored_arrays() -> tuple[str, ...]:
    """List the arrays of scored steps that metrics read."""
    return tuple(dict.fromkeys(name for metric in METRICS for name in metric.scored_names))


def table_columns(result: store.JobResult, group: ComponentGroup) -> dict[str, float]:
    """Compute the columns that metrics of a group add to a table, averaged over valid runs."""
    data = MetricInput(result, group, group.state_group)
    selection = [metric for metric in METRICS if metric.scope == "components" and metric.head]
    values = {metric: metric.compute(data).get(metric.component) for metric in selection}
    return {
        metric.column_head(group.unit): metric.factor * float(finite_mean(np.asarray(v)[~data.lost], axis=0))
        for metric, v in values.items() if v is not None
    }  # fmt: skip


def metric_definitions() -> list[str]:
    """List the definitions of the metrics that have a column in tables."""
    return [f"{metric.head}: {metric.caption}" for metric in METRICS if metric.head]


_INTERVAL = (
    "Share of truths between the {low} and {high} % quantiles of the filter's distribution, over "
    "valid runs, components and scored steps. Its nominal value is {level} %."
)

#: all metrics of a report, in their order
METRICS: tuple[Metric, ...] = (
    Metric(
        "rmse", compute_rmse, "components", GROUP_UNIT, "lower",
        "Root mean square over time of the error of a component, or of the norm of a group.",
        page_name="RMS error",
    ),
    Metric(
        "max_error", compute_max_error, "components", GROUP_UNIT, "lower", "Maximum of the norm of the error.",
        page_name="largest error",
    ),
    Metric(
        "pcrb", compute_bound, "components", GROUP_UNIT, "target",
        "Posterior Cramér-Rao bound of the RMSE, from a norm of the standard deviations of the bound.",
    ),
    Metric(
        "crps", compute_crps, "components", GROUP_UNIT, "lower",
        "Continuous ranked probability score, mean over valid runs, components and scored steps. "
        "It equals the absolute error for a distribution without spread.",
        head="CRPS", component="mean", scored_names=("crps",), page_name="CRPS",
    ),
    Metric(
        "energy", compute_energy_score, "components", GROUP_UNIT, "lower",
        "Generalisation of the CRPS to the vector of a group, mean over valid runs and scored "
        "steps.",
        head="energy score", scored_names=("energy_score",), page_name="energy score", only_decides=True,
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
        "Effective sample size over the number of particles, mean over time.",
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
        "log_evidence_floor", compute_evidence_floor, "job", "", "target",
        "Log likelihood of independent normal values or of an autoregression of order 1 that is fitted to the measurements of the run. A "
        "filter whose log evidence is below has a model that is worse than no model.",
    ),
    Metric(
        "log_probability", compute_log_probability, "job", "", "higher",
        "Logarithm of the estimated probability of the counts of a run. It is not compared with the "
        "log evidence, which is a density.",
    ),
    Metric(
        "log_score", compute_log_score, "job", "", "higher", "Log evidence per step.", component="",
        page_name="inverse predictive density per step", only_decides=True,
    ),
    Metric(
        "seconds_per_step", compute_seconds_per_step, "job", "s", "lower",
        "Time per step of all runs: one timing of the job, or median and quartiles of `pfbench cost`.",
    ),
)  # fmt: skip


def data_by_scope(result: store.JobResult, scope: MetricScope) -> list[MetricInput]:
    """List the inputs of a scope: one per group, or one for the job.

    Returns inputs in the order of the state.
    """
    state = result.meta["state"]
    if scope == "components":
        groups = component_groups(state)
        return [MetricInput(result, group, group.state_group) for group in groups]
    if scope == "group":
        return [MetricInput(result, None, name) for name in state["groups"]]
    return [MetricInput(result)]
