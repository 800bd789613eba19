"""Curves over time, calibration and single runs of the page of a study."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.journal.study_pack import ALL
from pfbench.results.error_measures import Array
from pfbench.results.frame import select_indices
from pfbench.results.state_groups import main_component_group
from pfbench.results.store import JobResult

CURVE_INSTANTS, FEW_CURVE_INSTANTS = 60, 24
_MANY = 300  # filters times conditions, from which curves have few instants
CellKey = tuple[str, str]


def make_curves(results: Mapping[str, JobResult], conditions: int = 1) -> dict[str, Any]:
    """Compute quantiles over runs of the error of the main group at up to 60 instants, or 24 of a large study.

    Args:
        results: Results of the filters of a condition by label.
        conditions: Number of conditions of the study.
    """
    first = next(iter(results.values()))
    group = main_component_group(first.meta["state"])
    most = CURVE_INSTANTS if len(results) * conditions <= _MANY else FEW_CURVE_INSTANTS
    norms = compute_error_norms(results)
    steps = select_truth_steps(norms.values(), most)
    filters = {}
    for label, norm in norms.items():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # instants without a run
            low, median, high = np.nanquantile(norm[:, steps], [0.1, 0.5, 0.9], axis=0)
        filters[label] = {
            "median": _numbers(median), "q10": _numbers(low), "q90": _numbers(high),
        }  # fmt: skip
    time = _numbers(first.data["time"][steps])
    return {"t": time, "filters": filters, "unit": group.unit, "group": group.group}


def compute_error_norms(results: Mapping[str, JobResult]) -> dict[str, Array]:
    """Compute the norm of the error of the main group in displayed units, [R, T] by label; NaN in lost runs.

    Args:
        results: Results of the filters of a condition by label.
    """
    norms = {}
    for label, result in results.items():
        group = main_component_group(result.meta["state"])
        error = result.data["error"][..., group.places].astype(np.float64)
        norm = np.sqrt((error**2).sum(axis=-1)) * group.scale
        norm[np.asarray(result.data["lost"], dtype=bool)] = np.nan
        norms[label] = norm
    return norms


def select_truth_steps(norms: Iterable[Array], most: int) -> np.ndarray:
    """Select evenly spaced steps among those with truth.

    Args:
        norms: Errors of the filters, [R, T].
        most: Number of steps at most.
    """
    has_truth = np.any([np.isfinite(norm).any(axis=0) for norm in norms], axis=0)
    steps = np.flatnonzero(has_truth) if has_truth.any() else np.arange(has_truth.size)
    return np.asarray(steps[select_indices(steps.size, most)])


def list_calibration(table: pd.DataFrame) -> dict[CellKey, Any]:
    """List coverage and NEES ratio of each filter, by cell and by scope.

    Args:
        table: Table of `build_run_table`.
    """
    columns = {"coverage_50": "c50", "coverage_90": "c90", "nees_ratio": "nees_ratio"}
    cells = table.groupby(["scenario", "regime", "filter"], sort=False)[list(columns)].mean()
    cells = cells.rename(columns=columns)
    scopes = {(ALL, ALL): cells.groupby("filter").mean()}
    for world, rows in cells.groupby("scenario"):
        scopes[str(world), ALL] = rows.groupby("filter").mean()
    for noise, rows in cells.groupby("regime"):
        scopes[ALL, str(noise)] = rows.groupby("filter").mean()
    for (scenario, regime), rows in cells.groupby(["scenario", "regime"]):
        scopes[str(scenario), str(regime)] = rows.droplevel([0, 1])
    return {
        key: {
            str(label): {name: _number(value) for name, value in row.items()}
            for label, row in rows.to_dict("index").items()
        }
        for key, rows in scopes.items()
    }


def list_runs(table: pd.DataFrame) -> dict[CellKey, Any]:
    """List the RMS error of each run, None for a lost one, by cell.

    Args:
        table: Table of `build_run_table`.
    """
    runs: dict[CellKey, Any] = {}
    for (world, regime), rows in table.groupby(["scenario", "regime"], sort=False):
        values = rows.pivot_table("rmse", "run", "filter", dropna=False)
        runs[str(world), str(regime)] = {
            "unit": rows["unit"].iloc[0], "name": "RMS error",
            "numbers": [int(number) for number in values.index],
            "values": {str(label): _numbers(values[label].to_numpy()) for label in values},
        }  # fmt: skip
    return runs


def _numbers(values: np.ndarray) -> list[float | None]:
    return [_number(value) for value in values.tolist()]


def _number(value: float) -> float | None:
    """Round a number to four digits; None if it is not finite."""
    return float(f"{value:.4g}") if math.isfinite(value) else None
