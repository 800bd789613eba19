"""Figures of the cost of filters, and of accuracy and time with the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.cost import ParetoFront
from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.curves import Results
from pfbench.report.plots.label_placement import break_settings, place_labels
from pfbench.report.plots.plotting import (
    COLUMN,
    SMALL,
    LineStyle,
    add_legend,
    format_axis_label,
    stacked_axes,
)

_TITLE = 52  # letters of a title line


def plot_pareto_fronts(fronts: Sequence[ParetoFront], style: Mapping[str, LineStyle]) -> Figure:
    """Plot median RMSE and time per step, a panel per group, with the Pareto front.

    Filters on the front and coloured filters have labels. Others are small and grey.

    Args:
        fronts: Accuracy and time by group.
        style: Line styles by label.
    """
    label_count = max(
        sum(
            on_front or not style[label].quiet
            for label, on_front in zip(f.filters, f.on_front, strict=True)
        )
        for f in fronts
    )
    figure, panels = stacked_axes(len(fronts), 1.5 + 0.06 * label_count)
    for front, axis in zip(fronts, panels, strict=True):
        _plot_front(axis, front, style)
    panels[-1].set_xlabel("time per step [ms]")
    if any(style[label].quiet for front in fronts for label in front.filters):
        panels[0].scatter([], [], s=9, color="0.78", marker="o", lw=0, label="other filters")
    add_legend(figure, panels[0])
    engine = figure.get_layout_engine()
    if engine is not None:  # labels need the final layout
        engine.execute(figure)
    for front, axis in zip(fronts, panels, strict=True):
        _label_points(axis, front, style)
    return figure


def _plot_front(axis: Axes, front: ParetoFront, style: Mapping[str, LineStyle]) -> None:
    """Plot the filters of a group and their Pareto front."""
    milliseconds = [1e3 * s for s in front.seconds]
    best = [i for i, on_front in enumerate(front.on_front) if on_front]
    corner: Any = {"drawstyle": "steps-post", "color": "0.55", "lw": 0.9, "zorder": 1}
    axis.plot([milliseconds[i] for i in best], [front.rmse[i] for i in best], **corner)
    for i, label in enumerate(front.filters):
        if np.isfinite(front.rmse[i]):
            _plot_filter(axis, (milliseconds[i], front.rmse[i]), style[label], front.on_front[i])
    finite = [e for e in front.rmse if np.isfinite(e)]
    axis.margins(0.15)
    if any(e > 0 for e in finite):
        axis.set(xscale="log", yscale="log")
        set_plain_ticks(axis.yaxis, finite)
        set_plain_ticks(axis.xaxis, milliseconds)
    lost = [label for label, e in zip(front.filters, front.rmse, strict=True) if np.isinf(e)]
    note = f" (not shown, half of the runs lost: {', '.join(lost)})" if lost else ""
    title = fill(front.group + note, _TITLE)
    axis.set(title=title, ylabel=format_axis_label("RMSE", front.unit))


def _plot_filter(axis: Axes, point: tuple[float, float], look: LineStyle, on_front: bool) -> None:
    """Plot the mark of a filter, with a ring if it is on the front."""
    if look.quiet:
        colour = "0.45" if on_front else look.colour
        mark: Any = {"s": 9, "color": colour, "marker": "o", "zorder": 2.5, "lw": 0}
    else:  # white edges separate overlapping filled marks
        face, edge = (look.colour, "white") if look.filled else ("white", look.colour)
        mark = {"s": 26, "facecolors": face, "edgecolors": edge, "marker": look.marker}
        mark |= {"zorder": 3, "lw": 0.4 if look.filled else 1.0}
    axis.scatter(*point, **mark)
    if on_front:
        axis.scatter(*point, s=80, facecolors="none", edgecolors="0.2", lw=0.9, zorder=2)


def _label_points(axis: Axes, front: ParetoFront, style: Mapping[str, LineStyle]) -> None:
    """Label the points on the front and of coloured filters."""
    finite = [i for i, error in enumerate(front.rmse) if np.isfinite(error)]
    points = np.array([(1e3 * front.seconds[i], front.rmse[i]) for i in finite])
    names = {
        k: front.filters[i]
        for k, i in enumerate(finite)
        if front.on_front[i] or not style[front.filters[i]].quiet
    }
    reach = np.array(
        [6.0 if front.on_front[i] else 4.0 if k in names else 2.0 for k, i in enumerate(finite)]
    )
    best = points[[k for k, i in enumerate(finite) if front.on_front[i]]]
    best = best[np.lexsort((-best[:, 1], best[:, 0]))]
    corners = np.repeat(best, 2, axis=0)[1:]
    corners[1::2, 1] = best[:-1, 1]  # steps: constant error until the next time
    place_labels(
        axis, points, {k: break_settings(name) for k, name in names.items()}, reach, corners
    )


def plot_cost(results: Results, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the time per step and the memory of each filter, a row per filter.

    Args:
        results: Results by label.
        style: Line styles by label.
    """
    labels = list(results)
    names = list(map(break_settings, labels))
    times = [1e3 * results[label].meta["seconds"]["per_step"] for label in labels]
    memory = [(results[label].meta.get("memory") or np.nan) / 2**20 for label in labels]
    panels_data = {"time per step [ms]": np.array(times), "memory [MiB]": np.array(memory)}
    panels_data = {name: v for name, v in panels_data.items() if not np.isnan(v).all()}
    height = 0.6 + 0.16 * sum(1 + name.count("\n") for name in names)
    figure = Figure(figsize=(COLUMN, height), layout="constrained")
    panels = figure.subplots(1, len(panels_data), squeeze=False, sharey=True)[0]
    for axis, (name, values) in zip(panels, panels_data.items(), strict=True):
        for row, (label, value) in enumerate(zip(labels, values, strict=True)):
            axis.plot([0, value], [row, row], color="0.8", lw=0.8, zorder=1)
            axis.plot(value, row, ls="none", ms=4, **style[label].mark())
        positive = values[values > 0]
        axis.set_xlim(0, 1.1 * positive.max(initial=1e-9))
        axis.set(xlabel=name, yticks=range(len(labels)), yticklabels=names)
        axis.tick_params(axis="y", labelsize=SMALL)
        if positive.size and positive.max() > 10 * positive.min():
            axis.set_xscale("log")
            axis.set_xlim(positive.min() / 1.5, 1.5 * positive.max())
            set_plain_ticks(axis.xaxis, positive, narrow=True)
        axis.grid(False, axis="y")
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    return figure
