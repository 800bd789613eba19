"""Plots of the paper figures by experiment or component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import use_log_if_wide
from pfbench.report.plots.paper.time_plots import (
    BAND_QUANTILES,
    ResultsWithGroup,
    relative_error_percent,
)
from pfbench.report.plots.plotting import LineStyle, add_legend, format_axis_label, stacked_axes
from pfbench.results import error_measures, store
from pfbench.results.state_groups import ComponentGroup


def plot_against(
    values: Mapping[str, Mapping[str, np.ndarray]], style: Mapping[str, LineStyle], ylabel: str
) -> Figure:
    """Plot the median and the band over runs by experiment.

    Args:
        values: Values of the runs [n] by experiment and label.
        style: Line styles by label.
        ylabel: Label of the y axis.
    """
    labels = list(dict.fromkeys(label for runs in values.values() for label in runs))
    figure, (axis,) = stacked_axes(1, 2.1)
    for i, label in enumerate(labels):
        offset = 0.7 * ((i + 0.5) / len(labels) - 0.5)
        points = [
            (x + offset, runs[label]) for x, runs in enumerate(values.values()) if label in runs
        ]
        _draw_points(axis, points, style[label], label)
    axis.set_xticks(range(len(values)), list(values))
    axis.set(ylabel=ylabel, xlim=(-0.6, len(values) - 0.4))
    axis.grid(False, axis="x")
    use_log_if_wide(axis, axis.yaxis, [v for runs in values.values() for v in runs.values()])
    if axis.get_yscale() == "linear":
        axis.set_ylim(bottom=0)
    add_legend(figure, axis)
    return figure


def plot_maxima(
    results: ResultsWithGroup,
    style: Mapping[str, LineStyle],
    start: float,
    printed: Mapping[str, Sequence[float]],
) -> Figure:
    """Plot maximum error and RMSE by component, with crosses at values of the paper.

    Args:
        results: Result and component group by label.
        style: Line styles by label.
        start: Start time of the measures, s.
        printed: Maximum errors of the paper by label.
    """
    components = dict.fromkeys(name for _, block in results.values() for name in block.components)
    # In the order of the printed values.
    names = sorted(components, key=lambda name: "NEU".find(name[-1]))
    figure, (axis,) = stacked_axes(1, 2.3)
    values: list[np.ndarray] = []
    for i, (label, (result, block)) in enumerate(results.items()):
        offset = 0.75 * ((i + 0.5) / len(results) - 0.5)
        measures = [_error_measures(result, block, name, start) for name in names]
        peaks = [(x + offset - 0.05, peak) for x, (peak, _) in enumerate(measures)]
        sizes = [(x + offset + 0.05, rmse) for x, (_, rmse) in enumerate(measures)]
        _draw_points(axis, peaks, style[label], label)
        _draw_points(axis, sizes, style[label], "", open_=True)
        values += [value for _, value in (*peaks, *sizes)]
        if label in printed:
            cross: Any = {"ls": "none", "marker": "x", "ms": 6, "mew": 1.3, "zorder": 5}
            axis.plot([x for x, _ in peaks], printed[label][: len(names)], color="black", **cross)
            values.append(np.asarray(printed[label]))
    axis.set_xticks(range(len(names)), names)
    unit = next(block.unit for _, block in results.values())
    axis.set(ylabel=format_axis_label("error", unit), xlim=(-0.6, len(names) - 0.4))
    axis.grid(False, axis="x")
    use_log_if_wide(axis, axis.yaxis, values)
    add_legend(figure, axis)
    return figure


def _error_measures(
    result: store.JobResult, block: ComponentGroup, component: str, start: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum error and the RMSE of a component for each valid run, [n]."""
    index = block.places[block.components.index(component)]
    late = result.data["time"] >= start
    error = result.data["error"][~result.data["lost"]][:, late][..., [index]]
    no_run_lost = np.zeros(len(error), dtype=bool)
    peak = error_measures.max_error(error, no_run_lost)
    return block.scale * peak, block.scale * error_measures.rmse_per_run(error, no_run_lost)


def mean_relative_error(result: store.JobResult) -> np.ndarray:
    """Compute the mean over time of Err of each valid run, %."""
    valid = relative_error_percent(result)[~result.data["lost"]]
    return error_measures.mean_per_run(valid, np.zeros(len(valid), dtype=bool))


def mean_trace_per_run(result: store.JobResult, name: str) -> np.ndarray:
    """Compute the mean over time of a trace of each valid run.

    Args:
        result: Result of a filter.
        name: Name of the trace.
    """
    valid = result.data[name][~result.data["lost"]]
    return error_measures.mean_per_run(valid, np.zeros(len(valid), dtype=bool))


def _draw_points(
    axis: Axes,
    points: Sequence[tuple[float, np.ndarray]],
    look: LineStyle,
    label: str,
    open_: bool = False,
) -> None:
    """Draw the medians and bands of points (x, values [n])."""
    for k, (x, values) in enumerate(points):
        finite = values[np.isfinite(values)]
        if not finite.size:
            continue
        low, middle, high = np.quantile(finite, BAND_QUANTILES)
        axis.plot([x, x], [low, high], color=look.colour, lw=1.0, zorder=2)
        axis.plot(
            x, middle, ls="none", ms=4.5, **look.mark() | ({"mfc": "white"} if open_ else {}),
            label=label if k == 0 and label else "", zorder=3,
        )  # fmt: skip
