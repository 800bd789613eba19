"""Curves over time of stored results: valid runs, thinned times, the PCRB, sums of NIS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pfbench.report.plots.plotting import INSTANTS, select_indices
from pfbench.results import store

Results = Mapping[str, store.JobResult]


def select_valid_runs(
    result: store.JobResult, index: int | None, *names: str, most: int = INSTANTS
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Select arrays of the valid runs at thinned times.

    Times without a value in the first array are dropped before thinning, which could miss the
    few times with truth otherwise.

    Args:
        result: Result of a filter.
        index: Index in the state, or None for a trace.
        *names: Names of arrays.
        most: Number of times at most.

    Returns:
        Times [T] and arrays [R, T].
    """
    series = [result.data[name][~result.data["lost"]] for name in names]
    if index is not None:
        series = [values[..., index] for values in series]
    steps = thin_mask(~np.isnan(series[0]).all(0), most)
    return result.data["time"][steps], [values[:, steps].astype(np.float64) for values in series]


def thin_mask(finite_mask: np.ndarray, most: int = INSTANTS) -> np.ndarray:
    """Return the indices of at most `most` true elements of a mask.

    Args:
        finite_mask: Mask, [T].
        most: Number of indices at most.
    """
    indices = np.flatnonzero(finite_mask)
    return indices[select_indices(indices.size, most)]


def point_marker(time: np.ndarray) -> str:
    """Return a marker for a curve of a single point, which draws no line."""
    return "." if time.size == 1 else ""


def pcrb_sd(result: store.JobResult) -> np.ndarray | None:
    """Return the standard deviations [T, d] of the PCRB, or None if the job has none."""
    return result.data.get("pcrb")


def component_pcrb(results: Results, component: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return times and PCRB of a component, in a list of at most a pair.

    All filters share the data, so that the PCRB of any of them holds.

    Args:
        results: Results by label.
        component: Name of a state component.
    """
    for result in results.values():
        sd, names = pcrb_sd(result), result.meta["state"]["names"]
        if sd is not None and component in names:
            index = names.index(component)
            steps = thin_mask(~np.isnan(result.data["error"][..., index]).all(0))
            return [(result.data["time"][steps], sd[steps, index].astype(np.float64))]
    return []


def sum_nis(result: store.JobResult) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Sum the NIS over valid runs.

    Returns:
        Scored times [S], sum of NIS [S] and number of observed components [S], or None without
        innovations.
    """
    data = result.data
    if "nis" not in data or "score_steps" not in data:
        return None
    valid_mask = ~data["lost"]
    nis = np.asarray(data["nis"], dtype=np.float64)[valid_mask]
    dof = np.asarray(data["nis_dof"], dtype=np.float64)[valid_mask]
    finite_mask = ~(np.isnan(nis) | np.isnan(dof))
    nis, dof = np.where(finite_mask, nis, 0.0).sum(0), np.where(finite_mask, dof, 0.0).sum(0)
    observed_mask = dof > 0
    if not observed_mask.any():
        return None
    time = data["time"][data["score_steps"][observed_mask]]
    return time, nis[observed_mask], dof[observed_mask]


def east_north_up(state: Mapping[str, Any]) -> tuple[list[int], np.ndarray] | None:
    """Return the indices and signs of east, north and up position in the state, or None."""
    index = {str(name): i for i, name in enumerate(state["names"])}
    up = "position_U" if "position_U" in index else "position_D"
    names = ["position_E", "position_N", up]
    if not all(name in index for name in names):
        return None
    signs = np.array([1.0, 1.0, 1.0 if up == "position_U" else -1.0])
    return [index[name] for name in names], signs
