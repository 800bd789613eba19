"""Curves of the page of a study: errors over time and over a setting, calibration and single runs."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from itertools import product, zip_longest
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.board.entries import CellKey, ViewKey, round_values
from pfbench.report.journal.study_pack import ALL
from pfbench.results.conditions import drop_settings, main_component_group, parse_label
from pfbench.results.frame import select_indices
from pfbench.results.looks import MethodLook
from pfbench.results.store import JobResult
from pfbench.stats.error_measures import Array

CURVE_INSTANTS, FEW_CURVE_INSTANTS = 60, 24
_MANY = 300  # filters times conditions, from which curves have few instants


def make_curves(results: Mapping[str, JobResult], conditions: int = 1) -> dict[str, Any]:
    """Compute quantiles over runs of the error of the main group at up to 60 instants, or 24 of a large study."""
    first = next(iter(results.values()))
    group = main_component_group(first.meta["state"])
    most = CURVE_INSTANTS if len(results) * conditions <= _MANY else FEW_CURVE_INSTANTS
    norms = compute_error_norms(results)
    steps = select_truth_steps(norms.values(), most)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # instants without a run
        levels = {k: np.nanquantile(v[:, steps], [0.5, 0.1, 0.9], axis=0) for k, v in norms.items()}
    filters = {
        label: dict(zip(("median", "q10", "q90"), round_values(values.tolist()), strict=True))
        for label, values in levels.items()
    }
    time = round_values(first.data["time"][steps].tolist())
    return {"t": time, "filters": filters, "unit": group.unit, "group": group.group}


def compute_error_norms(results: Mapping[str, JobResult]) -> dict[str, Array]:
    """Compute the norm of the error of the main group in displayed units, [R, T] by label; NaN in lost runs."""
    return {label: np.sqrt((scale_errors(r) ** 2).sum(axis=-1)) for label, r in results.items()}


def scale_errors(result: JobResult) -> Array:
    """Return the errors of the main group in displayed units, [R, T, K]; NaN in lost runs."""
    group = main_component_group(result.meta["state"])
    error = group.scale * result.data["error"][..., group.places].astype(np.float64)
    return np.where(np.asarray(result.data["lost"], dtype=bool)[:, None, None], np.nan, error)


def select_truth_steps(norms: Iterable[Array], most: int) -> np.ndarray:
    """Select evenly spaced steps among those with truth.

    Shapes: norms [R, T].
    """
    has_truth = np.any([np.isfinite(norm).any(axis=0) for norm in norms], axis=0)
    steps = np.flatnonzero(has_truth) if has_truth.any() else np.arange(has_truth.size)
    return np.asarray(steps[select_indices(steps.size, most)])


def list_calibration(table: pd.DataFrame) -> dict[CellKey, Any]:
    """List coverage and NEES ratio of each filter, by cell and by scope."""
    columns = {"coverage_50": "c50", "coverage_90": "c90", "nees_ratio": "nees_ratio"}
    by_cell = table.groupby(["scenario", "regime", "filter"], sort=False)[list(columns)].mean()
    cells = by_cell.rename(columns=columns).reset_index(["scenario", "regime"])
    calibration: dict[CellKey, Any] = {}
    for world, regime in product(
        *((ALL, *sorted(cells[k].unique())) for k in ("scenario", "regime"))
    ):
        rows = cells[cells["scenario"].isin([world]) | (world == ALL)]
        rows = rows[rows["regime"].isin([regime]) | (regime == ALL)].drop(
            columns=["scenario", "regime"]
        )
        means = rows.groupby("filter", sort=ALL in (world, regime)).mean().to_dict("index")
        if means:
            calibration[str(world), str(regime)] = {
                str(k): round_values(v) for k, v in means.items()
            }
    return calibration


def list_runs(table: pd.DataFrame) -> dict[CellKey, Any]:
    """List the RMS error of each run, None for a lost one, by cell."""
    runs: dict[CellKey, Any] = {}
    for (world, regime), rows in table.groupby(["scenario", "regime"], sort=False):
        values = rows.pivot_table("rmse", "run", "filter", dropna=False)
        runs[str(world), str(regime)] = {
            "unit": rows["unit"].iloc[0], "name": "RMS error",
            "numbers": [int(number) for number in values.index],
            "values": {str(label): round_values(values[label].to_numpy().tolist()) for label in values},
        }  # fmt: skip
    return runs


# --------------------------------------------------------------------------------------------------
# Single runs of a condition for the page: true track, errors over time, traces, at few instants.

TRACK_INSTANTS = 40
_TRACKS = 3000  # of all filters, conditions and runs of a page [ours]
_MIN_RUNS = 10  # of each condition that a page carries, if its size allows it
_PLANES = (("position_E", "position_N"), ("x", "y"))  # components east and north


def count_carried_runs(filters: int, conditions: int) -> int:
    """Count the runs of a condition whose tracks a page carries."""
    return max(_MIN_RUNS, _TRACKS // max(1, filters * conditions))


def select_telling_runs(errors: Array, most: int) -> list[int]:
    """Select runs in turn: the most typical, the worst, the best, and the largest disagreement.

    Returns indices of the runs, the most telling first. Shapes: errors [F, N].
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

    Returns entry of the page: instants, unit, numbers, error, traces, and the plane if there is
    one. Shapes: errors [F, N], numbers [N].
    """
    first = next(iter(results.values()))
    group = main_component_group(first.meta["state"])
    runs = select_telling_runs(errors, most)
    norms = compute_error_norms(results)
    steps = select_truth_steps(norms.values(), TRACK_INSTANTS)
    time = first.data["time"]

    def by_run(values: Array) -> dict[str, Array]:
        return {str(numbers[k]): value for k, value in zip(runs, values, strict=True)}

    entry: dict[str, Any] = {
        "t": [float(f"{t:.4g}") for t in time[steps]],
        "unit": group.unit,
        "numbers": [int(numbers[k]) for k in runs],
        "note": f"{len(steps)} of {len(time)} instants." * (len(steps) < len(time)),
        "error": {label: by_run(norm[runs][:, steps]) for label, norm in norms.items()},
        "traces": _list_traces(results, runs, steps, by_run),
    }
    return entry | _describe_plane(results, runs, steps, by_run)


def _list_traces(
    results: Mapping[str, JobResult], runs: Sequence[int], steps: np.ndarray, by_run: Any
) -> list[dict[str, Any]]:
    """List effective sample size and normalised innovations, where results have them."""
    counted, scored = ({k: r for k, r in results.items() if name in r.data} for name in ("ess", "nis"))  # fmt: skip
    traces: list[dict[str, Any]] = []
    if counted:
        sizes = {k: by_run(r.data["ess"][runs][:, steps]) for k, r in counted.items()}
        traces.append({"name": "effective sample size", "unit": "", "log": True, "filters": sizes})
    if scored:
        data = next(iter(scored.values())).data
        traces.append({
            "name": "squared innovation divided by its expectation", "unit": "", "log": True,
            "filters": {k: by_run(_nis_ratio(r)[runs]) for k, r in scored.items()},
            "t": [float(f"{t:.4g}") for t in data["time"][data["score_steps"]]],
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
        label: by_run(np.where(data["lost"][:, None, None], np.nan, data["error"])[runs][:, steps][..., places])
        for label, (_, data) in results.items()
    }  # fmt: skip
    return {"truth": {"all": truth[0]} if is_common else by_run(truth), "plane": errors}


# --------------------------------------------------------------------------------------------------
# Dose and response: errors of filters over a setting that a study varies.


def list_sweeps(
    views: Mapping[ViewKey, Mapping[str, Any]], looks: Mapping[str, MethodLook], metric: str
) -> list[dict[str, Any]]:
    """List the settings that a study varies, with the errors of the filters in each condition.

    Filters without the setting are constant lines.
    """
    settings = pd.DataFrame(
        [
            (label, drop_settings(label, name), name, value)
            for label in looks for name, value in parse_label(label)[1].items()
        ],
        columns=["filter", "line", "name", "value"],
    )  # fmt: skip
    cells = {
        key[1:3]: {row["filter"]: row for row in view["rows"] if row["value"] is not None}
        for key, view in views.items() if key.metric == metric and ALL not in key[1:3]
    }  # fmt: skip
    sweeps = []
    for name, members in settings.groupby("name", sort=False):
        values = list(members["value"].unique())
        numbers = pd.to_numeric(pd.Series(values), errors="coerce")
        is_number = bool(numbers.notna().all())
        places = dict(zip(values, numbers if is_number else range(len(values)), strict=True))
        members = members.assign(x=members["value"].map(places))
        for (world, regime), rows in cells.items():
            if lines := _list_lines(members, rows, looks):
                unit = next((str(row["unit"]) for row in rows.values() if row["unit"]), "")
                sweeps.append({
                    "name": name, "world": world, "regime": regime, "unit": "", "ticks": None if is_number else values,
                    "value_unit": unit, "lines": lines, "caption": f"Error of a run against {name}.",
                })  # fmt: skip
    return sweeps


def _list_lines(
    members: pd.DataFrame, rows: Mapping[str, Mapping[str, Any]], looks: Mapping[str, MethodLook]
) -> list[dict[str, Any]]:
    """List the points of each method in one condition; none if no method has several values."""
    present = members[members["filter"].isin(list(rows))]
    if not present["line"].duplicated().any():
        return []
    lines: list[dict[str, Any]] = []
    for line, items in present.groupby("line", sort=False):
        look, (_, bracket, others) = looks[items["filter"].iloc[0]], str(line).partition("[")
        ordered = items.sort_values("x", kind="stable")
        points = [_point(x, rows[v]) for x, v in zip(ordered["x"], ordered["filter"], strict=True)]
        name = look.name.partition(" [")[0] + f" {bracket}{others}" * bool(bracket)
        lines.append({"filter": look.key, "name": name, "points": points})
    for label in [label for label in rows if label not in set(members["filter"])]:
        ends = [_point(x, rows[label]) for x in (members["x"].min(), members["x"].max())]
        lines.append({"filter": label, "name": looks[label].name, "points": ends})
    return lines


def _point(x: float, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the error of a row at a value of a setting."""
    return {"x": float(x), **{name: row[name] for name in ("value", "low", "high")}}
