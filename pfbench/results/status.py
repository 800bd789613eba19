"""Status of runs and filters: lost, diverged, overconfident, severely overconfident.

- **lost**: the filter failed numerically. Recorded by the filter.
- **diverged**: the run was not lost, and its last position error exceeds the divergence threshold
  of the scenario, `divergence_threshold_m`. The filter's covariance is not used. If the scenario
  states no threshold, no run is diverged, and tables print "–".
- **severely overconfident**: the run was not lost, and the mean over time of the NEES of some group
  exceeds 100 times its degrees of freedom [ours].
- **overconfident**: NEES averaged over runs and time exceeds the upper chi-square limit;
  **underconfident** is below the lower one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pfbench.results import store
from pfbench.results.consistency import NeesConsistency, nees_band
from pfbench.results.error_measures import Array, Flags, RunMean, convergence_time, finite_mean

POSITION = "position"  # group whose error decides divergence


class StatusCounts(NamedTuple):
    """Number of runs of a job by status.

    Attributes:
        lost: Lost runs.
        diverged: Diverged runs; None without a divergence threshold.
        severely_overconfident: Severely overconfident runs.
        runs: All runs.
    """

    lost: int
    diverged: int | None
    severely_overconfident: int
    runs: int


def lost_fraction(lost: Flags) -> RunMean:
    """Compute the fraction of lost runs [R]."""
    mean = finite_mean(np.asarray(lost, dtype=np.float64), axis=0)
    return RunMean(mean, int(np.size(lost)))


def is_diverged(error: Array, lost: Flags, threshold: float) -> Flags:
    """Return the valid runs [R] whose last error exceeds a threshold.

    Args:
        error: Position error, [R, T, K]; NaN without truth.
        lost: Lost runs, [R].
        threshold: Divergence threshold in the unit of the error.

    Returns:
        Mask, [R]. False for a run without truth.
    """
    steps = np.arange(error.shape[1], dtype=np.float64)
    return np.isinf(convergence_time(steps, error, lost, threshold)) & ~np.asarray(lost, bool)


def is_severely_overconfident(
    nees: Array, dofs: Sequence[int], lost: Flags, factor: float = 100.0
) -> Flags:
    """Return the valid runs [R] whose mean NEES exceeds `factor` times its degrees of freedom.

    With factor 100 the error is ten of the filter's standard deviations on average over the run.

    Args:
        nees: Normalised estimation error squared, [R, T, G].
        dofs: Degrees of freedom of each group, [G].
        lost: Lost runs, [R].
        factor: Multiple of the degrees of freedom.

    Returns:
        Mask, [R].
    """
    with np.errstate(over="ignore"):
        mean = finite_mean(np.asarray(nees, dtype=np.float64), axis=1)
    exceeds = (mean > factor * np.asarray(dofs, dtype=np.float64)).any(axis=-1)
    return exceeds & ~np.asarray(lost, dtype=bool)


def classify_consistency(consistency: NeesConsistency, dof: int, alpha: float = 0.05) -> str:
    """Name the consistency of a filter by its mean NEES.

    The limits hold for the average over runs at one step. They are too wide for the mean over
    time, so that a consistent filter is rarely called otherwise.

    Args:
        consistency: NEES averaged over runs.
        dof: Number of components of the group.
        alpha: Probability outside the limits.

    Returns:
        "overconfident", "underconfident" or "consistent"; empty without runs.
    """
    if not consistency.runs:
        return ""
    low, high = nees_band(dof, consistency.runs, alpha)
    if consistency.mean > high:
        return "overconfident"
    return "underconfident" if consistency.mean < low else "consistent"


def divergence_threshold(meta: Mapping[str, Any]) -> float | None:
    """Return the divergence threshold in metres that a job's scenario states, else None."""
    scenario = meta.get("config", {}).get("scenario")
    value = scenario.get("divergence_threshold_m") if isinstance(scenario, Mapping) else None
    return None if value is None else float(value)


def count_statuses(result: store.JobResult) -> StatusCounts:
    """Count the runs of a job by status."""
    lost, groups = result.data["lost"], result.meta["state"]["groups"]
    dofs = [len(components) for components in groups.values()]
    severe = is_severely_overconfident(result.data["nees"], dofs, lost)
    threshold = divergence_threshold(result.meta)
    diverged = None
    if threshold is not None and POSITION in groups:
        error = result.data["error"][..., list(groups[POSITION])]
        diverged = int(is_diverged(error, lost, threshold).sum())
    return StatusCounts(int(lost.sum()), diverged, int(severe.sum()), int(lost.size))
