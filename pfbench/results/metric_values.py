"""Values of the metrics, one function each, from the arrays of a job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

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
from pfbench.results.state_groups import ComponentGroup
from pfbench.results.status import is_overconfident
from pfbench.results.step_times import STEP_TIME

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


ByComponent = Mapping[str, Array]


def particles_in_use(result: store.JobResult) -> Array | int:
    """Return the number of particles: [R, T] if the filter changes it."""
    data = result.data
    return data["particles"] if "particles" in data else int(result.meta["particles"])


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
    data, lost, particles = result.data, result.data["lost"], result.meta.get("particles")
    is_count = name in _PARTICLE_COUNTS
    stored = "ancestors" if name == "unique" and "unique" not in data else name
    trace = data.get(stored)
    if trace is None or (is_count and not particles):
        return np.full(lost.size, np.nan)
    if name in ("ancestors", "unique") and "resampled" in data:
        trace = np.where(data["resampled"], trace, np.nan)
    return mean_per_run(trace / particles_in_use(result) if is_count else trace, lost)


def mean_acceptance(result: store.JobResult) -> Array:
    """Average the MCMC acceptance over resampled steps; [R], NaN without moves."""
    data, lost = result.data, result.data["lost"]
    if "accepted_0" not in data:
        return np.full(lost.size, np.nan)
    accepted = np.where(data.get("resampled", True), data["accepted_0"], np.nan)
    return mean_per_run(accepted, lost)


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
    """Compute the coverage of a central interval.

    Args:
        data: Data of a group.
        level: Probability of the interval, percent.
    """
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
    """Compute the mean MCMC acceptance."""
    return _job_value(data, mean_acceptance)


def run_log_evidence(result: store.JobResult) -> Array:
    """Return the log evidence [R]; NaN for lost runs, and without a density of the measurements."""
    hidden = result.data["lost"] | (not _has_evidence(result, of_counts=False))
    return np.where(hidden, np.nan, result.data["log_evidence"])


def compute_log_evidence(data: MetricInput) -> ByComponent:
    """Return the log evidence of each run; empty without a density of the measurements."""
    is_density = _has_evidence(data.result, of_counts=False)
    return {"": run_log_evidence(data.result)} if is_density else {}


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

    Args:
        result: Job.
        name: Name of the trace.

    Returns:
        Sum of each run, [R]; NaN for lost runs, and without the trace.
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
