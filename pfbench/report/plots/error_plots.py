"""Figures of the error over time and of the track, in physical units, readable in grey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import limit_to_late_values, use_log_if_wide
from pfbench.report.plots.curves import (
    Results,
    component_pcrb,
    east_north_up,
    point_marker,
    select_valid_runs,
)
from pfbench.report.plots.plotting import (
    COLUMN,
    LineStyle,
    add_legend,
    compute_run_quantiles,
    format_axis_label,
    stacked_axes,
)
from pfbench.results import store
from pfbench.results.state_groups import ComponentGroup, component_groups

_PCRB_STYLE: Any = {"color": "black", "ls": (0, (3, 1.2)), "lw": 0.8, "zorder": 4}
_NARROW = 120  # points of a curve in a panel of half a column
_NORMAL_MEDIAN = 0.6745  # median of the absolute value of a standard normal variable


class _SpreadRow(NamedTuple):
    """Up to three components of a group in one row of panels."""

    block: ComponentGroup
    components: range


def plot_track(results: Results, row: int, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the plan view and the height over time of one run.

    Args:
        results: Results by label.
        row: Row of the run in the arrays.
        style: Line styles by label.
    """
    figure = Figure(figsize=(COLUMN, 4.8), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1))
    first = next(result for result in results.values() if "track" in result.data)
    time, truth = first.data["time"], first.data["track"][row].astype(np.float64)
    line: Any = {"color": "0.75", "lw": 4, "solid_capstyle": "round"}
    plan.plot(truth[:, 0], truth[:, 1], label="truth", **line)
    height.plot(time, truth[:, 2], **line)
    start: Any = {"marker": "o", "mfc": "white", "color": "0.3", "ls": "none", "zorder": 5}
    plan.plot(*truth[0, :2], label="start", **start)
    for label, result in results.items():
        axes = east_north_up(result.meta["state"])
        if axes is None or "track" not in result.data:
            continue
        error = result.data["error"][row][:, axes[0]].astype(np.float64) * axes[1]
        estimate = result.data["track"][row] + error
        finite_mask = ~np.isnan(estimate).any(-1)  # gaps would hide a line of few steps
        estimate = estimate[finite_mask]
        plan.plot(estimate[:, 0], estimate[:, 1], **style[label].line(label))
        height.plot(result.data["time"][finite_mask], estimate[:, 2], **style[label].line())
    plan.set(xlabel="east [m]", ylabel="north [m]")
    plan.set_aspect("equal", adjustable="datalim")
    plan.locator_params(axis="x", nbins=4)
    height.set(xlabel="time [s]", ylabel="height [m]")
    add_legend(figure, plan)
    return figure


def plot_error(results: Results, block: ComponentGroup, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the median absolute error over time, a panel per component.

    Args:
        results: Results by label.
        block: Component group.
        style: Line styles by label.
    """
    figure, panels = stacked_axes(len(block.components), 1.3)
    for label, result in results.items():
        names = result.meta["state"]["names"]
        for name, axis in zip(block.components, panels, strict=True):
            if name in names:
                most = style[label].instants
                time, (values,) = select_valid_runs(result, names.index(name), "error", most=most)
                middle = compute_run_quantiles(np.abs(values) * block.scale, [0.5])[0]
                axis.plot(time, middle, marker=point_marker(time), **style[label].line(label))
    for name, axis in zip(block.components, panels, strict=True):
        for time, sd in component_pcrb(results, name):
            median = _NORMAL_MEDIAN * sd * block.scale
            axis.plot(time, median, label="PCRB", marker=point_marker(time), **_PCRB_STYLE)
        axis.set(title=name, ylabel=format_axis_label("|error|", block.unit))
        use_log_if_wide(axis, axis.yaxis, [np.asarray(line.get_ydata()) for line in axis.lines])
    panels[-1].set_xlabel("time [s]")
    add_legend(figure, panels[0])
    return figure


def plot_spread(result: store.JobResult, groups: Sequence[str], look: LineStyle) -> Figure:
    """Plot the error of one filter with its three-sigma limits, a panel per component.

    Args:
        result: Result of the filter.
        groups: Names of the component groups.
        look: Line style.
    """
    rows = [
        _SpreadRow(block, range(start, min(start + 3, len(block.places))))
        for block in component_groups(result.meta["state"])
        if block.group in groups
        for start in range(0, len(block.places), 3)
    ]
    columns = max(len(row.components) for row in rows)
    size = (max(COLUMN, 2.4 * columns), 0.2 + 1.45 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(rows), columns, squeeze=False, sharex=True)
    for line, row in zip(panels, rows, strict=True):
        for axis, k in zip(line, row.components, strict=False):
            _spread_panel(axis, result, row.block, k, look)
        line[0].set_ylabel(format_axis_label("error", row.block.unit))
        for axis in line[len(row.components) :]:
            axis.set_visible(False)
    for axis in panels[-1]:
        axis.set_xlabel("time [s]")
    add_legend(figure, panels[0][0], columns=3)
    return figure


def _spread_panel(
    axis: Axes, result: store.JobResult, block: ComponentGroup, k: int, look: LineStyle
) -> None:
    """Plot the error band of component k, the filter's limits and the PCRB."""
    time, (errors, sds) = select_valid_runs(result, block.places[k], "error", "sd", most=_NARROW)
    low, middle, high = compute_run_quantiles(errors * block.scale, [0.05, 0.5, 0.95])
    limit = 3 * compute_run_quantiles(sds * block.scale, [0.5])[0]
    line: Any = {"color": look.colour, "lw": 1, "marker": point_marker(time)}
    axis.fill_between(
        time, low, high, color=look.colour, alpha=0.3, lw=0, label="5 to 95 % of runs"
    )
    axis.plot(time, middle, label="median error", **line)
    axis.plot(time, limit, ls="--", label="3 sigma of the filter", **line)
    axis.plot(time, -limit, ls="--", **line)
    for times, sd in component_pcrb({"": result}, block.components[k]):
        axis.plot(times, 3 * sd * block.scale, label="3 sigma of the PCRB", **_PCRB_STYLE)
        axis.plot(times, -3 * sd * block.scale, label="", **_PCRB_STYLE)
    axis.set_title(block.components[k])
    limit_to_late_values(axis, [low, high, limit, -limit])
