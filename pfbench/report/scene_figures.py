"""Figures of a datasheet: path, sensors, sky, residuals at the truth, spread of the runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pfbench import metrics, store
from pfbench.report import scene
from pfbench.report.canvas import COLUMN, labelled, legend, log_if_wide, looks, stack, thinned

_BOUND: Any = {"color": "black", "ls": (0, (4, 1.5)), "lw": 0.9}
_AXES = ("right", "forward", "up")
_SHOWN = 5.0  # standard deviations to which a histogram reaches


def track(sheet: store.Result) -> Figure:
    """Plan view and height over time."""
    figure = Figure(figsize=(COLUMN, 4.8), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1))
    paths, time = scene.tracks(sheet.arrays["track"]), sheet.arrays["time"]
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
    paths = [(name, azimuth[:, s], zenith[:, s]) for s, name in enumerate(scene.satellites(sheet))]
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
    counts = {"components": (a["seen"].astype(float).sum(1), "#D55E00")}
    if "azimuth" in a:
        counts = {"satellites": (scene.visible(sheet), "#0072B2"), **counts}
    figure, panels = stack(len(counts), 1.3)
    for axis, (name, (count, colour)) in zip(panels, counts.items(), strict=True):
        rare = scene.between_epochs(count)
        shown = count > 0 if rare else np.ones_like(count, dtype=bool)
        line: Any = {"ls": "none", "marker": ".", "ms": 2.5} if rare else {"ls": "-", "lw": 1.1, "drawstyle": "steps-mid"}
        axis.plot(a["time"][shown], count[shown], color=colour, **line)
        axis.set(ylabel=name)
        axis.set_ylim(bottom=0)
    panels[-1].set_xlabel("time in s")
    return figure


def residuals(sheet: store.Result) -> Figure:
    """Histogram of each kind of measurement beside the normal law."""
    found = scene.by_kind(sheet)
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
    found = scene.by_kind(sheet)
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
    found = scene.spreads(sheet)
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
