"""Single runs of a condition for the page: true track, errors over time, traces, at few instants."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np

from pfbench.report.board.curves import compute_error_norms, select_truth_steps
from pfbench.results.error_measures import Array
from pfbench.results.state_groups import main_component_group
from pfbench.results.store import JobResult

TRACK_INSTANTS = 40
_TRACKS = 3000  # of all filters, conditions and runs of a page [ours]
_MIN_RUNS = 10  # of each condition that a page carries, if its size allows it
_PLANES = (("position_E", "position_N"), ("x", "y"))  # components east and north


def count_carried_runs(filters: int, conditions: int) -> int:
    """Count the runs of a condition whose tracks a page carries.

    Args:
        filters: Number of filters.
        conditions: Number of conditions.
    """
    return max(_MIN_RUNS, _TRACKS // max(1, filters * conditions))


def select_telling_runs(errors: Array, most: int) -> list[int]:
    """Select runs in turn: the most typical, the worst, the best, and the largest disagreement.

    Args:
        errors: Errors, [F, N]; NaN for a lost or an absent run.
        most: Number of runs at most.

    Returns:
        Indices of the runs, the most telling first.
    """
    runs = errors.shape[1]
    with warnings.catch_warnings(), np.errstate(divide="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # runs without an error
        level = np.log(np.maximum(errors, 1e-300))
        mean, spread = np.nanmean(level, axis=0), np.nanstd(level, axis=0)
        middle = np.nanmedian(mean)
    lost = np.isnan(errors).sum(axis=0)
    mean, spread = np.nan_to_num(mean, nan=np.inf), np.nan_to_num(spread)
    orders = (
        np.argsort(np.abs(mean - middle) if np.isfinite(middle) else mean, kind="stable"),
        np.lexsort((-mean, -lost)),
        np.argsort(mean, kind="stable"),
        np.argsort(-spread, kind="stable"),
    )
    turns = [int(k) for row in zip_longest(*orders) for k in row]
    return list(dict.fromkeys(turns))[: min(most, runs)]


def make_tracks(
    results: Mapping[str, JobResult], errors: Array, numbers: Sequence[int], most: int
) -> dict[str, Any]:
    """Collect the most telling runs of a condition.

    Args:
        results: Results of all filters by label.
        errors: RMS errors, [F, N], in the order of the results; NaN for a lost run.
        numbers: Numbers of the runs, [N].
        most: Number of runs at most.

    Returns:
        Entry of the page: instants, unit, numbers, error, traces, and the plane if there is one.
    """
    first = next(iter(results.values()))
    group = main_component_group(first.meta["state"])
    runs = select_telling_runs(errors, most)
    norms = compute_error_norms(results)
    steps = select_truth_steps(norms.values(), TRACK_INSTANTS)
    names = [str(numbers[k]) for k in runs]

    def by_run(values: Array) -> dict[str, Array]:
        return dict(zip(names, values, strict=True))

    time, total = first.data["time"], len(first.data["time"])
    note = f"{len(steps)} of {total} instants." if len(steps) < total else ""
    entry: dict[str, Any] = {
        "t": [float(f"{t:.4g}") for t in time[steps]],
        "unit": group.unit,
        "numbers": [int(name) for name in names],
        "note": note,
        "error": {label: by_run(norm[runs][:, steps]) for label, norm in norms.items()},
        "traces": _list_traces(results, runs, steps, by_run),
    }
    return entry | _describe_plane(results, runs, steps, by_run)


def _list_traces(
    results: Mapping[str, JobResult], runs: Sequence[int], steps: np.ndarray, by_run: Any
) -> list[dict[str, Any]]:
    """List effective sample size and normalised innovations, where results have them."""
    traces: list[dict[str, Any]] = []
    sizes = {
        label: by_run(result.data["ess"][runs][:, steps])
        for label, result in results.items()
        if "ess" in result.data
    }
    if sizes:
        traces.append({"name": "effective sample size", "unit": "", "log": True, "filters": sizes})
    innovations = {
        label: by_run(_nis_ratio(result)[runs])
        for label, result in results.items()
        if "nis" in result.data
    }
    if innovations:
        first = next(result for result in results.values() if "nis" in result.data)
        time = first.data["time"][first.data["score_steps"]]
        traces.append({
            "name": "squared innovation divided by its expectation", "unit": "", "log": True, "filters": innovations,
            "t": [float(f"{t:.4g}") for t in time],
        })  # fmt: skip
    return traces


def _nis_ratio(result: JobResult) -> Array:
    """Divide NIS by its degrees of freedom, [R, S]; NaN without a measurement."""
    dof = np.asarray(result.data["nis_dof"], dtype=np.float64)
    return np.asarray(result.data["nis"] / np.where(dof > 0, dof, np.nan))


def _describe_plane(
    results: Mapping[str, JobResult], runs: Sequence[int], steps: np.ndarray, by_run: Any
) -> dict[str, Any]:
    """Return true positions and position errors in the plane; empty without a track."""
    first = next(iter(results.values()))
    index = {str(name): k for k, name in enumerate(first.meta["state"]["names"])}
    plane = next((names for names in _PLANES if all(name in index for name in names)), None)
    if plane is None or "track" not in first.data:
        return {}
    places = [index[name] for name in plane]
    truth = np.asarray(first.data["track"], dtype=np.float64)[runs][:, steps, :2]
    is_common = np.allclose(truth, truth[:1], rtol=0, atol=0.05, equal_nan=True)
    errors = {
        label: by_run(_mask_lost(result)[runs][:, steps][..., places])
        for label, result in results.items()
    }
    return {"truth": {"all": truth[0]} if is_common else by_run(truth), "plane": errors}


def _mask_lost(result: JobResult) -> Array:
    """Return the errors with NaN in lost runs, [R, T, D]."""
    lost = np.asarray(result.data["lost"], dtype=bool)
    return np.where(lost[:, None, None], np.nan, result.data["error"])
