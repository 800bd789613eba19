"""Figures that compare filters in a condition: RMSE of runs, consistency, traces and cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import use_log_if_wide
from pfbench.report.plots.curves import Results, point_marker, select_valid_runs, sum_nis, thin_mask
from pfbench.report.plots.label_placement import break_settings
from pfbench.report.plots.plotting import (
    SMALL,
    LineStyle,
    add_legend,
    compute_jitter,
    compute_run_quantiles,
    format_axis_label,
    stacked_axes,
)
from pfbench.results import consistency
from pfbench.results.metric_values import particles_in_use

MANY_FILTERS = 12  # filters of a box plot at most; more have a row each, ordered by median
TRACES = {  # quantity, unit, and whether the trace is a fraction of the particles
    "ess": ("effective sample size", "% of N", True),
    "ancestors": ("number of distinct ancestors after resampling", "% of N", True),
    "unique": ("number of unique particles after moves", "% of N", True),
    "particles": ("number of particles", "", False),
    "iterations": ("iterations until the swarm stopped", "", False),
    "accepted_0": ("MCMC acceptance fraction, at steps with moves", "", False),
}
_LABEL_WIDTH = 30  # letters of a y label in a panel of this height


def plot_rmse(runs: pd.DataFrame, groups: Sequence[str], style: Mapping[str, LineStyle]) -> Figure:
    """Plot the RMSE of the norm of each run, as boxes, or as rows for many filters.

    Args:
        runs: Rows of `load_frame` of a condition.
        groups: Names of the component groups.
        style: Line styles by label.
    """
    table = runs[(runs.metric == "rmse") & (runs.component == "norm")]
    labels = [label for label in style if (table.label == label).any()]
    is_large = len(labels) > MANY_FILTERS
    height = 0.55 + (0.125 if is_large else 0.3) * len(labels)
    figure, panels = stacked_axes(len(groups), height, sharex=False)
    for group, axis in zip(groups, panels, strict=True):
        group_runs = table[table.group == group]
        valid = group_runs[np.isfinite(group_runs.value)]
        median = group_runs.groupby("label").value.median()  # a lost run counts as infinite
        order = labels
        if is_large:
            order = sorted(labels, key=lambda label: (median.get(label, np.inf), label))
        draw: Callable[..., None] = _draw_rows if is_large else _draw_boxes
        draw(axis, valid, order, style)
        _write_lost_counts(axis, group_runs, order, SMALL if is_large else 7)
        # Repeated, because a filter without valid runs keeps its row without a box.
        names = list(map(break_settings, order))
        axis.set_yticks(range(len(order)), names, fontsize=SMALL if is_large else None)
        axis.set_ylim(len(order) - 0.5, -0.5)
        unit = str(group_runs.unit.iloc[0]) if len(group_runs) else ""
        axis.set(title=group, xlabel=format_axis_label("RMSE per run", unit), ylabel="")
        use_log_if_wide(axis, axis.xaxis, [valid.value.to_numpy()])
    return figure


def _write_lost_counts(axis: Axes, runs: pd.DataFrame, order: Sequence[str], size: float) -> None:
    """Write the number of lost runs to the right of each row."""
    transform = axis.get_yaxis_transform()
    for row, label in enumerate(order):
        if lost := int(runs.lost[runs.label == label].sum()):
            text: Any = {"ha": "left", "va": "center", "fontsize": size}
            axis.text(1.01, row, f"{lost} lost", transform=transform, **text)


def _draw_boxes(
    axis: Axes, valid: pd.DataFrame, labels: Sequence[str], style: Mapping[str, LineStyle]
) -> None:
    """Draw a box per filter and a point per valid run."""
    colours = {label: style[label].colour for label in labels}
    sns.boxplot(
        valid, x="value", y="label", hue="label", order=labels, hue_order=labels, palette=colours,
        legend=False, orient="h", width=0.6, fliersize=0, linewidth=0.8, saturation=1,
        boxprops={"alpha": 0.45}, ax=axis,
    )  # fmt: skip
    for row, label in enumerate(labels):
        value = valid.value[valid.label == label].to_numpy()
        y = row + compute_jitter(value.size)
        axis.scatter(value, y, s=5, color="0.15", alpha=0.55, lw=0, zorder=3)


def _draw_rows(
    axis: Axes, valid: pd.DataFrame, labels: Sequence[str], style: Mapping[str, LineStyle]
) -> None:
    """Draw quartiles on a thin line from 5 to 95 %, with a dot at the median."""
    by_colour: dict[str, list[tuple[int, np.ndarray]]] = {}
    for row, label in enumerate(labels):
        value = valid.value[valid.label == label].to_numpy()
        if value.size:
            colour = "0.45" if style[label].quiet else style[label].colour
            levels = np.quantile(value, [0.05, 0.25, 0.5, 0.75, 0.95])
            by_colour.setdefault(colour, []).append((row, levels))
    for colour, rows in by_colour.items():  # a line with gaps per colour makes a smaller file
        y = np.array([[row, row, np.nan] for row, _ in rows]).ravel()
        for low, high, width in ((0, 4, 0.8), (1, 3, 3.0)):
            x = np.array([[q[low], q[high], np.nan] for _, q in rows]).ravel()
            order = 2 + 0.1 * (low == 1)
            axis.plot(x, y, color=colour, lw=width, solid_capstyle="butt", zorder=order)
    medians = [(q[2], row) for rows in by_colour.values() for row, q in rows]
    if medians:
        dot: Any = {"marker": "o", "ms": 3.2, "mfc": "white", "mec": "black", "mew": 0.7}
        axis.plot(*np.array(medians).T, ls="none", zorder=3, **dot)


def plot_nees(
    results: Results, groups: Sequence[str], style: Mapping[str, LineStyle], alpha: float = 0.05
) -> Figure:
    """Plot the run-averaged NEES with its chi-square interval, a panel per group.

    Args:
        results: Results by label.
        groups: Names of the groups of the state.
        style: Line styles by label.
        alpha: Probability outside the interval.
    """
    figure, panels = stacked_axes(len(groups), 1.4)
    for group, axis in zip(groups, panels, strict=True):
        lines, bands = [], []
        for label, result in results.items():
            components = result.meta["state"]["groups"]
            if group in components:
                dof = len(components[group])
                values = result.data["nees"][..., list(components).index(group)]
                nees = consistency.compute_consistency(values, result.data["lost"], dof, alpha)
                steps = thin_mask(nees.runs_at > 0, style[label].instants)
                time = result.data["time"][steps]
                look = style[label]._replace(width=0.8 * style[label].width)
                marker = point_marker(time)
                axis.plot(time, nees.average[steps], marker=marker, **look.line(label))
                lines.append(nees.average)
                bands.append((nees.runs, time, nees.low[steps], nees.high[steps], dof))
        _, time, low, high, dof = max(bands, key=lambda band: band[0])
        _draw_interval(axis, time, low, high)
        axis.set(title=f"{group}, {dof} degrees of freedom", ylabel="mean NEES")
        use_log_if_wide(axis, axis.yaxis, lines)
    panels[-1].set_xlabel("time [s]")
    add_legend(figure, panels[0])
    return figure


def plot_nis(results: Results, style: Mapping[str, LineStyle], alpha: float = 0.05) -> Figure:
    """Plot the NIS per component, summed over runs, with its chi-square interval.

    Args:
        results: Results by label.
        style: Line styles by label.
        alpha: Probability outside the interval.
    """
    figure, (axis,) = stacked_axes(1, 1.6)
    lines, bands = [], []
    for label, result in results.items():
        innovations = sum_nis(result)
        if innovations is not None:
            time, squared, dof = innovations
            look = style[label]
            mark = {} if look.quiet else look.mark()
            axis.plot(time, squared / dof, ms=2.5, **mark, **look.line(label))
            lines.append(squared / dof)
            bands.append((float(dof.sum()), time, *consistency.nees_band(1, dof, alpha)))
    _, time, low, high = max(bands, key=lambda band: band[0])
    _draw_interval(axis, time, low, high)
    axis.set(xlabel="time [s]", ylabel="NIS per component")
    use_log_if_wide(axis, axis.yaxis, lines)
    add_legend(figure, axis)
    return figure


def _draw_interval(axis: Axes, time: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Draw a grey band with dark edges."""
    axis.fill_between(time, low, high, color="0.8", lw=0, zorder=0)
    for edge in (low, high):
        axis.plot(time, edge, color="0.35", lw=0.7, zorder=4)


def plot_trace(results: Results, name: str, style: Mapping[str, LineStyle]) -> Figure:
    """Plot a trace over time, median and 5 to 95 % of the runs.

    Args:
        results: Results by label.
        name: Key of `TRACES`.
        style: Line styles by label.
    """
    quantity, unit, is_fraction = TRACES[name]
    unit = unit.replace(" ", "\N{NO-BREAK SPACE}")
    figure, (axis,) = stacked_axes(1, 2.2)
    for label, result in results.items():
        look = style[label]
        if name in result.data and (result.meta.get("particles") or not is_fraction):
            scaled = result
            if is_fraction:
                percent = 100 * result.data[name] / particles_in_use(result)
                scaled = result._replace(data={**result.data, name: percent})
            time, (values,) = select_valid_runs(scaled, None, name, most=look.instants)
            low, middle, high = compute_run_quantiles(values, [0.05, 0.5, 0.95])
            if not look.quiet:
                axis.fill_between(time, low, high, color=look.colour, alpha=0.18, lw=0)
            axis.plot(time, middle, marker=point_marker(time), **look.line(label))
    ylabel = fill(format_axis_label(quantity.partition(",")[0], unit), _LABEL_WIDTH)
    axis.set(xlabel="time [s]", ylabel=ylabel)
    axis.set_ylim(bottom=0)
    add_legend(figure, axis)
    return figure
