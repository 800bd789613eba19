"""Status of runs and filters: lost, diverged, overconfident, collapsed.

- **lost**: the filter failed numerically. Recorded by the filter.
- **diverged**: the run was not lost, but its error exceeds the divergence threshold. It does so in at
  least 10 % of the steps with truth, or in the last one. The error is that of the main group. The
  scenario states the threshold as `paper.divergence_threshold`, for all filters alike. The filter's
  covariance is not used.
- **track kept**: neither lost nor diverged.
- **overconfident run**: the mean over time of the NEES of the main group exceeds the 0.999 quantile
  of the chi-square distribution.
- **severely overconfident**: it exceeds 100 times the degrees of freedom in some group [ours].
- **collapsed**: the filter itself reports impossible innovations at a spread or effective sample
  size at the floor, see `pfbench.filter.health`.
- **heavy-tailed**, **implausible**, **undefined**: the filter reports weights without a bound, a
  measurement a thousand standard deviations away, or a likelihood of NaN, see there.
- **overconfident filter**: NEES averaged over runs and time exceeds the upper chi-square limit;
  **underconfident** is below the lower one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pfbench.core.chi_square import chi_square_limit
from pfbench.results.conditions import main_component_group
from pfbench.results.paper_block import read_stored_block
from pfbench.stats.error_measures import Array, Flags, finite_mean, rmse_per_run

DIVERGED_SHARE = 0.1  # of the steps with truth, beyond the threshold

# in the array `health`, see `pfbench.filter.health.HEALTH`
COLLAPSED = 2

HEALTH_MARKS = {5: "heavy-tailed", 6: "implausible", 7: "undefined"}


class StatusCounts(NamedTuple):
    """Number of runs of a job by status.

    Attributes:
        lost: Lost runs.
        diverged: Diverged runs; None without a divergence threshold.
        severely_overconfident: Severely overconfident runs.
        runs: All runs.
        overconfident: Overconfident runs, severely overconfident ones included.
        collapsed: Collapsed runs that are not lost.
        marked: Runs by the other marks of the filter, see `HEALTH_MARKS`.
    """

    lost: int
    diverged: int | None
    severely_overconfident: int
    runs: int
    overconfident: int = 0
    collapsed: int = 0
    marked: Mapping[str, int] = {}


def is_diverged(error: Array, lost: Flags, threshold: float) -> Flags:
    """Return the valid runs [R] whose error exceeds a threshold too often or at the end.

    Args:
        error: Error of the main group, [R, T, K]; NaN without truth.
        lost: Lost runs, [R].
        threshold: Divergence threshold in the unit of the error.

    Returns:
        Mask, [R]. False for a run without truth.
    """
    norm = np.sqrt(np.sum(np.asarray(error, dtype=np.float64) ** 2, axis=-1))
    has_truth = ~np.isnan(norm)
    exceeds = norm > threshold
    share = exceeds.sum(axis=1) / np.maximum(has_truth.sum(axis=1), 1)
    last = has_truth.shape[1] - 1 - has_truth[:, ::-1].argmax(axis=1)
    at_end = np.take_along_axis(exceeds, last[:, None], axis=1)[:, 0]
    return ((share >= DIVERGED_SHARE) | at_end) & ~np.asarray(lost, bool)


def is_overconfident(nees: Array, dof: int, lost: Flags) -> Flags:
    """Return the valid runs [R] whose mean NEES exceeds the 0.999 quantile of its distribution.

    Returns mask, [R]. Shapes: nees [R, T], lost [R].
    """
    with np.errstate(over="ignore"):
        mean = finite_mean(np.asarray(nees, dtype=np.float64), axis=1)
    return (mean > chi_square_limit(dof, 0.001)) & ~np.asarray(lost, dtype=bool)


def is_severely_overconfident(
    nees: Array, dofs: Sequence[int], lost: Flags, factor: float = 100.0
) -> Flags:
    """Return the valid runs [R] whose mean NEES exceeds `factor` times its degrees of freedom.

    With factor 100 the error is ten of the filter's standard deviations on average over the run.

    Returns mask, [R]. Shapes: nees [R, T, G], dofs [G], lost [R].
    """
    with np.errstate(over="ignore"):
        mean = finite_mean(np.asarray(nees, dtype=np.float64), axis=1)
    exceeds = (mean > factor * np.asarray(dofs, dtype=np.float64)).any(axis=-1)
    return exceeds & ~np.asarray(lost, dtype=bool)


def divergence_threshold(meta: Mapping[str, Any]) -> float | None:
    """Return the divergence threshold that a job's scenario states, in the unit of the main group."""
    value = read_stored_block(meta, "scenario").get("divergence_threshold")
    return None if value is None else float(value)


def scenario_family(meta: Mapping[str, Any], scenario: str) -> str:
    """Return the family of a job's scenario: scenarios of one trajectory have one family."""
    return str(read_stored_block(meta, "scenario").get("family") or scenario.partition("[")[0])


def keeps_track(data: Mapping[str, Array], meta: Mapping[str, Any]) -> Flags:
    """Return the runs [R] that are neither lost nor diverged.

    Returns mask, [R].
    """
    lost = np.asarray(data["lost"], dtype=bool)
    threshold = divergence_threshold(meta)
    if threshold is None:
        return ~lost
    error = data["error"][..., main_component_group(meta["state"]).places]
    return ~lost & ~is_diverged(error, lost, threshold)


def count_statuses(data: Mapping[str, Array], meta: Mapping[str, Any]) -> StatusCounts:
    """Count the runs of a job by status.

    Returns the numbers of runs.
    """
    lost, groups = np.asarray(data["lost"], dtype=bool), meta["state"]["groups"]
    dofs = [len(components) for components in groups.values()]
    severe = is_severely_overconfident(data["nees"], dofs, lost)
    name = main_component_group(meta["state"]).state_group
    nees = data["nees"][..., list(groups).index(name)]
    narrow = is_overconfident(nees, len(groups[name]), lost) | severe
    has_threshold = divergence_threshold(meta) is not None
    diverged = int((~keeps_track(data, meta) & ~lost).sum()) if has_threshold else None
    health = np.asarray(data.get("health", np.zeros(lost.shape)))
    return StatusCounts(
        int(lost.sum()),
        diverged,
        int(severe.sum()),
        int(lost.size),
        int(narrow.sum()),
        int(((health == COLLAPSED) & ~lost).sum()),
        {name: int(((health == value) & ~lost).sum()) for value, name in HEALTH_MARKS.items()},
    )


# --------------------------------------------------------------------------------------------------
# Consistency of a filter's distribution with the truth: NEES, whiteness, coverage, ranks.


class WhitenessResult(NamedTuple):
    """Moments of normalised residuals, with 95 % limits for white standard normal numbers.

    Attributes:
        mean: Mean.
        mean_band: Limit of the absolute mean.
        variance: Mean square.
        variance_band: Limit of the absolute difference of the mean square from 1.
        lag: Autocorrelation at lag 1.
        lag_band: Limit of the absolute autocorrelation.
        outside_share: Share beyond three standard deviations; 0.0027 for a normal distribution.
        numbers: Sample size.
    """

    mean: float
    mean_band: float
    variance: float
    variance_band: float
    lag: float
    lag_band: float
    outside_share: float
    numbers: int


def compute_whiteness(z: Array) -> WhitenessResult:
    """Compare normalised residuals with white standard normal numbers.

    Method of Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2. Steps without a measurement in any
    run are left out, so that the autocorrelation is between successive measurements.

    Returns moments and their 95 % limits. Shapes: z [R, T, K].
    """
    z = np.asarray(z, dtype=np.float64)
    values = z[~np.isnan(z)]
    measured = z[:, ~np.isnan(z).all(axis=(0, 2))]
    products = measured[:, 1:] * measured[:, :-1]
    pairs = int((~np.isnan(products)).sum())
    square = float(finite_mean(values**2, axis=0))
    covariance = float(finite_mean(products.ravel(), axis=0))
    root = 1.96 / np.sqrt(max(values.size, 1))
    return WhitenessResult(
        mean=float(finite_mean(values, axis=0)),
        mean_band=float(root),
        variance=square,
        variance_band=float(np.sqrt(2) * root),
        lag=covariance / square if pairs and square > 0 else np.nan,
        lag_band=float(1.96 / np.sqrt(pairs)) if pairs else np.nan,
        outside_share=float(finite_mean((np.abs(values) > 3).astype(np.float64), axis=0)),
        numbers=values.size,
    )


def coverage_per_run(pit: Array, lost: Flags, level: float) -> Array:
    """Compute the share of truths in the central interval of each run.

    Returns share, [R]; NaN for a lost run. Shapes: pit [R, S, K], lost [R].
    """
    pit = np.asarray(pit, dtype=np.float64)
    # Stored in single precision: a truth on the limit counts as inside.
    inside = np.where(np.isnan(pit), np.nan, np.abs(pit - 0.5) <= level / 2 + 1e-6)
    return np.where(lost, np.nan, finite_mean(inside.reshape(len(inside), -1), axis=1))


# --------------------------------------------------------------------------------------------------
# Headline of a job: error of the main group and status of its runs, in one line.


def main_rmse(outputs: Mapping[str, Array], meta: Mapping[str, Any]) -> float:
    """Compute the median over runs of the RMS error of the main group, infinite in a run without track, as on pages."""
    group = main_component_group(meta["state"])
    errors = group.scale * outputs["error"][..., group.places].astype(float)
    of_runs = rmse_per_run(errors, ~keeps_track(outputs, meta))
    return math.inf if np.isnan(of_runs).all() else float(np.nanmedian(of_runs))


HINTS = {
    "heavy-tailed": "Unbounded weights: k-hat {k}, at most 0.7 is reliable. Set a defensive_fraction "
    "above 0 in the proposal or the auxiliary weights, or compare with filter=sir",
    "implausible": "A measurement is more than 1000 standard deviations from every prediction. "
    "Check its unit and the noise of the model, or choose a filter that rejects outliers, such as gate",
    "undefined": "The log likelihood of the model is NaN for valid states, which count as impossible. "
    "Return -inf where a state is impossible",
}


def describe_runs(outputs: Mapping[str, Array], meta: Mapping[str, Any]) -> str:
    """Describe error and status of the runs, such as "position: median RMS error 833 m; 10 of 100 runs diverged".

    Returns magnitude with unit, counts of `count_statuses`, and the threshold.
    """
    group = main_component_group(meta["state"])
    lacks_truth = np.isnan(outputs["error"][..., group.places]).all(axis=(1, 2))
    count, threshold = count_statuses(outputs, meta), divergence_threshold(meta)
    kinds = {
        "without truth": int((~np.asarray(outputs["lost"], bool) & lacks_truth).sum()),
        "lost": count.lost,
        "diverged": count.diverged,
        "collapsed": count.collapsed,
        "overconfident": count.overconfident,
        **count.marked,
    }
    present = {name: number for name, number in kinds.items() if number}
    value, truth = main_rmse(outputs, meta), meta.get("measured_truth", "")
    kind = f"median RMS distance to {truth}" if truth else "median RMS error"
    rmse = f"{group.group}: {kind} {value:.4g} {group.unit}".rstrip()
    if not math.isfinite(value):
        rmse = f"{group.group}: no finite {kind}"
    all_runs = f"{count.runs} of {count.runs} runs"
    if not present:
        return (
            f"{rmse}; {f'{all_runs} valid' if threshold is None else f'track kept in {all_runs}'}"
        )
    text = (
        ", ".join(f"{number} {name}" for name, number in present.items()) + f" of {count.runs} runs"
    )
    if len(present) == 1:
        text = "".join(f"{number} of {count.runs} runs {name}" for name, number in present.items())
    if count.diverged and threshold is not None:
        limit = f"{threshold * group.scale:.3g} {group.unit}".rstrip()
        text += f" (diverged: error above {limit}, the limit of the scenario)"
    hints = [HINTS[name].format(k=_largest_k(outputs)) for name in count.marked if name in present]
    return ". ".join([f"{rmse}; {text}", *hints])


def _largest_k(outputs: Mapping[str, Array]) -> str:
    """Return the largest Pareto k-hat of the runs, as text."""
    k = np.asarray(outputs.get("pareto_k", np.nan), dtype=float)
    return f"{np.nanmax(k):.2g}" if np.isfinite(k).any() else "unknown"
