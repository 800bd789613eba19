"""The datasheet of a scenario: trajectory, sensors, satellites, residuals and spread of the runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import scenario_figures, writers
from pfbench.report.writers import format_number
from pfbench.results import status, store
from pfbench.results.conditions import component_groups
from pfbench.results.plotting import FigureSpec, format_slug

_Figure = tuple[str, str, Callable[[store.JobResult], Figure]]  # name, caption, plot


def write_datasheet(
    file: str | Path, out: str | Path = "reports", formats: Sequence[str] = ("svg", "png")
) -> Path:
    """Write the page, figures and tables of a datasheet.

    The target folder is `<out>/datasheets/<scenario>_<noise>/`.

    Returns path of index.html.
    """
    sheet = store.read_result(file)
    if "residual" not in sheet.data:
        raise ValueError(
            f"file must be a datasheet, got the job {file}. "
            "Create one with: pfbench datasheet scenario=NAME"
        )
    choices = sheet.meta["choices"]
    name = format_slug(f"{choices['scenario']}_{choices['noise']}")
    tables = {"residuals": whiteness_table(sheet), "spread": spread_table(sheet)}
    context = {
        "name": f"{choices['scenario']} / {choices['noise']}",
        "meta": sheet.meta,
        "facts": list_facts(sheet),
        "missing": list_missing_figures(sheet),
        **tables,
        "settings": json.dumps(sheet.meta["config"]["scenario"], indent=1),
    }
    with RecordedFolder(Path(out) / "datasheets" / name) as folder:
        context["drawings"] = writers.write_figures(datasheet_figures(sheet), name, folder, formats)
        for stem, table in tables.items():
            if len(table):
                writers.write_table(folder, stem, table)
        return writers.render_template("datasheet", folder, context)


def datasheet_figures(sheet: store.JobResult) -> list[FigureSpec]:
    """List the figures that the data of the scenario allow."""
    rows = (*_truth_figures(sheet), *_measurement_figures(sheet), *_statistics_figures(sheet))
    return [FigureSpec(name, caption, partial(make, sheet)) for name, caption, make in rows]


def _truth_figures(sheet: store.JobResult) -> Iterator[_Figure]:
    """Yield the figures of track, range and inertial sensors."""
    data = sheet.data
    if "track" in data:
        has_others = len(scenario_figures.select_tracks(data["track"])) > 1
        others = " and of the other runs (grey)" if has_others else ""
        text = f"True track of the first run{others}: plan view and height above the start."
        yield "track", text, scenario_figures.plot_scenario_track
    if "range" in data:
        text = "Horizontal range from the observer to the target."
        yield "range", text, scenario_figures.plot_distance
    if "force" in data and "rate" in data:
        text = (
            "Specific force and angular rate in body axes, mean over each step. "
            "Simulated scenarios show true values, recorded scenarios the IMU of the first run."
        )
        yield "sensors", text, scenario_figures.plot_sensors


def _measurement_figures(sheet: store.JobResult) -> Iterator[_Figure]:
    """Yield the figures of the satellites and of the number of measurements."""
    has_satellites = "azimuth" in sheet.data
    if has_satellites:
        text = (
            "Satellites above the horizon of the first run, zenith in the centre. "
            "Arrows show the direction of motion."
        )
        yield "sky", text, scenario_figures.plot_sky
    if has_satellites or not (sheet.data["seen"] == 1).all():
        text = (
            f"Number of {'satellites and of ' if has_satellites else ''}observed measurement "
            "components over time, mean over runs."
        )
        yield "seen", text, scenario_figures.plot_measurements


def _statistics_figures(sheet: store.JobResult) -> Iterator[_Figure]:
    """Yield the figures of the residuals and of the spread of the runs."""
    if scenario_figures.group_residuals(sheet):
        text = (
            "Residuals at the true state, in standard deviations of the model, and the standard "
            "normal density. The outermost bins include all larger values."
        )
        yield "residuals", text, scenario_figures.plot_residuals
        text = "Residuals of the first run over time, with lines at two standard deviations."
        yield "residuals_time", text, scenario_figures.plot_residuals_over_time
    if sheet.meta["runs"] > 1 and scenario_figures.compute_spreads(sheet):
        text = "Spread of the true states over the runs (standard deviation of the norm)"
        if "pcrb" in sheet.data:
            text += (
                ", and the posterior Cramér-Rao bound (PCRB), a lower bound of the root mean "
                "square error. The bound exceeds the spread if the initial distribution of the "
                "filters is wider than that of the scenario"
            )
        yield "spread", f"{text}.", scenario_figures.plot_error_spread


def list_facts(sheet: store.JobResult) -> list[str]:
    """Describe the scenario in sentences."""
    data, meta = sheet.data, sheet.meta
    time, steps, kinds = data["time"], meta["steps"], meta["kinds"]
    pace = f" of {np.median(np.diff(time)):.3g} s" if steps > 1 else ""
    span = f"{time[0]:.4g} to {time[-1]:.5g} s"
    texts = [f"{steps} steps{pace}, {span}. {meta['runs']} runs, seed {meta['seed']}."]
    if "track" in data:
        texts.append(_describe_track(data["track"][0]))
    counts = ", ".join(f"{kinds.count(kind)} of {kind}" for kind in dict.fromkeys(kinds))
    observed = f"{100 * data['seen'].mean():.3g}"
    texts.append(f"Measurement of {len(kinds)} components: {counts}. Observed: {observed} %.")
    if "azimuth" in data:
        visible = scenario_figures.visible_satellites(sheet)
        is_sparse = scenario_figures.has_sparse_counts(visible)
        least = visible[visible > 0].min() if is_sparse else visible.min()
        total = data["elevation"].shape[1]
        texts.append(f"Satellites above the horizon: {least} to {visible.max()} of {total}.")
    residual = data["residual"]
    is_equal = scenario_figures.drop_equal_runs(residual).shape[0] == 1
    if is_equal and meta["runs"] > 1 and not np.isnan(residual).all():
        texts.append("All runs have equal residuals, which are counted once.")
    if "raw_estimate" in meta:
        texts.append(scenario_figures.describe_raw_estimate(meta))
    return [*texts, f"{meta['pcrb'][0].upper()}{meta['pcrb'][1:]}."]


def _describe_track(track: np.ndarray) -> str:
    """Describe length and height of a track [T, 3]."""
    moves = np.diff(track.astype(np.float64), axis=0)
    length = np.linalg.norm(moves[~np.isnan(moves).any(-1)], axis=-1).sum()
    low, high = np.nanmin(track[:, 2]), np.nanmax(track[:, 2])
    return (
        f"Track of the first run: {length / 1e3:.4g} km, "
        f"height {low:.4g} to {high:.4g} m above its start."
    )


def list_missing_figures(sheet: store.JobResult) -> list[str]:
    """List the missing figures with their reasons."""
    a, meta = sheet.data, sheet.meta
    reasons = []
    if "track" not in a:
        reasons.append("Track: the scenario does not use map coordinates.")
    if "force" not in a:
        reasons.append("Specific force and rates: not available in this scenario.")
    if "azimuth" not in a:
        reasons.append("Satellites: their directions are not available in this scenario.")
    unknown = np.isnan(a["residual"]).all((0, 1)) & (a["seen"] > 0).any(0)
    if unknown.any():
        kinds = ", ".join(
            f"{kind} ({n} of {meta['kinds'].count(kind)})"
            for kind, n in _count_kinds(meta["kinds"], unknown).items()
        )
        reasons.append(f"Residuals of {kinds}: they depend on states without truth.")
    if meta["runs"] < 2:
        reasons.append("Spread: runs must be at least 2, got 1. Set runs=20.")
    unknown_groups = [
        block.group
        for block in component_groups(meta["state"])
        if np.isnan(a["error"][..., block.places]).all()
    ]
    if unknown_groups:
        reasons.append(f"Spread of {', '.join(unknown_groups)}: the truth is not available.")
    others = [
        block for block in component_groups(meta["state"]) if block.group not in unknown_groups
    ]
    constant = [
        block.group
        for block in others
        if not scenario_figures.compute_deviation(a, block.places).any()
    ]
    if constant and meta["runs"] > 1:
        reasons.append(f"Spread of {', '.join(constant)}: equal in all runs.")
    return reasons


def whiteness_table(sheet: store.JobResult) -> pd.DataFrame:
    """Tabulate mean, variance and lag-1 autocorrelation of residuals with 95 % intervals."""
    rows = []
    for kind, z in scenario_figures.group_residuals(sheet).items():
        moments = status.compute_whiteness(z)
        rows.append({
            "measurement": kind,
            "components": z.shape[-1],
            "residuals": moments.numbers,
            "mean": moments.mean, "95 % interval of 0": f"± {format_number(moments.mean_band)}",
            "variance": moments.variance, "95 % interval of 1": f"± {format_number(moments.variance_band)}",
            "lag-1 autocorrelation": moments.lag, "95 % interval of no correlation": f"± {format_number(moments.lag_band)}",
            "outside 3 sd [%]": 100 * moments.outside_share,
        })  # fmt: skip
    return pd.DataFrame(rows)


def spread_table(sheet: store.JobResult) -> pd.DataFrame:
    """Tabulate the spread of the runs and the PCRB at the first, middle and last step with truth."""
    rows = []
    for block, time, value, bound in scenario_figures.compute_spreads(sheet):
        row: dict[str, Any] = {"group": block.group, "unit": block.unit}
        for name, t in (("first", 0), ("middle", len(time) // 2), ("last", len(time) - 1)):
            row[f"spread, {name} step"] = float(value[t])
            if bound is not None:
                row[f"PCRB, {name} step"] = float(bound[t])
        rows.append(row)
    return pd.DataFrame(rows)


def _count_kinds(kinds: Sequence[str], flags: np.ndarray) -> dict[str, int]:
    """Count the flagged components of each kind."""
    flagged = [kind for kind, flag in zip(kinds, flags, strict=True) if flag]
    return {kind: flagged.count(kind) for kind in dict.fromkeys(flagged)}
