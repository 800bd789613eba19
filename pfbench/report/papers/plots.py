"""Plots of the paper figures: medians over runs with one band, and crosses at the numbers that a paper prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.results import store
from pfbench.results.conditions import ComponentGroup
from pfbench.results.frame import select_indices
from pfbench.results.plotting import (
    COLUMN,
    CURVE_RANGE,
    SMALL,
    LineStyle,
    add_legend,
    compute_run_quantiles,
    format_axis_label,
    set_plain_ticks,
)
from pfbench.stats import error_measures

BAND_QUANTILES = (0.1, 0.5, 0.9)
BAND = "80 % of runs"
_INSTANTS = 90  # points of a curve: three panels of four curves stay below 60 kB
_MARKS = 4  # of a curve
_WIDE = 10.0  # ratio of the values from which an axis is logarithmic
_DOTS, _DASHES = (0, (1.0, 1.0)), (0, (4.0, 2.0))
_DIRECTIONS = {"E": "East", "N": "North", "U": "Up"}
ResultsWithGroup = Mapping[str, tuple[store.JobResult, ComponentGroup]]


class CurveLook(NamedTuple):
    """Name and line style of a curve; the form that a paper prints is dotted."""

    name: str
    line: LineStyle

    @classmethod
    def of(cls, name: str, line: LineStyle, is_printed: bool = False) -> CurveLook:
        """Return the look of a filter by its name and style in the study.

        Args:
            name: Name of the filter.
            line: Line style of the filter.
            is_printed: Whether it is the form that a paper prints.
        """
        return cls(name, line._replace(dash=_DOTS) if is_printed and line.filled else line)


Looks = Mapping[str, CurveLook]


class PrintedValue(NamedTuple):
    """Number that a paper prints.

    Attributes:
        filter: Label of the filter.
        component: Component of the error; empty for a trace.
        at: Time in s, or the measure: RMSE or maximum.
        value: Number in the displayed unit.
    """

    filter: str
    component: str
    at: float | str
    value: float


Printed = Sequence[PrintedValue]


def plot_errors(
    columns: Mapping[str, ResultsWithGroup],
    looks: Looks,
    printed: Printed = (),
    start: float = 0.0,
    before: bool = False,
) -> Figure:
    """Plot the size of the error over time, a row per component, with the measures that the paper prints."""
    blocks = [block for results in columns.values() for _, block in results.values()]
    components = list(dict.fromkeys(name for block in blocks for name in block.components))
    measures = list(dict.fromkeys(p.at for p in printed if isinstance(p.at, str)))
    strips = list(product(measures, columns))
    widths = [1.0] * len(columns) + [0.06 + 0.24 * len(strips)] * bool(strips)
    figure, rows = _make_grid(len(components), widths, 1.3)
    for component, row in zip(components, rows, strict=True):
        numbers = [p for p in printed if p.component == component]
        values: list[Levels] = []
        for axis, results in zip(row, columns.values(), strict=False):
            curves = {
                label: (result.data["time"], select_valid(result, np.abs(_component(result, block, component))))
                for label, (result, block) in results.items() if component in block.components
            }  # fmt: skip
            values.append(_draw_curves(axis, curves, looks, numbers, _INSTANTS // len(columns)))
            if before:
                values.append(_draw_first(axis, *next(iter(curves.values()))))
        if strips:
            points = {
                (measure if len(columns) == 1 else title, measure): {
                    label: measure_error(measure, result, block, component, start)
                    for label, (result, block) in columns[title].items()
                }
                for measure, title in strips
            }
            values.append(_draw_points(row[-1], points, looks, numbers))
        _set_scale(row, values)
    label = format_axis_label("error", blocks[0].unit)
    _name_panels(rows, list(map(name_component, components)), list(columns), label)
    if len(measures) == 1 < len(columns):
        rows[0][-1].set_title(measures[0])
    _finish(figure, rows, len(columns), looks)
    return figure


def plot_curves(
    rows: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]],
    time: np.ndarray,
    label: str,
    looks: Looks,
    printed: Printed = (),
) -> Figure:
    """Plot traces over time: values [R, T] by the title of a row, of a column, and by filter."""
    titles = list(next(iter(rows.values())))
    figure, axes = _make_grid(len(rows), [1.0] * len(titles), 2.0 if len(rows) == 1 else 1.4)
    for row, columns in zip(axes, rows.values(), strict=True):
        values = [
            _draw_curves(
                axis, {n: (time, v) for n, v in columns[title].items()}, looks, printed, _INSTANTS // len(titles)
            )
            for axis, title in zip(row, titles, strict=True)
        ]  # fmt: skip
        _set_scale(row, values)
    _name_panels(axes, list(rows), titles, label)
    _finish(figure, axes, len(titles), looks)
    return figure


def plot_points(
    columns: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]],
    looks: Looks,
    label: str,
    xlabel: str = "",
    printed: Mapping[str, Printed] | None = None,
) -> Figure:
    """Plot medians and bands of values [n] by the title of a column, category and filter, on one scale."""
    figure, rows = _make_grid(1, [1.0] * len(columns), 2.1)
    values = [
        _draw_points(
            axis, {(name, name): v for name, v in groups.items()}, looks, (printed or {}).get(title, ())
        )
        for axis, (title, groups) in zip(rows[0], columns.items(), strict=True)
    ]  # fmt: skip
    for axis in rows[0]:
        axis.set_xlabel(xlabel)
    _name_panels(rows, [""], list(columns), label)
    _set_scale(rows[0], values)
    _finish(figure, rows, 0, looks)
    return figure


def plot_escape(curves: Mapping[str, np.ndarray], looks: Looks) -> Figure:
    """Plot escape factors over the iterations of a step as a share of all, curves [k] by name."""
    figure, ((axis,),) = _make_grid(1, [1.0], 2.0)
    for label, values in curves.items():
        share, (name, line) = np.linspace(0.0, 1.0, len(values)), looks[label]
        axis.plot(share, values, **line.line(name), markevery=0.1, **line.mark())
    axis.set(xlabel="iteration / number of iterations", ylabel="c3 = c4")
    axis.set_ylim(bottom=0)
    add_legend(figure, axis, 1)
    return figure


def name_component(name: str) -> str:
    """Name a component of the state in words, such as position North."""
    group, _, direction = name.rpartition("_")
    return f"{group} {_DIRECTIONS.get(direction, direction)}".replace("_", " ").strip()


def measure_error(
    measure: str, result: store.JobResult, block: ComponentGroup, component: str, start: float
) -> np.ndarray:
    """Compute the RMSE or the maximum of the error of a component from a time on, for each valid run, [n]."""
    late = result.data["time"] >= start
    error = _component(result, block, component)[~result.data["lost"]][:, late, None]
    compute = error_measures.rmse_per_run if measure == "RMSE" else error_measures.max_error
    return compute(error, np.zeros(len(error), dtype=bool))


def relative_error_percent(result: store.JobResult) -> np.ndarray:
    """Return the horizontal error in % of the range, [R, T]."""
    horizontal = result.meta["state"]["groups"]["position"][:2]  # as in the tables
    error = result.data["error"][..., horizontal].astype(np.float64)
    return np.asarray(100 * np.sqrt((error**2).sum(-1)) / result.data["range"])


def select_valid(result: store.JobResult, values: np.ndarray) -> np.ndarray:
    """Return the rows of valid runs, [n, T]."""
    return values[~result.data["lost"]].astype(np.float64)


class Levels(NamedTuple):
    """Values of one panel: medians by name of the filter, what else is drawn, and the printed numbers."""

    medians: dict[str, np.ndarray]
    others: np.ndarray
    printed: np.ndarray


def _component(result: store.JobResult, block: ComponentGroup, component: str) -> np.ndarray:
    """Return the error of a component in its displayed unit, [R, T]."""
    index = block.places[block.components.index(component)]
    return np.asarray(block.scale * result.data["error"][..., index].astype(np.float64))


def _draw_curves(
    axis: Axes,
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    looks: Looks,
    printed: Printed,
    instants: int,
) -> Levels:
    """Draw medians over runs, the band of the last filter, and crosses at printed numbers."""
    medians, others = {}, [np.empty(0)]
    for k, (label, (times, values)) in enumerate(curves.items()):
        name, line = looks[label]
        steps = np.flatnonzero(~np.isnan(values).all(0))
        steps = steps[select_indices(steps.size, instants)]
        time = times[steps]
        low, medians[name], high = compute_run_quantiles(values[:, steps], BAND_QUANTILES)
        every = max(1, time.size // _MARKS)
        axis.plot(
            time, medians[name], ms=3.2, markevery=(k * every // max(1, len(curves)), every),
            **line.line(name), **line.mark(),
        )  # fmt: skip
        if k == len(curves) - 1:
            axis.fill_between(time, low, high, color=line.colour, alpha=0.18, lw=0)
            others += [low, high]
    crosses = [p for p in printed if p.filter in curves and not isinstance(p.at, str)]
    for p in crosses:
        _draw_cross(axis, p.at, p.value, looks[p.filter].line.colour)
    return Levels(medians, np.concatenate(others), np.array([p.value for p in crosses]))


def _draw_points(
    axis: Axes,
    groups: Mapping[tuple[str, str], Mapping[str, np.ndarray]],
    looks: Looks,
    printed: Printed,
) -> Levels:
    """Draw medians and bands of values [n] by category (its name and measure) and filter, with crosses at printed numbers."""
    medians: dict[str, np.ndarray] = {}
    others, crosses = [], []
    for x, ((_, measure), values) in enumerate(groups.items()):
        for i, (label, all_values) in enumerate(values.items()):
            finite = all_values[np.isfinite(all_values)]
            x_filter = x + 0.8 * ((i + 0.5) / len(values) - 0.5)
            numbers = [p.value for p in printed if (p.at, p.filter) == (measure, label)]
            for value in numbers:
                _draw_cross(axis, x_filter, value, "black")
            crosses += numbers
            if not finite.size:
                continue
            name, line = looks[label]
            low, middle, high = np.quantile(finite, BAND_QUANTILES)
            axis.plot([x_filter, x_filter], [low, high], color=line.colour, lw=1.0, zorder=2)
            axis.plot(
                x_filter,
                middle,
                ls="none",
                ms=4.2,
                zorder=3,
                label="" if name in medians else name,
                **line.mark(),
            )
            medians[name] = np.append(medians.get(name, np.empty(0)), middle)
            others += [low, high]
    names = [name.replace("maximum", "max").rpartition(" ")[2] for name, _ in groups]
    axis.set_xticks(range(len(groups)), names)
    axis.set_xlim(-0.6, len(groups) - 0.4)
    axis.grid(False, axis="x")
    return Levels(medians, np.array(others), np.array(crosses))


def _draw_first(axis: Axes, time: np.ndarray, values: np.ndarray) -> Levels:
    """Draw the edges of the band at the first step, at which filters that share data are equal."""
    edges = np.quantile(values[:, 0], BAND_QUANTILES[::2])
    axis.hlines(edges, time[0], time[-1], colors="black", linestyles=_DASHES, lw=0.9, zorder=4)
    return Levels({}, edges, np.empty(0))


def _draw_cross(axis: Axes, x: Any, y: float, colour: str) -> None:
    """Draw a cross at a printed number."""
    style: Any = {"ls": "none", "marker": "x", "ms": 6.5, "mew": 1.5, "zorder": 6}
    axis.plot(x, y, color=colour, clip_on=False, label="_printed", **style)


def _set_scale(axes: Sequence[Axes], panels: Sequence[Levels]) -> None:
    """Use one scale in a row of panels, where good filters stay distinct whatever a bad one does.

    The scale is logarithmic if the values span a factor of ten. It ends at 10000 times the typical value of the best
    filter, and names the filters that lie beyond.
    """
    medians = [item for panel in panels for item in panel.medians.items()]
    printed = np.concatenate([panel.printed for panel in panels])
    others = [panel.others for panel in panels]
    positive = np.concatenate([*(values for _, values in medians), *others, printed])
    positive = positive[np.isfinite(positive) & (positive > 0)]
    levels = [v[np.isfinite(v) & (v > 0)] for _, v in medians]
    levels = [v for v in levels if v.size]
    if not levels:
        return
    least = min(float(np.median(v)) for v in levels)
    lowest = min(float(np.quantile(v, 0.02, method="lower")) for v in levels)
    high = min(float(positive.max()), CURVE_RANGE * least)
    is_log = high > _WIDE * least
    low = min([max(float(positive.min()), lowest / _WIDE), *printed]) if is_log else 0.0
    for axis in axes:
        if is_log:
            axis.set_yscale("log")
            set_plain_ticks(axis.yaxis, np.array([low, high]))
            axis.minorticks_off()  # a third of the drawing
        axis.set_ylim(low / 1.2, 1.3 * high if is_log else 1.08 * high)
    for axis in axes[1:]:
        axis.tick_params(labelleft=False)
    outside = dict.fromkeys(name for name, values in medians if np.nanmax(values) > high)
    if outside:
        axes[0].annotate(
            f"beyond the axis: {', '.join(outside)}", (0.02, 0.97), xycoords="axes fraction",
            va="top", fontsize=SMALL,
        )  # fmt: skip


def _make_grid(
    rows: int, widths: Sequence[float], height: float
) -> tuple[Figure, Sequence[Sequence[Axes]]]:
    """Create a figure of one column of print with panels in rows."""
    figure = Figure(figsize=(COLUMN, 0.3 + height * rows), layout="constrained")
    grid = figure.subplots(rows, len(widths), squeeze=False, sharex="col", width_ratios=widths)
    return figure, [list(row) for row in grid]


def _name_panels(
    rows: Sequence[Sequence[Axes]], names: Sequence[str], titles: Sequence[str], label: str
) -> None:
    """Write the names of rows and columns, and the quantity at the left."""
    for row, name in zip(rows, names, strict=True):
        row[0].set_ylabel(f"{name}\n{label}".strip() if len(titles) > 1 else label)
        if len(titles) == 1:
            row[0].set_title(titles[0] or name)
    if len(titles) > 1:
        for axis, title in zip(rows[0], titles, strict=False):
            axis.set_title(title)


def _finish(figure: Figure, rows: Sequence[Sequence[Axes]], curves: int, looks: Looks) -> None:
    """Label the time axes of the columns of curves, and add the legend: filters, band, printed numbers."""
    for axis in rows[-1][:curves]:
        axis.set_xlabel("time [s]")
    first, axes = rows[0][0], [axis for row in rows for axis in row]
    labels = {line.get_label() for axis in axes for line in axis.lines}
    present = {line.get_label() for line in first.lines}
    for name, line in looks.values():
        if name in labels - present:
            style = line.line(name) if curves else {"ls": "none", "label": name}
            first.plot([], [], ms=3.2, **style, **line.mark())
    if curves:
        first.fill_between([], [], color="0.8", lw=0, label=BAND)
    if "_printed" in labels:
        first.plot([], [], "x", color="black", ms=6.5, mew=1.5, label="printed")
    add_legend(figure, first)
