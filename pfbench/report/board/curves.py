"""Curves over time, calibration and single runs of the page of a study."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.plots.plotting import select_indices
from pfbench.results.conditions import Condition
from pfbench.results.state_groups import main_component_group

INSTANTS = 60
ALL = "all"


def list_curves(conditions: Sequence[Condition]) -> dict[str, Any]:
    """List quantiles over runs of the error of the main group at up to 60 instants, by cell.

    Args:
        conditions: Conditions of the study.
    """
    curves: dict[str, Any] = {}
    for condition in conditions:
        key = f"{condition.scenario}/{condition.noise}"
        if key in curves:  # another model of the scenario
            key += f" + {condition.model}"
        norms, time, group = {}, np.zeros(0), None
        for job in condition.jobs:
            result = job.load()
            group = main_component_group(result.meta["state"])
            time = result.data["time"]
            error = result.data["error"][..., group.places].astype(np.float64)
            norms[job.label] = np.sqrt((error**2).sum(axis=-1)) * group.scale
            norms[job.label][np.asarray(result.data["lost"], dtype=bool)] = np.nan
        # steps without truth are dropped before thinning, which could miss rare steps with truth
        steps = np.flatnonzero(np.any([np.isfinite(n).any(axis=0) for n in norms.values()], axis=0))
        steps = steps if steps.size else np.arange(time.size)
        steps = steps[select_indices(steps.size, INSTANTS)]
        filters = {}
        for label, norm in norms.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # instants without a run
                low, median, high = np.nanquantile(norm[:, steps], [0.1, 0.5, 0.9], axis=0)
            filters[label] = {
                "median": _numbers(median), "q10": _numbers(low), "q90": _numbers(high),
            }  # fmt: skip
        unit, name = (group.unit, group.group) if group else ("", "")
        curves[key] = {"t": _numbers(time[steps]), "filters": filters, "unit": unit, "group": name}
    return curves


def list_calibration(table: pd.DataFrame) -> dict[str, Any]:
    """List coverage and NEES ratio of each filter, by cell and by scope.

    Args:
        table: Table of `build_run_table`.
    """
    columns = {"coverage_50": "c50", "coverage_90": "c90", "nees_ratio": "nees_ratio"}
    cells = table.groupby(["scenario", "regime", "filter"], sort=False)[list(columns)].mean()
    cells = cells.rename(columns=columns)
    scopes = {f"{ALL}/{ALL}": cells.groupby("filter").mean()}
    for world, rows in cells.groupby("scenario"):
        scopes[f"{world}/{ALL}"] = rows.groupby("filter").mean()
    for noise, rows in cells.groupby("regime"):
        scopes[f"{ALL}/{noise}"] = rows.groupby("filter").mean()
    for (scenario, regime), rows in cells.groupby(["scenario", "regime"]):
        scopes[f"{scenario}/{regime}"] = rows.droplevel([0, 1])
    return {
        key: {
            str(label): {name: _number(value) for name, value in row.items()}
            for label, row in rows.to_dict("index").items()
        }
        for key, rows in scopes.items()
    }


def list_runs(table: pd.DataFrame) -> dict[str, Any]:
    """List the RMS error of each run, None for a lost one, by cell.

    Args:
        table: Table of `build_run_table`.
    """
    runs = {}
    for (world, regime), rows in table.groupby(["scenario", "regime"], sort=False):
        values = rows.pivot_table("rmse", "run", "filter", dropna=False)
        runs[f"{world}/{regime}"] = {
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
