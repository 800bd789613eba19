"""The datasheet of a scene as a page: the path, the sensors, the sky, the measurements at the truth, the spread of the runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench import metrics, store
from pfbench.report import files, scene, scene_figures, tables
from pfbench.report.canvas import slug
from pfbench.report.figures import Drawing
from pfbench.report.frame import blocks


def write(file: str | Path, out: str | Path = "reports", formats: Sequence[str] = ("svg", "png")) -> Path:
    """Writes `<out>/datasheets/<scenario>_<noise>/`: index.html, report.md, figures/, tables/, from the file alone.

    Args:
        file: from `survey`.
        out: folder of all reports.
        formats: of the figures.

    Returns:
        The page, index.html.

    Raises:
        FileNotFoundError, ValueError: no file, or no datasheet in it.
    """
    sheet = store.load(file)
    if "residual" not in sheet.arrays:
        raise ValueError(f"{file} holds a job and no datasheet; make one with: pfbench report scenario=NAME")
    choices = sheet.meta["choices"]
    own = slug(f"{choices['scenario']}_{choices['noise']}")
    folder = Path(out) / "datasheets" / own
    files.clear(folder)
    drawn = [files.drawn(drawing, own, folder, formats) for drawing in drawings(sheet)]
    residuals, spreads = whiteness(sheet), growth(sheet)
    for name, table in (("residuals", residuals), ("spread", spreads)):
        if len(table):
            files.save_table(folder, name, table)
    context = {
        "name": f"{choices['scenario']} / {choices['noise']}",
        "meta": sheet.meta,
        "facts": facts(sheet),
        "missing": missing(sheet),
        "drawings": drawn,
        "residuals": residuals,
        "spread": spreads,
        "settings": json.dumps(sheet.meta["config"]["scenario"], indent=1),
    }
    return files.render("datasheet", folder, context)


def drawings(sheet: store.Result) -> list[Drawing]:
    """All figures that the scene has data for."""
    found: list[tuple[str, str, Callable[[store.Result], Figure]]] = []
    there, runs = sheet.arrays, sheet.meta["runs"]
    if "track" in there:
        each = ", and those of the other runs (grey)" if len(scene.tracks(there["track"])) > 1 else ""
        text = f"True track of the first run{each}: plan view and height above the start."
        found.append(("track", text, scene_figures.track))
    if "range" in there:
        found.append(("range", "Horizontal range from the observer to the target.", scene_figures.distance))
    if "force" in there and "rate" in there:
        text = (
            "Specific force and angular rate in body axes, mean over each step: the true ones where the scene is simulated, of "
            "the first run's IMU where it was recorded."
        )
        found.append(("sensors", text, scene_figures.sensors))
    if "azimuth" in there:
        text = "Satellites above the horizon of the first run, zenith in the middle; an arrow shows the way each one goes."
        found.append(("sky", text, scene_figures.sky))
    if "azimuth" in there or not (there["seen"] == 1).all():
        text = "What is measured over time: number of satellites and of components of the measurement, mean over runs."
        found.append(("seen", text if "azimuth" in there else text.replace("satellites and of ", ""), scene_figures.seen))
    if scene.by_kind(sheet):
        text = "Measurements less what the model expects at the truth, in its standard deviations, beside the normal law"
        found.append(("residuals", f"{text}. The outermost bins hold all that lies beyond.", scene_figures.residuals))
        text = "The same of the first run over time; lines at two standard deviations."
        found.append(("residuals_time", text, scene_figures.over_time))
    if runs > 1 and scene.spreads(sheet):
        text = "Spread of the true states over the runs (standard deviation of the norm)"
        extra = (
            ", and the Cramer-Rao bound, below which no filter's rms error lies. It is above the spread where filters are told "
            "less of the start than the scene fixes"
        ) if "bound" in there else ""
        found.append(("spread", f"{text}{extra}.", scene_figures.spread))
    return [Drawing(name, caption, partial(make, sheet)) for name, caption, make in found]


def facts(sheet: store.Result) -> list[str]:
    """What the scene is, in sentences."""
    a, meta = sheet.arrays, sheet.meta
    time, steps = a["time"], meta["steps"]
    gaps = np.diff(time)
    pace = f" of {np.median(gaps):.3g} s" if steps > 1 else ""
    said = [f"{steps} steps{pace}, {time[0]:.4g} to {time[-1]:.5g} s; {meta['runs']} runs, seed {meta['seed']}."]
    if "track" in a:
        way = np.diff(a["track"][0].astype(np.float64), axis=0)
        way = way[~np.isnan(way).any(-1)]
        length, height = np.linalg.norm(way, axis=-1).sum(), a["track"][0, :, 2]
        low, high = np.nanmin(height), np.nanmax(height)
        said.append(f"Track of the first run: {length / 1e3:.4g} km, heights from {low:.4g} to {high:.4g} m above its start.")
    kinds = meta["kinds"]
    each = ", ".join(f"{kinds.count(kind)} of {kind}" for kind in dict.fromkeys(kinds))
    said.append(f"Measurement of {len(kinds)} components: {each}. Seen: {100 * a['seen'].mean():.3g} % of them.")
    if "azimuth" in a:
        up = scene.visible(sheet)
        least = up[up > 0].min() if scene.between_epochs(up) else up.min()
        said.append(f"Satellites above the horizon: {least} to {up.max()} of {a['elevation'].shape[1]}.")
    if (scene.distinct(a["residual"]).shape[0] == 1) and meta["runs"] > 1 and not np.isnan(a["residual"]).all():
        said.append("All runs have the same residuals; they are counted once.")
    return [*said, f"{meta['bound'][0].upper()}{meta['bound'][1:]}."]


def missing(sheet: store.Result) -> list[str]:
    """What is not drawn, and why."""
    a, meta = sheet.arrays, sheet.meta
    found = []
    if "track" not in a:
        found.append("No track: the scene has no map.")
    if "force" not in a:
        found.append("No specific force and rates: the scene tells none.")
    if "azimuth" not in a:
        found.append("No sky: the scene tells no directions of satellites.")
    unknown = np.isnan(a["residual"]).all((0, 1)) & (a["seen"] > 0).any(0)
    if unknown.any():
        which = ", ".join(f"{kind} ({n} of {meta['kinds'].count(kind)})" for kind, n in _counted(meta["kinds"], unknown).items())
        found.append(f"No residuals of {which}: they hang on states whose truth is not known.")
    if meta["runs"] < 2:
        found.append("No spread: it takes two runs at least; give runs=20.")
    gone = [block.group for block in blocks(meta["state"]) if np.isnan(a["error"][..., block.places]).all()]
    if gone:
        found.append(f"No spread of {', '.join(gone)}: the truth is not known.")
    others = [block for block in blocks(meta["state"]) if block.group not in gone]
    still = [block.group for block in others if not scene.deviation(a, block.places).any()]
    if still and meta["runs"] > 1:
        found.append(f"No spread of {', '.join(still)}: the same in all runs.")
    return found


def whiteness(sheet: store.Result) -> pd.DataFrame:
    """One row per kind of measurement: mean, variance and lag-1 autocorrelation of the residuals, with 95 % bands."""
    rows = []
    for kind, z in scene.by_kind(sheet).items():
        law = metrics.whiteness(z)
        rows.append({
            "measurement": kind,
            "components": z.shape[-1],
            "numbers": law.numbers,
            "mean": law.mean, "band of 0": f"± {tables.number(law.mean_band)}",
            "variance": law.variance, "band of 1": f"± {tables.number(law.variance_band)}",
            "lag-1 autocorrelation": law.lag, "band of no correlation": f"± {tables.number(law.lag_band)}",
            "beyond 3 in %": 100 * law.beyond,
        })  # fmt: skip
    return pd.DataFrame(rows)


def growth(sheet: store.Result) -> pd.DataFrame:
    """One row per group: spread of the runs at the first, middle and last step with truth, and the bound there."""
    rows = []
    for block, time, value, bound in scene.spreads(sheet):
        row: dict[str, Any] = {"group": block.group, "unit": block.unit}
        for name, t in (("first", 0), ("middle", len(time) // 2), ("last", len(time) - 1)):
            row[f"spread, {name} step"] = float(value[t])
            if bound is not None:
                row[f"bound, {name} step"] = float(bound[t])
        rows.append(row)
    return pd.DataFrame(rows)


def _counted(kinds: Sequence[str], flags: np.ndarray) -> dict[str, int]:
    own = [kind for kind, flag in zip(kinds, flags, strict=True) if flag]
    return {kind: own.count(kind) for kind in dict.fromkeys(own)}
