"""Figures of datasheets and trainings, and the data that they draw."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pfbench.files.atomic_write import write_atomically
from pfbench.results import status, store
from pfbench.results.conditions import component_groups, main_component_group
from pfbench.results.frame import select_indices
from pfbench.results.plotting import (
    COLUMN,
    PLAIN_COLOURS,
    FigureSpec,
    add_legend,
    draw_figure,
    format_axis_label,
    line_styles,
    stacked_axes,
    use_log_if_wide,
)
from pfbench.results.status import divergence_threshold

_BOUND: Any = {"color": "black", "ls": (0, (4, 1.5)), "lw": 0.9}
_AXES = ("right", "forward", "up")
_LIMIT = 5.0  # standard deviations, limit of a histogram


def plot_scenario_track(sheet: store.JobResult) -> Figure:
    """Plot the plan view and the height over time."""
    figure = Figure(figsize=(COLUMN, 4.8), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1))
    paths, time = select_tracks(sheet.data["track"]), sheet.data["time"]
    reach = np.nanmax(np.abs(paths[..., :2]))
    unit, scale = ("km", 1e-3) if reach > 5e3 else ("m", 1.0)
    thin = select_indices(time.size)
    for path in paths[1:21, thin]:
        plan.plot(path[:, 0] * scale, path[:, 1] * scale, color="0.75", lw=0.7)
        height.plot(time[thin], path[:, 2], color="0.75", lw=0.7)
    first = paths[0][~np.isnan(paths[0]).any(-1)]
    plan.plot(first[:, 0] * scale, first[:, 1] * scale, color="#0072B2", lw=1.3, label="first run")
    height.plot(time[thin], paths[0, thin, 2], color="#0072B2", lw=1.3)
    shape: Any = {"ms": 5, "ls": "none", "zorder": 5, "color": "#0072B2"}
    plan.plot(*(first[0, :2] * scale), marker="o", mfc="white", label="start", **shape)
    plan.plot(*(first[-1, :2] * scale), marker="s", mfc="#0072B2", label="end", **shape)
    plan.set(xlabel=f"east [{unit}]", ylabel=f"north [{unit}]")
    plan.set_aspect("equal", adjustable="datalim")
    plan.locator_params(axis="x", nbins=5)
    height.set(xlabel="time [s]", ylabel="height [m]")
    add_legend(figure, plan, columns=3)
    return figure


def plot_distance(sheet: store.JobResult) -> Figure:
    """Plot the horizontal range over time."""
    figure, (axis,) = stacked_axes(1, 1.6)
    axis.plot(sheet.data["time"], sheet.data["range"] / 1e3, color="#0072B2")
    axis.set(xlabel="time [s]", ylabel="horizontal range [km]")
    return figure


def plot_sensors(sheet: store.JobResult) -> Figure:
    """Plot specific force and angular rate over time, a line per body axis."""
    data = sheet.data
    rows = {"specific force [m/s²]": data["force"], "rate [deg/s]": data["rate"] * np.degrees(1)}

    def draw(axis: Axes, ylabel: str, values: np.ndarray) -> None:
        for (name, line), value in zip(line_styles(_AXES).items(), values.T, strict=True):
            axis.plot(data["time"], value, color=line.colour, ls=line.dash, lw=1.1, label=name)
        axis.set_ylabel(ylabel)

    return _stack(draw, rows.items(), 1.7, legend=3)


def _stack(
    draw: Callable[..., None],
    rows: Collection[tuple[Any, ...]],
    height: float,
    xlabel: str = "time [s]",
    legend: int = 0,
) -> Figure:
    """Draw a panel for each row, one below the other, with a legend of some columns."""
    figure, panels = stacked_axes(len(rows), height)
    for axis, row in zip(panels, rows, strict=True):
        draw(axis, *row)
    panels[-1].set_xlabel(xlabel)
    if legend:
        add_legend(figure, panels[0], legend)
    return figure


def plot_sky(sheet: store.JobResult) -> Figure:
    """Plot the satellites in the sky, north up, east to the right."""
    figure = Figure(figsize=(COLUMN, 3.6), layout="constrained")
    axis: Any = figure.add_subplot(projection="polar")
    axis.set_theta_zero_location("N")
    axis.set_theta_direction(-1)
    axis.set_rlim(0, 90)
    axis.set_thetagrids(range(0, 360, 45), labels=["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    azimuth = sheet.data["azimuth"].astype(float)
    zenith = 90 - np.degrees(sheet.data["elevation"].astype(float))
    axis.set_rgrids([30, 60], labels=["60°", "30°"], angle=22.5, color="0.4", fontsize=6.5)
    for k, (name, style) in enumerate(line_styles(list_satellites(sheet)).items()):
        steps = np.flatnonzero(~np.isnan(azimuth[:, k]) & ~np.isnan(zenith[:, k]))
        if steps.size:
            _plot_satellite(axis, azimuth[steps, k], zenith[steps, k], name, style.colour)
    return figure


def _plot_satellite(axis: Any, theta: np.ndarray, r: np.ndarray, name: str, colour: str) -> None:
    """Plot the path of a satellite, with an arrow if it moves and its name."""
    axis.plot(theta, r, color=colour, lw=1.6, solid_capstyle="round")
    before = max(0, len(r) - 1 - max(1, len(r) // 10))
    turn, climb = r[-1] * (theta[-1] - theta[before]), r[-1] - r[before]
    if before < len(r) - 1 and np.hypot(turn, climb) > 0.05:
        arrow: Any = {"arrowstyle": "-|>", "color": colour, "lw": 0.8, "mutation_scale": 9}
        arrow |= {"shrinkA": 0, "shrinkB": 0}
        axis.annotate("", (theta[-1], r[-1]), (theta[before], r[before]), arrowprops=arrow)
    font: Any = {"fontsize": 7, "color": colour, "ha": "center", "va": "center"}
    axis.annotate(name, (theta[0], r[0]), (0, 8), textcoords="offset points", **font)


def plot_measurements(sheet: store.JobResult) -> Figure:
    """Plot the number of satellites and of observed components over time."""
    time = sheet.data["time"]
    rows = [("components", sheet.data["seen"].astype(float).sum(1), "#D55E00")]
    if "azimuth" in sheet.data:
        rows.insert(0, ("satellites", visible_satellites(sheet), "#0072B2"))

    def draw(axis: Axes, name: str, count: np.ndarray, colour: str) -> None:
        if has_sparse_counts(count):
            axis.plot(
                time[count > 0], count[count > 0], color=colour, ls="none", marker=".", ms=2.5
            )
        else:
            axis.plot(time, count, color=colour, ls="-", lw=1.1, drawstyle="steps-mid")
        axis.set(ylabel=name)
        axis.set_ylim(bottom=0)

    return _stack(draw, rows, 1.3)


def plot_residuals(sheet: store.JobResult) -> Figure:
    """Plot residual histograms with the standard normal density, a panel per measurement kind."""
    x = np.linspace(-_LIMIT, _LIMIT, 201)
    density = np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi)
    bars: Any = {"density": True, "color": "#56B4E9", "alpha": 0.75, "label": "residuals"}

    def draw(axis: Axes, kind: str, z: np.ndarray) -> None:
        moments = status.compute_whiteness(z)
        values = np.clip(z[~np.isnan(z)], -_LIMIT, _LIMIT)
        bins = int(np.clip(2 * np.sqrt(values.size), 11, 61))
        axis.hist(values, bins=bins, range=(-_LIMIT, _LIMIT), **bars)
        axis.plot(x, density, color="black", lw=1, label="standard normal")
        title = f"{kind}: variance {moments.variance:.3g} (1 ± {moments.variance_band:.2g}), "
        axis.set_title(f"{title}lag-1 {moments.lag:+.2g} (± {moments.lag_band:.2g})", fontsize=7)
        axis.set_ylabel("density")

    return _stack(draw, group_residuals(sheet).items(), 1.5, "residual [sd]", legend=2)


def plot_residuals_over_time(sheet: store.JobResult) -> Figure:
    """Plot the residuals of the first run over time."""
    dots: Any = {"ls": "none", "marker": ".", "ms": 3, "alpha": 0.8, "mew": 0}

    def draw(axis: Axes, kind: str, z: np.ndarray) -> None:
        steps, parts = np.nonzero(~np.isnan(z[0]))
        axis.plot(sheet.data["time"][steps], z[0, steps, parts], color="#0072B2", **dots)
        for edge in (-2, 2):
            axis.axhline(edge, color="black", lw=0.7, ls=(0, (4, 2)))
        axis.set(title=kind, ylabel="residual [sd]")

    return _stack(draw, group_residuals(sheet).items(), 1.3)


def plot_error_spread(sheet: store.JobResult) -> Figure:
    """Plot the standard deviation over runs of each group, and the PCRB."""

    def draw(axis: Axes, block: Any, time: np.ndarray, value: np.ndarray, bound: Any) -> None:
        thin = select_indices(time.size)
        mark = "." if time.size == 1 else ""
        axis.plot(time[thin], value[thin], color="#0072B2", label="spread of the runs", marker=mark)
        if bound is not None:
            axis.plot(time[thin], bound[thin], label="PCRB", marker=mark, **_BOUND)
        axis.set(title=block.group, ylabel=format_axis_label("spread", block.unit))
        use_log_if_wide(axis, axis.yaxis, [np.asarray(line.get_ydata()) for line in axis.lines])

    return _stack(draw, compute_spreads(sheet), 1.15, legend=2)


# --------------------------------------------------------------------------------------------------
# Data of a datasheet file in the form of its figures and tables.


def list_satellites(sheet: store.JobResult) -> list[str]:
    """Return the names of the satellites, from the scenario, its receiver, or as numbers."""
    if "satellites" in sheet.data:
        return [
            "".join(chr(int(letter)) for letter in row).strip() for row in sheet.data["satellites"]
        ]
    return [str(name) for name in sheet.meta["satellites"]]


def visible_satellites(sheet: store.JobResult) -> np.ndarray:
    """Count the visible satellites at each step [T]."""
    count: np.ndarray = (~np.isnan(sheet.data["elevation"])).sum(1)
    return count


def has_sparse_counts(count: np.ndarray) -> bool:
    """Return whether some counts [T] are zero and others positive, where a line shows only jumps."""
    return bool((count == 0).any() and (count > 0).any())


_ROUNDING = 1e-12  # SI units: difference of quaternions between equal runs


def compute_spreads(
    sheet: store.JobResult,
) -> list[tuple[Any, np.ndarray, np.ndarray, np.ndarray | None]]:
    """List the groups with a spread over runs: group, times with truth, spread and PCRB.

    Spread and PCRB are in the displayed unit.
    """
    rows = []
    for block in component_groups(sheet.meta["state"]):
        value = compute_deviation(sheet.data, block.places) * block.scale
        finite_mask = ~np.isnan(value)
        if finite_mask.any() and (value[finite_mask] > _ROUNDING * block.scale).any():
            bound = None
            if "pcrb" in sheet.data:
                variance = sheet.data["pcrb"][finite_mask][:, block.places].astype(np.float64) ** 2
                bound = np.sqrt(variance.sum(-1)) * block.scale
            rows.append((block, sheet.data["time"][finite_mask], value[finite_mask], bound))
    return rows


def compute_deviation(data: dict[str, np.ndarray], indices: list[int]) -> np.ndarray:
    """Compute the standard deviation over runs of the norm of components.

    Returns standard deviation, [T]. NaN where fewer than two runs have a truth.
    """
    square = (data["error"][..., indices].astype(np.float64) ** 2).sum(-1)
    count = (~np.isnan(square)).sum(0)
    return np.sqrt(np.where(count > 1, np.nansum(square, 0) / np.maximum(count - 1, 1), np.nan))


def group_residuals(sheet: store.JobResult) -> dict[str, np.ndarray]:
    """Group the residuals [R or 1, T, k] by kind of measurement, without missing components."""
    z = drop_equal_runs(sheet.data["residual"].astype(np.float64))
    kinds, is_finite = np.array(sheet.meta["kinds"]), ~np.isnan(z).all((0, 1))
    return {
        str(kind): z[..., mask]
        for kind in dict.fromkeys(sheet.meta["kinds"])
        if (mask := (kinds == kind) & is_finite).any()
    }


def drop_equal_runs(z: np.ndarray) -> np.ndarray:
    """Return a single run if all runs have equal residuals, else all runs."""
    return z[:1] if np.allclose(z, z[:1], rtol=0, atol=1e-4, equal_nan=True) else z


def select_tracks(track: np.ndarray) -> np.ndarray:
    """Return a single track [1, T, 3] if all runs have equal tracks, else all tracks."""
    is_common = np.array_equal(track, np.broadcast_to(track[:1], track.shape), equal_nan=True)
    return track[:1] if is_common else track


def describe_raw_estimate(meta: Mapping[str, Any]) -> str:
    """Describe the error of the simplest estimate from raw measurements, and the threshold.

    Returns sentences with the error, five times the error, and the divergence threshold in use.
    """
    raw, group = meta["raw_estimate"], main_component_group(meta["state"])
    method = {0: "dead reckoning", 1: "least squares of one step"}.get(
        raw["steps"], f"least squares of {raw['steps']} steps"
    )

    def show(value: float | None) -> str:
        return "none" if value is None else f"{value * group.scale:.3g} {group.unit}".rstrip()

    return (
        f"Estimate from raw measurements alone ({method}): {group.group} RMSE {show(raw['rmse'])}; "
        f"dead reckoning: {show(raw['dead_reckoning'])}. Computed divergence threshold: "
        f"{show(raw['threshold'])}. Threshold of the scenario: {show(divergence_threshold(meta))}."
    )


# --------------------------------------------------------------------------------------------------
# Figure of a training: loss on the training and the validation runs, and effective sample size, by epoch.

Losses = Mapping[str, Sequence[float]]


def write_training_figure(path: Path, losses: Losses) -> Path:
    """Write the figure of a training as SVG. Equal losses give equal bytes.

    Returns the path.
    """
    content = draw_figure(FigureSpec(path.stem, "", lambda: plot_training(losses)), ("svg",))["svg"]
    write_atomically(path, lambda file: file.write(content))
    return path


def plot_training(losses: Losses) -> Figure:
    """Plot the losses and the effective sample size over the epochs, without the latter if it is NaN."""
    has_particles = np.isfinite(losses["ess"]).any()
    figure, (top, *others) = stacked_axes(2 if has_particles else 1, 1.5)
    epoch, validation = np.asarray(losses["epoch"]), np.asarray(losses["validation"])
    top.plot(epoch, losses["loss"], color=PLAIN_COLOURS[5], lw=1.0, label="training runs")
    top.plot(epoch, validation, color=PLAIN_COLOURS[0], lw=1.3, label="validation runs")
    if np.isfinite(validation).any():
        best = np.where(np.isfinite(validation), validation, np.inf).argmin()
        top.plot(
            epoch[best], validation[best], "o", ls="none", ms=5, mfc="white", mec=PLAIN_COLOURS[0],
            label="kept weights",
        )  # fmt: skip
    top.set_ylabel("loss")
    for bottom in others:
        bottom.plot(epoch, losses["ess"], color=PLAIN_COLOURS[0], lw=1.3)
        bottom.set(ylabel="ESS / N", ylim=(0, 1))
    last = figure.axes[-1]
    last.set_xlabel("epoch")
    last.xaxis.set_major_locator(MaxNLocator(integer=True))
    add_legend(figure, top, columns=3)
    return figure
