"""Traces of one run: a table with a row per step, and a figure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import use_log_if_wide
from pfbench.report.plots.plotting import format_axis_label, stacked_axes
from pfbench.results import store
from pfbench.results.state_groups import main_component_group
from pfbench.results.status import divergence_threshold

_NOT_TRACES = (
    "time",
    "error",
    "sd",
    "nees",
    "track",
    "pcrb",
    "range",
    "score_steps",
    "log_evidence",
)
_SCORED = ("nis", "nis_dof")
_COLOUR, _GREY = "#0072B2", "0.45"


def tabulate_traces(result: store.JobResult) -> pd.DataFrame:
    """Build the table of all traces of a run, a row per step.

    Args:
        result: Result with one run, scored at all steps.

    Returns:
        Time [s], error and sd of each component in its SI unit, and NEES of each group. The traces of
        the filter such as ess, the NIS and the true track [m] follow.
    """
    data, state = result.data, result.meta["state"]
    columns: dict[str, Any] = {"time [s]": data["time"]}
    for kind in ("error", "sd"):
        for i, (name, unit) in enumerate(zip(state["names"], state["units"], strict=True)):
            columns[format_axis_label(f"{kind} {name}", unit)] = data[kind][0, :, i]
    for i, group in enumerate(state["groups"]):
        columns[f"NEES {group}"] = data["nees"][0, :, i]
    shape = (1, data["time"].size)
    for name, values in data.items():
        if name not in (*_NOT_TRACES, *_SCORED) and values.shape == shape:
            columns[name] = values[0]
    for name in _SCORED:
        if name in data and "score_steps" in data:
            columns[name] = np.full(shape[1], np.nan)
            columns[name][data["score_steps"]] = data[name][0]
    if "track" in data:
        for i, axis in enumerate(("East", "North", "Up")):
            columns[f"track {axis} [m]"] = data["track"][0, :, i]
    return pd.DataFrame(columns)


def plot_traces(result: store.JobResult) -> Figure:
    """Plot a run: error of the main group with its bounds, NIS, effective sample size, and the track.

    Args:
        result: Result with one run, scored at all steps.
    """
    data = result.data
    has_ess = "ess" in data and data["ess"].shape == (1, data["time"].size)
    panels = ["error", *(["NIS"] if "nis" in data else []), *(["ESS"] if has_ess else [])]
    heights = len(panels) + ("track" in data)
    figure, axes = stacked_axes(heights, 1.45, sharex=False)
    drawing = {"error": _plot_error, "NIS": _plot_nis, "ESS": _plot_ess}
    for panel, axis in zip(panels, axes, strict=False):
        drawing[panel](axis, result)
        axis.set_xlim(*data["time"][[0, -1]])
    axes[len(panels) - 1].set_xlabel("time [s]")
    if "track" in data:
        _plot_track(axes[-1], result)
    return figure


def _plot_error(axis: Axes, result: store.JobResult) -> None:
    """Plot the norm of the error of the main group, and the norm of its standard deviations."""
    group, time = main_component_group(result.meta["state"]), result.data["time"]
    error = _norm(result.data["error"][0][:, group.places]) * group.scale
    sd = _norm(result.data["sd"][0][:, group.places]) * group.scale
    axis.plot(time, error, color=_COLOUR, label="error")
    axis.plot(time, sd, color=_GREY, ls="--", label="standard deviation of the filter")
    limit = divergence_threshold(result.meta)
    values = np.concatenate([error, sd])
    if limit is not None and np.nanmax(values) > 0.3 * limit * group.scale:
        axis.axhline(limit * group.scale, color=_GREY, lw=0.7, label="divergence threshold")
    use_log_if_wide(axis, axis.yaxis, [error, sd])
    axis.set_ylabel(format_axis_label(group.group, group.unit))
    axis.legend(loc="upper right", fontsize=6.5)


def _plot_nis(axis: Axes, result: store.JobResult) -> None:
    """Plot the NIS per observed component, whose expectation is 1."""
    nis, dof = (np.asarray(result.data[name][0], np.float64) for name in _SCORED)
    time = result.data["time"][result.data["score_steps"]]
    mean = np.divide(nis, dof, out=np.full_like(nis, np.nan), where=dof > 0)
    axis.plot(time, mean, ".", ms=2, color=_COLOUR)
    axis.axhline(1.0, color=_GREY, lw=0.7)
    use_log_if_wide(axis, axis.yaxis, [mean])
    axis.set_ylabel("NIS / components")


def _plot_ess(axis: Axes, result: store.JobResult) -> None:
    """Plot the effective sample size as a share of the particles."""
    ess = np.asarray(result.data["ess"][0], np.float64)
    axis.plot(result.data["time"], ess, color=_COLOUR, lw=0.8)
    axis.set_ylim(0.0, None)
    axis.set_ylabel("ESS")


def _plot_track(axis: Axes, result: store.JobResult) -> None:
    """Plot the true track on the plane and the estimate, with errors magnified where they are small."""
    track = np.asarray(result.data["track"][0], np.float64)[:, :2] / 1e3
    axis.plot(*track.T, color=_GREY, lw=0.9, label="truth")
    names = list(result.meta["state"]["names"])
    horizontal = ["position_E", "position_N"]
    if all(name in names for name in horizontal):
        error = result.data["error"][0][:, [names.index(name) for name in horizontal]] / 1e3
        factor = magnification(track, error)
        text = "estimate" if factor == 1 else f"estimate, errors magnified {factor} times"
        axis.plot(*(track + factor * error).T, color=_COLOUR, lw=0.8, label=text)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set(xlabel="East [km]", ylabel="North [km]")
    axis.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=6.5)


def magnification(track: np.ndarray, error: np.ndarray) -> int:
    """Return the power of ten that magnifies errors enough to be visible.

    Args:
        track: True track, [T, 2].
        error: Errors in the same unit, [T, 2].

    Returns:
        1, 10, 100, ...: the largest with which the median error is below a twentieth of the track.
    """
    extent = float(np.ptp(track, axis=0).max())
    size = float(np.nanmedian(_norm(error))) if np.isfinite(error).any() else 0.0
    if not 0.0 < size < 0.005 * extent:
        return 1
    return int(10 ** np.floor(np.log10(0.05 * extent / size)))


def _norm(values: np.ndarray) -> np.ndarray:
    """Return the norm of each row, [T]."""
    return np.sqrt(np.sum(np.asarray(values, np.float64) ** 2, axis=-1))
