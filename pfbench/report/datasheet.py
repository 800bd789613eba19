"""The datasheet of a scenario: trajectory, sensors, satellites, residuals and spread of the runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import scenario_figures, writers
from pfbench.report.page_kit import Block, with_heading, write_page
from pfbench.report.writers import format_number
from pfbench.results import status, store
from pfbench.results.conditions import component_groups
from pfbench.results.plotting import FigureSpec, format_slug


def write_datasheet(
    file: str | Path, out: str | Path = "reports", formats: Sequence[str] = ("svg", "png")
) -> Path:
    """Write the page, figures and tables of a datasheet.

    The target folder is `<out>/datasheets/<scenario>_<noise>/`.

    Returns path of index.html.
    """
    sheet = store.read_result(file)
    require(
        "residual" in sheet.data,
        "file",
        "be a datasheet",
        f"the job {file}",
        "Create one with: pfbench datasheet scenario=NAME",
    )
    scenario, noise = (sheet.meta["choices"][key] for key in ("scenario", "noise"))
    title, name = f"{scenario} / {noise}", format_slug(f"{scenario}_{noise}")
    tables = {"residuals": whiteness_table(sheet), "spread": spread_table(sheet)}
    with RecordedFolder(Path(out) / "datasheets" / name) as folder:
        drawings = writers.write_figures(datasheet_figures(sheet), name, folder, formats)
        for stem, table in tables.items():
            if len(table):
                writers.write_table(folder, stem, table)
        return write_page(
            folder, f"{title}: datasheet", list_blocks(title, sheet, drawings, tables)
        )


def list_blocks(
    title: str,
    sheet: store.JobResult,
    drawings: Sequence[Mapping[str, Any]],
    tables: Mapping[str, pd.DataFrame],
) -> list[Block]:
    """List the blocks of the page."""
    meta, versions, seconds = sheet.meta, sheet.meta["versions"], sheet.meta["seconds"]
    last = meta["first_run"] + meta["runs"] - 1
    return [
        Block("title", title),
        Block("text", f"Datasheet of a scenario: properties of its data, independent of filters. {meta.get('about') or ''}".rstrip()),
        *with_heading(Block("heading", "Summary"), Block("list", list_facts(sheet))),
        *with_heading(Block("heading", "Figures"), Block("figures", drawings)),
        *with_heading(Block("part", "Missing figures"), Block("list", list_missing_figures(sheet))),
        *with_heading(
            Block("heading", "Residuals at the true state"), Block("table", tables["residuals"]),
            Block("note", "The intervals contain an estimate with probability 95 % if the residuals are normal, white and independent with "
                  "the variance of the model. The lag counts steps with a measurement."),
        ),
        *with_heading(
            Block("heading", "Spread of the runs"), Block("table", tables["spread"]),
            Block("note", "Standard deviation over runs of the norm of a group, at the first, middle and last step with truth."),
        ),
        Block("heading", "Provenance"),
        Block("terms", [
            ("scenario, noise, model", ", ".join(meta["choices"][key] for key in ("scenario", "noise", "model"))),
            ("seed, runs", f"{meta['seed']}, {meta['first_run']} to {last}"),
            ("pfbench, commit", f"{versions['pfbench']}, {versions.get('commit') or versions.get('build') or 'not recorded'}"),
            ("time [s]", f"{format_number(seconds['world'])} for the data, {format_number(seconds['measures'])} for the datasheet"),
        ]),
        *with_heading(Block("part", "Modelling choices"), Block("list", meta.get("modelling_choices", ()))),
        Block("folded", json.dumps(meta["config"]["scenario"], indent=1), "Settings of the scenario"),
    ]  # fmt: skip


def datasheet_figures(sheet: store.JobResult) -> list[FigureSpec]:
    """List the figures that the data of the scenario allow."""
    data, has_satellites = sheet.data, "azimuth" in sheet.data
    tracks = scenario_figures.select_tracks(data["track"]) if "track" in data else ()
    others = " and of the other runs (grey)" if len(tracks) > 1 else ""
    has_residuals = bool(scenario_figures.group_residuals(sheet))
    has_spread = sheet.meta["runs"] > 1 and bool(scenario_figures.compute_spreads(sheet))
    bound = (
        ", and the posterior Cramér-Rao bound (PCRB), a lower bound of the root mean "
        "square error. The bound exceeds the spread if the initial distribution of the "
        "filters is wider than that of the scenario"
    )
    rows: tuple[tuple[bool, str, str, Callable[[store.JobResult], Figure]], ...] = (
        ("track" in data, "track", f"True track of the first run{others}: plan view and height above the start.",
         scenario_figures.plot_scenario_track),
        ("range" in data, "range", "Horizontal range from the observer to the target.", scenario_figures.plot_distance),
        ("force" in data and "rate" in data, "sensors", "Specific force and angular rate in body axes, mean over each step. "
         "Simulated scenarios show true values, recorded scenarios the IMU of the first run.", scenario_figures.plot_sensors),
        (has_satellites, "sky", "Satellites above the horizon of the first run, zenith in the centre. Arrows show the direction of motion.",
         scenario_figures.plot_sky),
        (has_satellites or not (data["seen"] == 1).all(), "seen", f"Number of {'satellites and of ' if has_satellites else ''}observed "
         "measurement components over time, mean over runs.", scenario_figures.plot_measurements),
        (has_residuals, "residuals", "Residuals at the true state, in standard deviations of the model, and the standard "
         "normal density. The outermost bins include all larger values.", scenario_figures.plot_residuals),
        (has_residuals, "residuals_time", "Residuals of the first run over time, with lines at two standard deviations.",
         scenario_figures.plot_residuals_over_time),
        (has_spread, "spread", f"Spread of the true states over the runs (standard deviation of the norm){bound if 'pcrb' in data else ''}.",
         scenario_figures.plot_error_spread),
    )  # fmt: skip
    return [FigureSpec(name, text, partial(make, sheet)) for is_there, name, text, make in rows if is_there]  # fmt: skip


def list_facts(sheet: store.JobResult) -> list[str]:
    """Describe the scenario in sentences."""
    data, meta = sheet.data, sheet.meta
    time, steps, kinds = data["time"], meta["steps"], meta["kinds"]
    pace = f" of {np.median(np.diff(time)):.3g} s" if steps > 1 else ""
    counts = ", ".join(f"{kinds.count(kind)} of {kind}" for kind in dict.fromkeys(kinds))
    observed = f"{100 * data['seen'].mean():.3g}"
    is_equal = len(scenario_figures.drop_equal_runs(data["residual"])) == 1
    is_counted_once = is_equal and meta["runs"] > 1 and not np.isnan(data["residual"]).all()
    texts = (
        f"{steps} steps{pace}, {time[0]:.4g} to {time[-1]:.5g} s. {meta['runs']} runs, seed {meta['seed']}.",
        _describe_track(data["track"][0]) if "track" in data else "",
        f"Measurement of {len(kinds)} components: {counts}. Observed: {observed} %.",
        _describe_satellites(sheet) if "azimuth" in data else "",
        "All runs have equal residuals, which are counted once." if is_counted_once else "",
        scenario_figures.describe_raw_estimate(meta) if "raw_estimate" in meta else "",
        f"{meta['pcrb'][0].upper()}{meta['pcrb'][1:]}.",
    )
    return list(filter(None, texts))


def _describe_satellites(sheet: store.JobResult) -> str:
    """Count the satellites above the horizon; where some steps have none, the least of the others."""
    visible = scenario_figures.visible_satellites(sheet)
    nonzero = visible[visible > 0] if scenario_figures.has_sparse_counts(visible) else visible
    total = sheet.data["elevation"].shape[1]
    return f"Satellites above the horizon: {nonzero.min()} to {visible.max()} of {total}."


def _describe_track(track: np.ndarray) -> str:
    """Describe length and height of a track [T, 3]."""
    moves, height = np.diff(track.astype(np.float64), axis=0), track[:, 2]
    length = np.linalg.norm(moves[~np.isnan(moves).any(-1)], axis=-1).sum()
    return (
        f"Track of the first run: {length / 1e3:.4g} km, "
        f"height {np.nanmin(height):.4g} to {np.nanmax(height):.4g} m above its start."
    )


def list_missing_figures(sheet: store.JobResult) -> list[str]:
    """List the missing figures with their reasons."""
    data, meta, groups = sheet.data, sheet.meta, component_groups(sheet.meta["state"])
    unseen = np.isnan(data["residual"]).all((0, 1)) & (data["seen"] > 0).any(0)
    flagged = [kind for kind, flag in zip(meta["kinds"], unseen, strict=True) if flag]
    kinds = ", ".join(
        f"{kind} ({flagged.count(kind)} of {meta['kinds'].count(kind)})"
        for kind in dict.fromkeys(flagged)
    )
    unknown = [g.group for g in groups if np.isnan(data["error"][..., g.places]).all()]
    constant = [
        g.group for g in groups
        if g.group not in unknown and not scenario_figures.compute_deviation(data, g.places).any()
    ]  # fmt: skip
    reasons = (
        ("track" not in data, "Track: the scenario does not use map coordinates."),
        ("force" not in data, "Specific force and rates: not available in this scenario."),
        ("azimuth" not in data, "Satellites: their directions are not available in this scenario."),
        (bool(kinds), f"Residuals of {kinds}: they depend on states without truth."),
        (meta["runs"] < 2, "Spread: runs must be at least 2, got 1. Set runs=20."),
        (bool(unknown), f"Spread of {', '.join(unknown)}: the truth is not available."),
        (bool(constant) and meta["runs"] > 1, f"Spread of {', '.join(constant)}: equal in all runs."),
    )  # fmt: skip
    return [text for is_so, text in reasons if is_so]


def whiteness_table(sheet: store.JobResult) -> pd.DataFrame:
    """Tabulate mean, variance and lag-1 autocorrelation of residuals with 95 % intervals."""
    groups = scenario_figures.group_residuals(sheet)
    moments = {kind: status.compute_whiteness(z) for kind, z in groups.items()}
    return pd.DataFrame([
        {
            "measurement": kind, "components": groups[kind].shape[-1], "residuals": m.numbers,
            "mean": m.mean, "95 % interval of 0": f"± {format_number(m.mean_band)}",
            "variance": m.variance, "95 % interval of 1": f"± {format_number(m.variance_band)}",
            "lag-1 autocorrelation": m.lag, "95 % interval of no correlation": f"± {format_number(m.lag_band)}",
            "outside 3 sd [%]": 100 * m.outside_share,
        }
        for kind, m in moments.items()
    ])  # fmt: skip


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
