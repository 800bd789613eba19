"""Plots of the paper figures over time, with bands over runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.results import store
from pfbench.results.conditions import ComponentGroup
from pfbench.results.frame import select_indices
from pfbench.results.plotting import (
    LineStyle,
    add_legend,
    compute_run_quantiles,
    format_axis_label,
    format_ticks,
    stacked_axes,
    use_log_if_wide,
)
from pfbench.stats import error_measures

SYMLOG = " Outside the grey lines, if any, the scale is logarithmic."
BAND_QUANTILES = (0.05, 0.5, 0.95)
_SIDE = 3  # ticks on each side of 0 at most
ResultsWithGroup = Mapping[str, tuple[store.JobResult, ComponentGroup]]


def plot_errors(
    results: ResultsWithGroup, style: Mapping[str, LineStyle], before: bool = False
) -> Figure:
    """Plot the signed error over time, 5 to 95 % and median of the runs, a panel per component."""
    components = list(
        dict.fromkeys(name for _, block in results.values() for name in block.components)
    )
    figure, panels = stacked_axes(len(components), 1.45)
    for component, axis in zip(components, panels, strict=True):
        curves = []
        for label, (result, block) in results.items():
            if component not in block.components:
                continue
            index = block.places[block.components.index(component)]
            time, values = _valid_runs(result, result.data["error"][..., index])
            band = compute_run_quantiles(values * block.scale, BAND_QUANTILES)
            _draw_band(axis, time, band, style[label], label, len(results))
            curves.append(band)
            if before and len(curves) == 1:  # equal for all filters, which share the data
                for edge in band[::2, 0]:
                    axis.axhline(edge, color="black", lw=0.9, ls=(0, (4, 2)), zorder=4)
        unit = next(block.unit for _, block in results.values())
        axis.set(title=component, ylabel=format_axis_label("error", unit))
        _symlog_if_wide(axis, curves)
    panels[-1].set_xlabel("time [s]")
    add_legend(figure, panels[0])
    return figure


def plot_paper_trace(
    results: Mapping[str, store.JobResult],
    name: str,
    unit: str,
    style: Mapping[str, LineStyle],
    printed: Sequence[float],
) -> Figure:
    """Plot a trace over time, and the limits that the paper prints."""
    figure, (axis,) = stacked_axes(1, 2.0)
    for label, result in results.items():
        time, values = _valid_runs(result, result.data[name])
        band = compute_run_quantiles(values, BAND_QUANTILES)
        _draw_band(axis, time, band, style[label], label, len(results))
    if np.isfinite(printed).all():
        axis.axhspan(*printed, color="0.88", lw=0, zorder=0)
    axis.set(xlabel="time [s]", ylabel=unit)
    axis.set_ylim(bottom=0)
    add_legend(figure, axis)
    return figure


def plot_escape(factors: Mapping[str, tuple[float, int]], style: Mapping[str, LineStyle]) -> Figure:
    """Plot escape factors over the iterations, as repaired and as printed."""
    figure, (axis,) = stacked_axes(1, 2.0)
    for label, (size, most) in factors.items():
        k = np.arange(most + 1)
        repaired = size * (1.0 - np.cos(np.pi * k / most))
        printed = size - size * np.cos(np.pi * k) / most
        axis.plot(k, repaired, marker="." if most < 10 else "", **style[label].line(label))
        axis.plot(k, printed, color=style[label].colour, ls=":", lw=0.8)
    axis.set(xlabel="iteration", ylabel="c3")
    axis.set_ylim(bottom=0)
    add_legend(figure, axis)
    return figure


def plot_relative_errors(
    experiments: Mapping[str, Mapping[str, store.JobResult]], style: Mapping[str, LineStyle]
) -> Figure:
    """Plot the horizontal error in % of the range over time, a panel per experiment."""
    figure, panels = stacked_axes(len(experiments), 1.6)
    for (name, results), axis in zip(experiments.items(), panels, strict=True):
        lines = []
        for label, result in results.items():
            time, values = _valid_runs(result, relative_error_percent(result))
            band = compute_run_quantiles(values, BAND_QUANTILES)
            _draw_band(axis, time, band, style[label], label, len(results))
            lines += list(band)
        axis.set(title=name, ylabel="Err [%]")
        use_log_if_wide(axis, axis.yaxis, lines)
    panels[-1].set_xlabel("time [s]")
    add_legend(figure, panels[0])
    return figure


def relative_error_percent(result: store.JobResult) -> np.ndarray:
    """Return the horizontal error in % of the range, [R, T]."""
    horizontal = result.meta["state"]["groups"]["position"][:2]  # as in the tables
    error = result.data["error"][..., horizontal].astype(np.float64)
    return np.asarray(100 * np.sqrt((error**2).sum(-1)) / result.data["range"])


def _valid_runs(result: store.JobResult, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return thinned times and values [R, T] of the valid runs."""
    valid = values[~result.data["lost"]].astype(np.float64)
    steps = np.flatnonzero(~np.isnan(valid).all(0))
    steps = steps[select_indices(steps.size)]
    return result.data["time"][steps], valid[:, steps]


def _draw_band(
    axis: Axes, time: np.ndarray, band: np.ndarray, look: LineStyle, label: str, among: int
) -> None:
    """Draw a median with its band, whose edges are lines so that overlapping bands stay distinct."""
    low, middle, high = band
    axis.fill_between(time, low, high, color=look.colour, alpha=0.24 / (1 + among), lw=0)
    for edge in (low, high):
        axis.plot(time, edge, color=look.colour, ls=look.dash, lw=0.6)
    axis.plot(
        time,
        middle,
        color=look.colour,
        ls=look.dash,
        lw=look.width,
        label=label,
        marker="." if time.size == 1 else "",
    )


def _late_level(curve: np.ndarray) -> float:
    """Return the 90 % quantile of absolute values [q, T] after the first third, 0 without values."""
    sizes = np.abs(curve[:, curve.shape[1] // 3 :])
    finite = sizes[np.isfinite(sizes)]
    return float(np.quantile(finite, 0.9)) if finite.size else 0.0


def _symlog_if_wide(axis: Axes, curves: Sequence[np.ndarray]) -> None:
    """Use a symmetric logarithmic scale if the values span a wide range.

    The scale is linear up to the late level of the best filter, where good filters stay distinct.
    """
    sizes = np.concatenate([np.abs(curve).ravel() for curve in curves]) if curves else np.empty(0)
    sizes = sizes[np.isfinite(sizes)]
    late = [_late_level(curve) for curve in curves]
    level = min((size for size in late if size > 0), default=0.0)
    if sizes.max(initial=0.0) > 8 * level > 0:
        decades = float(np.log10(sizes.max() / level))
        axis.set_yscale(
            "symlog", linthresh=level, linscale=max(1.2, 0.7 * decades)
        )  # at least two fifths are linear
        for edge in (level, -level):
            axis.axhline(edge, color="0.55", lw=0.7, zorder=1)
        tens = 10.0 ** np.arange(np.floor(np.log10(level)), np.floor(np.log10(sizes.max())) + 1)
        outer = tens[tens >= 1.5 * level]
        top = np.floor(sizes.max() / tens[-1]) * tens[-1]  # the largest one-digit multiple
        if not outer.size or top > 3 * outer[-1]:
            outer = np.append(outer, top)
        outer = outer[:: -(-outer.size // _SIDE)]
        ticks = [*(-outer[::-1]), 0.0, *outer]
        axis.set_yticks(ticks, format_ticks(ticks))
        axis.minorticks_off()


# --------------------------------------------------------------------------------------------------
# Plots of the paper figures by experiment or component.


def plot_against(
    values: Mapping[str, Mapping[str, np.ndarray]], style: Mapping[str, LineStyle], ylabel: str
) -> Figure:
    """Plot the median and the band over runs by experiment.

    Shapes: values [n].
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
    """Plot maximum error and RMSE by component, with crosses at values of the paper."""
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
    """Compute the mean over time of a trace of each valid run."""
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
