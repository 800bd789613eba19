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
from pfbench.report import page, tables
from pfbench.report.canvas import COLUMN, labelled, legend, log_if_wide, looks, slug, stack, thinned
from pfbench.report.figures import Drawing
from pfbench.report.frame import blocks

_BOUND: Any = {"color": "black", "ls": (0, (4, 1.5)), "lw": 0.9}
_AXES = ("right", "forward", "up")
_SHOWN = 5.0  # standard deviations to which a histogram reaches


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
    page.clear(folder)
    drawn = [page.drawn(drawing, own, folder, formats) for drawing in drawings(sheet)]
    residuals, spreads = whiteness(sheet), growth(sheet)
    for name, table in (("residuals", residuals), ("spread", spreads)):
        if len(table):
            page.save_table(folder, name, table)
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
    return page.render("datasheet", folder, context)


def drawings(sheet: store.Result) -> list[Drawing]:
    """All figures that the scene has data for."""
    found: list[tuple[str, str, Callable[[store.Result], Figure]]] = []
    there, runs = sheet.arrays, sheet.meta["runs"]
    if "track" in there:
        each = ", and those of the other runs (grey)" if len(_tracks(there["track"])) > 1 else ""
        found.append(("track", f"True track of the first run{each}: plan view and height above the start.", track))
    if "range" in there:
        found.append(("range", "Horizontal range from the observer to the target.", distance))
    if "force" in there and "rate" in there:
        found.append(("sensors", "True specific force and angular rate in body axes, mean over each step.", sensors))
    if "azimuth" in there:
        text = "Satellites above the horizon of the first run, zenith in the middle; an arrow shows the way each one goes."
        found.append(("sky", text, sky))
    if "azimuth" in there or not (there["seen"] == 1).all():
        text = "What is measured over time: number of satellites and of components of the measurement, mean over runs."
        found.append(("seen", text if "azimuth" in there else text.replace("satellites and of ", ""), seen))
    if _residuals(sheet):
        text = "Measurements less what the model expects at the truth, in its standard deviations, beside the normal law"
        found.append(("residuals", f"{text}. The outermost bins hold all that lies beyond.", residuals))
        found.append(("residuals_time", "The same of the first run over time; lines at two standard deviations.", over_time))
    if runs > 1 and _spread(sheet):
        text = "Spread of the true states over the runs (standard deviation of the norm)"
        extra = (
            ", and the Cramer-Rao bound, below which no filter's rms error lies. It is above the spread where filters are told "
            "less of the start than the scene fixes"
        ) if "bound" in there else ""
        found.append(("spread", f"{text}{extra}.", spread))
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
        up = (~np.isnan(a["elevation"])).sum(1)
        said.append(f"Satellites above the horizon: {up.min()} to {up.max()} of {len(meta['satellites'])}.")
    if (_alone(a["residual"]).shape[0] == 1) and meta["runs"] > 1 and not np.isnan(a["residual"]).all():
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
    still = [block.group for block in blocks(meta["state"]) if block.group not in gone and not _deviation(a, block.places).any()]
    if still and meta["runs"] > 1:
        found.append(f"No spread of {', '.join(still)}: the same in all runs.")
    return found


def whiteness(sheet: store.Result) -> pd.DataFrame:
    """One row per kind of measurement: mean, variance and lag-1 autocorrelation of the residuals, with 95 % bands."""
    rows = []
    for kind, z in _residuals(sheet).items():
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
    for block, time, value, bound in _spread(sheet):
        row: dict[str, Any] = {"group": block.group, "unit": block.unit}
        for name, t in (("first", 0), ("middle", len(time) // 2), ("last", len(time) - 1)):
            row[f"spread, {name} step"] = float(value[t])
            if bound is not None:
                row[f"bound, {name} step"] = float(bound[t])
        rows.append(row)
    return pd.DataFrame(rows)


def track(sheet: store.Result) -> Figure:
    """Plan view and height over time."""
    figure = Figure(figsize=(COLUMN, 4.8), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1))
    paths, time = _tracks(sheet.arrays["track"]), sheet.arrays["time"]
    reach = np.nanmax(np.abs(paths[..., :2]))
    unit, scale = ("km", 1e-3) if reach > 5e3 else ("m", 1.0)
    thin = thinned(time.size)
    for path in paths[1:21, thin]:
        plan.plot(path[:, 0] * scale, path[:, 1] * scale, color="0.75", lw=0.7)
        height.plot(time[thin], path[:, 2], color="0.75", lw=0.7)
    first = paths[0][~np.isnan(paths[0]).any(-1)]
    plan.plot(first[:, 0] * scale, first[:, 1] * scale, color="#0072B2", lw=1.3, label="first run")
    height.plot(time[thin], paths[0, thin, 2], color="#0072B2", lw=1.3)
    for label, place, fill in (("start", first[0], "white"), ("end", first[-1], "#0072B2")):
        shape: Any = {"marker": "o" if label == "start" else "s", "ms": 5, "ls": "none", "zorder": 5}
        plan.plot(*(place[:2] * scale), mfc=fill, color="#0072B2", label=label, **shape)
    plan.set(xlabel=f"east in {unit}", ylabel=f"north in {unit}")
    plan.set_aspect("equal", adjustable="datalim")
    plan.locator_params(axis="x", nbins=5)
    height.set(xlabel="time in s", ylabel="height in m")
    legend(figure, plan, columns=3)
    return figure


def distance(sheet: store.Result) -> Figure:
    """Range over time."""
    figure, (axis,) = stack(1, 1.6)
    axis.plot(sheet.arrays["time"], sheet.arrays["range"] / 1e3, color="#0072B2")
    axis.set(xlabel="time in s", ylabel="horizontal range in km")
    return figure


def sensors(sheet: store.Result) -> Figure:
    """Specific force and angular rate over time, one line per axis of the body."""
    figure, panels = stack(2, 1.7)
    lines = list(looks(_AXES).values())
    time, turn = sheet.arrays["time"], sheet.arrays["rate"] * np.degrees(1)
    told = (sheet.arrays["force"], "specific force in m/s²"), (turn, "rate in deg/s")
    for axis, (values, what) in zip(panels, told, strict=True):
        for k, name in enumerate(_AXES):
            axis.plot(time, values[:, k], color=lines[k].colour, ls=lines[k].dash, lw=1.1, label=name)
        axis.set_ylabel(what)
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0], columns=3)
    return figure


def sky(sheet: store.Result) -> Figure:
    """Where satellites stand, North up, East to the right."""
    figure = Figure(figsize=(COLUMN, 3.6), layout="constrained")
    axis: Any = figure.add_subplot(projection="polar")
    axis.set_theta_zero_location("N")
    axis.set_theta_direction(-1)
    axis.set_rlim(0, 90)
    axis.set_thetagrids(range(0, 360, 45), labels=["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    azimuth, zenith = sheet.arrays["azimuth"].astype(float), 90 - np.degrees(sheet.arrays["elevation"].astype(float))
    axis.set_rgrids([30, 60], labels=["60°", "30°"], angle=_clear_of(azimuth, zenith), color="0.4", fontsize=6.5)
    paths = [(name, azimuth[:, s], zenith[:, s]) for s, name in enumerate(sheet.meta["satellites"])]
    for look, (name, theta, r) in zip(looks([path[0] for path in paths]).values(), paths, strict=True):
        known = np.flatnonzero(~np.isnan(theta) & ~np.isnan(r))
        if not known.size:
            continue
        axis.plot(theta[known], r[known], color=look.colour, lw=1.6, solid_capstyle="round")
        tip, before = known[-1], known[max(0, known.size - 1 - max(1, known.size // 10))]
        if tip != before and np.hypot(r[tip] * (theta[tip] - theta[before]), r[tip] - r[before]) > 0.05:
            arrow: Any = {"arrowstyle": "-|>", "color": look.colour, "lw": 0.8, "mutation_scale": 9, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", (theta[tip], r[tip]), (theta[before], r[before]), arrowprops=arrow)
        offset: Any = {"textcoords": "offset points", "fontsize": 7, "color": look.colour, "ha": "center", "va": "center"}
        axis.annotate(str(name), (theta[known[0]], r[known[0]]), _aside(theta[known], r[known]), **offset)
    return figure


def seen(sheet: store.Result) -> Figure:
    """Satellites and components of the measurement over time."""
    a = sheet.arrays
    figure, panels = stack(2 if "azimuth" in a else 1, 1.3)
    if "azimuth" in a:
        panels[0].step(a["time"], (~np.isnan(a["elevation"])).sum(1), where="mid", color="#0072B2", lw=1.1)
        panels[0].set(ylabel="satellites")
    count = a["seen"].astype(float).sum(1)
    rare = (count == 0).any() and (count > 0).any()
    shown = count > 0 if rare else np.ones_like(count, dtype=bool)
    line: Any = {"ls": "none", "marker": ".", "ms": 2.5} if rare else {"ls": "-"}
    panels[-1].plot(a["time"][shown], count[shown], color="#D55E00", **line)
    panels[-1].set(ylabel="components", xlabel="time in s")
    for axis in panels:
        axis.set_ylim(bottom=0)
    return figure


def residuals(sheet: store.Result) -> Figure:
    """Histogram of each kind of measurement beside the normal law."""
    found = _residuals(sheet)
    figure, panels = stack(len(found), 1.5)
    x = np.linspace(-_SHOWN, _SHOWN, 201)
    for axis, (kind, z) in zip(panels, found.items(), strict=True):
        law = metrics.whiteness(z)
        values = np.clip(z[~np.isnan(z)], -_SHOWN, _SHOWN)
        bins = int(np.clip(2 * np.sqrt(values.size), 11, 61))
        axis.hist(values, bins=bins, range=(-_SHOWN, _SHOWN), density=True, color="#56B4E9", alpha=0.75, label="residuals")
        axis.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi), color="black", lw=1, label="normal law")
        title = f"{kind}: variance {law.variance:.3g} (1 ± {law.variance_band:.2g}), "
        axis.set_title(f"{title}lag-1 {law.lag:+.2g} (± {law.lag_band:.2g})", fontsize=7)
        axis.set_ylabel("density")
    panels[-1].set_xlabel("residual in standard deviations")
    legend(figure, panels[0])
    return figure


def over_time(sheet: store.Result) -> Figure:
    """Residuals of the first run."""
    found = _residuals(sheet)
    figure, panels = stack(len(found), 1.3)
    for axis, (kind, z) in zip(panels, found.items(), strict=True):
        first = z[0]
        time = np.broadcast_to(sheet.arrays["time"][:, None], first.shape)
        known = ~np.isnan(first)
        axis.plot(time[known], first[known], ls="none", marker=".", ms=3, color="#0072B2", alpha=0.8, mew=0)
        for edge in (-2, 2):
            axis.axhline(edge, color="black", lw=0.7, ls=(0, (4, 2)))
        axis.set(title=kind, ylabel="residual in sd")
    panels[-1].set_xlabel("time in s")
    return figure


def spread(sheet: store.Result) -> Figure:
    """Standard deviation over runs of the norm of each group, and the bound."""
    found = _spread(sheet)
    figure, panels = stack(len(found), 1.15)
    for axis, (block, time, value, bound) in zip(panels, found, strict=True):
        thin = thinned(time.size)
        mark = "." if time.size == 1 else ""
        axis.plot(time[thin], value[thin], color="#0072B2", label="spread of the runs", marker=mark)
        if bound is not None:
            axis.plot(time[thin], bound[thin], label="Cramer-Rao bound", marker=mark, **_BOUND)
        axis.set(title=block.group, ylabel=labelled("spread", block.unit))
        log_if_wide(axis, axis.yaxis, [np.asarray(line.get_ydata()) for line in axis.lines])
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0])
    return figure


def _spread(sheet: store.Result) -> list[tuple[Any, np.ndarray, np.ndarray, np.ndarray | None]]:
    """Each block whose truth differs between runs: its instants with truth, the spread and the bound there, in the unit shown."""
    found = []
    for block in blocks(sheet.meta["state"]):
        value = _deviation(sheet.arrays, block.places) * block.scale
        known = ~np.isnan(value)
        if known.any() and value[known].any():
            bound = None
            if "bound" in sheet.arrays:
                bound = np.sqrt((sheet.arrays["bound"][known][:, block.places].astype(np.float64) ** 2).sum(-1)) * block.scale
            found.append((block, sheet.arrays["time"][known], value[known], bound))
    return found


def _deviation(arrays: dict[str, np.ndarray], places: list[int]) -> np.ndarray:
    """Standard deviation over runs of the norm of some components [T]; NaN where fewer than two runs have a truth."""
    square = (arrays["error"][..., places].astype(np.float64) ** 2).sum(-1)
    count = (~np.isnan(square)).sum(0)
    return np.sqrt(np.where(count > 1, np.nansum(square, 0) / np.maximum(count - 1, 1), np.nan))


def _residuals(sheet: store.Result) -> dict[str, np.ndarray]:
    """Residuals [R or 1, T, k] of each kind of measurement, of the components that are known and the instants with any."""
    z = _alone(sheet.arrays["residual"].astype(np.float64))
    known = ~np.isnan(z).all((0, 1))
    kinds = np.array(sheet.meta["kinds"])
    each = {kind: z[..., (kinds == kind) & known] for kind in dict.fromkeys(sheet.meta["kinds"])}
    return {str(kind): part for kind, part in each.items() if part.shape[-1]}


def _alone(z: np.ndarray) -> np.ndarray:
    """One run where all have the same residuals: then they are no more numbers than that."""
    return z[:1] if np.allclose(z, z[:1], rtol=0, atol=1e-4, equal_nan=True) else z


def _tracks(track: np.ndarray) -> np.ndarray:
    """The tracks [k, T, 3] that differ: one where all runs fly the same."""
    return track[:1] if np.array_equal(track, np.broadcast_to(track[:1], track.shape), equal_nan=True) else track


def _counted(kinds: Sequence[str], flags: np.ndarray) -> dict[str, int]:
    own = [kind for kind, flag in zip(kinds, flags, strict=True) if flag]
    return {kind: own.count(kind) for kind in dict.fromkeys(own)}


def _clear_of(azimuth: np.ndarray, zenith: np.ndarray) -> float:
    """The direction, in degrees between two rays of the grid, in which the rings' names are farthest from all satellites."""
    known = ~np.isnan(azimuth)
    there = zenith[known] * np.exp(1j * azimuth[known])
    directions = np.arange(22.5, 360, 45)

    def room(direction: float) -> float:
        return min(float(np.abs(there - ring * np.exp(1j * np.radians(direction))).min(initial=90)) for ring in (30, 60))

    return float(max(directions, key=room))


def _aside(theta: np.ndarray, r: np.ndarray) -> tuple[float, float]:
    """Points by which a satellite's name stands off its start, against the way it goes, or outwards where it stands still."""
    east, north = r * np.sin(theta), r * np.cos(theta)
    step = np.array([east[0] - east[min(len(east) - 1, 20)], north[0] - north[min(len(east) - 1, 20)]])
    if np.hypot(*step) < 0.05:
        step = np.array([east[0], north[0]])
    length = float(np.hypot(*step))
    return (10.0 * float(step[0]) / length, 10.0 * float(step[1]) / length) if length > 0 else (0.0, 9.0)
