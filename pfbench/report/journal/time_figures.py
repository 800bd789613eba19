"""Figures of errors over time and of calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.journal.figure_style import (
    MARGIN,
    FigureSetting,
    add_legend_below,
    label_rows,
    line_style,
    mark_style,
    measure_rows,
)
from pfbench.report.journal.study_pack import (
    ALL,
    Pack,
    filters_by_key,
    find_rows,
    is_number,
    name_of,
)
from pfbench.results.plotting import CURVE_RANGE, format_axis_label, use_log_if_wide

_CURVES = 9  # filters at most
_PANELS = 6  # worlds at most
_MARKS = 6  # marks of a curve


def select_curves(pack: Pack) -> list[str]:
    """Select the filters whose curves are shown: proposed ones, the first of the board, and baselines.

    Returns keys in the order of the report, nine at most.
    """
    looks, rows = filters_by_key(pack), list(find_rows(pack))
    proposed = [key for key in rows if looks[key]["proposed"]]
    priority = dict.fromkeys([*proposed, *rows[:1], *map(str, pack["baselines"][:2]), *rows])
    return [key for key in looks if key in list(priority)[:_CURVES]]


def select_worlds(pack: Pack) -> list[str]:
    """Select the worlds with curves under the first noise regime, six at most."""
    regime, worlds = str(pack["regimes"][0]["key"]), [str(world["key"]) for world in pack["worlds"]]
    return [world for world in worlds if (world, regime) in pack["curves"]][:_PANELS]


def plot_over_time(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the median error over time in each world under the first noise regime."""
    regime, looks = str(pack["regimes"][0]["key"]), filters_by_key(pack)
    worlds = select_worlds(pack)
    curves = {world: pack["curves"][world, regime] for world in worlds}
    is_wide = setting.page.has_columns and len(worlds) > 1
    across = max(1, min(len(worlds), 3 if is_wide or setting.page.column > 320 else 1))
    down = -(-len(worlds) // across)
    figure = setting.make_figure(0.35 + 1.35 * down, is_wide=is_wide)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    curve_keys: dict[str, None] = {}
    for axis, world in zip(axes, worlds, strict=False):
        curve_keys |= dict.fromkeys(draw_curves(axis, curves[world], select_curves(pack), looks))
        axis.set_title(setting.escape(name_of(pack, "worlds", world)))
        axis.set_xlabel("time [s]")
    for axis in axes[len(worlds) :]:
        axis.remove()
    for axis in axes[: len(worlds) : across]:
        axis.set_ylabel(setting.escape(_quantity(list(curves.values()))))
    lines = [(str(looks[key]["name"]), line_style(looks[key])) for key in curve_keys]
    add_legend_below(axes[0], lines, setting)
    return figure


def plot_calibration(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the coverage of 50 and 90 % intervals, and NEES relative to its expectation."""
    looks, values = filters_by_key(pack), find_calibration(pack)
    names = [str(looks[key]["name"]) for key in values]
    figure = setting.make_figure(MARGIN + 0.1 + measure_rows(names, setting.page))
    coverage_axis, axis = figure.subplots(1, 2, sharey=True, width_ratios=(1.6, 1.0))
    draw_coverage(coverage_axis, pack, setting)
    label_rows(axis, names, setting)
    axis.tick_params(labelleft=False)
    positive = [1.0]
    for y, (key, row) in enumerate(values.items()):
        if is_number(row["nees_ratio"]) and row["nees_ratio"] > 0:
            positive.append(float(row["nees_ratio"]))
            axis.plot(
                positive[-1:], [y], zorder=3, **{**mark_style(looks[key]), "linestyle": "none"}
            )
    use_log_if_wide(axis, axis.xaxis, [np.array(positive)], narrow=True)
    axis.axvline(1.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)
    axis.set_xlabel("NEES / expectation")
    return figure


def find_calibration(pack: Pack) -> dict[str, Pack]:
    """Return coverage and NEES ratio by filter, in the order of the board if it has them."""
    values = pack["calibration"].get((ALL, ALL), {})
    ordered = [key for key in find_rows(pack) if key in values] or filters_by_key(pack)
    return {key: values[key] for key in ordered if key in values}


def draw_coverage(axis: Axes, pack: Pack, setting: FigureSetting) -> None:
    """Draw the coverage of 50 and 90 % intervals, a row per filter."""
    looks, values = filters_by_key(pack), find_calibration(pack)
    label_rows(axis, [str(looks[key]["name"]) for key in values], setting)
    for level in (50, 90):
        axis.axvline(level, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)
    for y, (key, row) in enumerate(values.items()):
        if is_number(row["c50"]) and is_number(row["c90"]):
            ends = [100 * row["c50"], 100 * row["c90"]]
            axis.plot(ends, [y, y], lw=0.8, zorder=2, **mark_style(looks[key]))
    axis.set_xlim(-2, 102)
    axis.set_xticks([0, 25, 50, 75, 90])
    axis.set_xlabel("coverage [%]".replace("%", setting.escape("%")))


def draw_curves(axis: Axes, curves: Pack, keys: Sequence[str], looks: Pack) -> list[str]:
    """Draw the curves of one panel; return the filters that have one."""
    time, lines = np.asarray(curves["t"], dtype=np.float64), []
    present, step = [key for key in keys if key in curves["filters"]], max(1, len(time) // _MARKS)
    for i, key in enumerate(present):
        median = np.array([np.nan if v is None else v for v in curves["filters"][key]["median"]])
        order, start = 3 if looks[key]["proposed"] else 2, (i * step) // len(present)
        axis.plot(time, median, zorder=order, markevery=(start, step), **line_style(looks[key]))
        lines.append(median)
    use_log_if_wide(axis, axis.yaxis, lines)
    best = min((float(np.nanmedian(v)) for v in lines if np.isfinite(v).any()), default=np.nan)
    if best > 0:  # a filter that diverges leaves the axis
        axis.set_ylim(top=min(axis.get_ylim()[1], CURVE_RANGE * best))
    axis.set_xlim(float(time[0]), float(time[-1]))
    return present


def _quantity(curves: Sequence[Pack]) -> str:
    """Return the label of the y axis: quantity and unit, without a unit that differs by world."""
    groups, units = ({str(curve.get(name, "")) for curve in curves} for name in ("group", "unit"))
    group = f"{groups.pop()} error" if len(groups) == 1 else "error"
    return format_axis_label(f"median {group}", units.pop() if len(units) == 1 else "")
