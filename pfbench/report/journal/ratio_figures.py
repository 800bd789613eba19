"""Figures of ratios: leaderboard, planned pairs, and error against cost."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.journal.figure_style import (
    DAGGER,
    MARGIN,
    ROW,
    FigureSetting,
    draw_interval,
    label_rows,
    mark_style,
    ratio_limits,
    use_ratio_scale,
)
from pfbench.report.journal.study_pack import (
    Pack,
    filters_by_key,
    find_rows,
    is_number,
    list_pairs,
)
from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.label_placement import place_labels

_GREY = "0.45"
_HALF_DIAMOND = 0.26  # rows


def plot_leaderboard(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the error of each filter relative to the baseline, with its interval.

    Args:
        pack: Data of the report.
        setting: Setting of the figures.
    """
    looks, rows = filters_by_key(pack), find_rows(pack)
    rows_with_ratio = {key: row for key, row in rows.items() if is_number(row["ratio"])}
    figure = setting.make_figure(MARGIN + ROW * max(len(rows_with_ratio), 2))
    axis = figure.subplots()
    limits = ratio_limits([
        float(row[name]) for row in rows_with_ratio.values() for name in ("ratio", "ratio_low", "ratio_high") if is_number(row[name])
    ])  # fmt: skip
    use_ratio_scale(axis, *limits)
    label_rows(axis, [str(looks[key]["name"]) for key in rows_with_ratio], setting)
    least = min((f"{row['ratio']:.2f}" for row in rows_with_ratio.values()), default="")
    for y, (key, row) in enumerate(rows_with_ratio.items()):
        ends = [
            float(row[n]) if is_number(row[n]) else np.nan
            for n in ("ratio", "ratio_low", "ratio_high")
        ]
        draw_interval(axis, y, (ends[0], ends[1], ends[2]), looks[key], limits)
        text = f"{ends[0]:.2f}"
        axis.annotate(
            text, (1.0, y), xycoords=("axes fraction", "data"), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=setting.page.tick_size, fontweight="bold" if text == least else "normal", annotation_clip=False,
        )  # fmt: skip
        if row["verdict"] == "worse":
            _write_dagger(axis, y, text, setting)
    baseline = looks[str(pack["baselines"][0])]["name"] if pack["baselines"] else ""
    axis.set_xlabel(setting.escape(f"{pack['metrics'][0]['name']} relative to {baseline}"))
    return figure


def plot_planned(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the planned pairs: effect in these worlds, each world, and a new world.

    Ratios of errors have a logarithmic axis. Differences of runs won have a panel with a linear axis below.

    Args:
        pack: Data of the report.
        setting: Setting of the figures.
    """
    kinds = [(has_won, list_pairs(pack, has_won=has_won)) for has_won in (False, True)]
    kinds = [(has_won, pairs) for has_won, pairs in kinds if pairs]
    rows = [max(len(pairs), 2) for _, pairs in kinds]
    figure = setting.make_figure(MARGIN * len(kinds) + 1.05 * ROW * sum(rows))
    panels = figure.subplots(len(kinds), 1, squeeze=False, height_ratios=rows).ravel()
    for axis, (has_won, pairs) in zip(panels, kinds, strict=True):
        _plot_pairs(axis, pairs, filters_by_key(pack), setting, has_won=has_won)
    return figure


def _plot_pairs(
    axis: Axes, pairs: Sequence[Pack], looks: Pack, setting: FigureSetting, *, has_won: bool
) -> None:
    """Plot pairs of one kind of effect: ratios, or percentage points of runs won."""
    effects = [pair[name] for pair in pairs for name in ("estimate", "low", "high")]
    effects += [cell["estimate"] for pair in pairs for cell in pair["cells"]]
    values = [float(value) for value in effects if is_number(value)]
    if has_won:
        limits = min(-5.0, *values) * 1.08, max(5.0, *values) * 1.08
        axis.set_xlim(limits)
        axis.axvline(0.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)
        axis.set_xlabel("runs won, first minus second [points]", loc="right")  # names are wide
    else:
        limits = ratio_limits(values)
        use_ratio_scale(axis, *limits)
        axis.set_xlabel("ratio of errors, first / second", loc="right")
    label_rows(axis, [f"{looks[p['a']]['name']} / {looks[p['b']]['name']}" for p in pairs], setting)
    for y, pair in enumerate(pairs):
        new, colour = pair.get("new_world"), str(looks[pair["a"]]["colour"])
        if new and is_number(new["low"]) and is_number(new["high"]):
            ends = np.clip([new["low"], new["high"]], *limits)
            axis.plot(ends, [y, y], color=_GREY, lw=0.5, zorder=1.5)
        for cell in pair["cells"]:
            if is_number(cell["estimate"]):
                x = float(np.clip(cell["estimate"], *limits))
                axis.plot([x], [y], ".", ms=2.5, color=_GREY, zorder=2)
        _draw_diamond(axis, y, pair, colour, limits)


def plot_error_against_cost(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot error against time per step, with the filters that no filter surpasses in both.

    Args:
        pack: Data of the report.
        setting: Setting of the figures.
    """
    looks, rows = filters_by_key(pack), find_rows(pack)
    rows_with_ratio = {
        k: row for k, row in rows.items() if is_number(row["ratio"]) and is_number(row["ms"])
    }
    figure = setting.make_figure(2.7)
    axis = figure.subplots()
    cost = np.array([float(row["ms"]) for row in rows_with_ratio.values()])
    limits = ratio_limits([float(row["ratio"]) for row in rows_with_ratio.values()], most=2.6)
    ratio = np.clip([float(row["ratio"]) for row in rows_with_ratio.values()], *limits)
    _set_cost_axes(axis, cost, limits)
    names = {}
    for i, (key, row) in enumerate(rows_with_ratio.items()):
        is_inside = limits[0] <= row["ratio"] <= limits[1]
        style = mark_style(looks[key]) | ({} if is_inside else {"marker": "^"})
        axis.plot([cost[i]], [ratio[i]], clip_on=False, zorder=3, **{**style, "linestyle": "none"})
        extra = "" if is_inside else f" {row['ratio']:.3g}"
        names[i] = setting.escape(f"{looks[key]['name']}{extra}")
    path = list_front_corners(np.column_stack([cost, ratio]), limits[1])
    axis.plot(*path.T, color="0.6", lw=0.7, zorder=1.2)
    baseline = looks[str(pack["baselines"][0])]["name"] if pack["baselines"] else ""
    axis.set_xlabel("time per step of a batch of runs [ms]")
    axis.set_ylabel(setting.escape(f"{pack['metrics'][0]['name']} / {baseline}"))
    figure.draw_without_rendering()
    points = np.column_stack([cost, ratio])
    line = [(np.nan, np.nan), *((x, 1.0) for x in axis.get_xlim())]  # a gap, then the line at 1
    place_labels(axis, points, names, np.full(len(points), 2.5), np.concatenate([path, line]))
    return figure


def _set_cost_axes(axis: Axes, cost: np.ndarray, limits: tuple[float, float]) -> None:
    """Use logarithmic axes with plain numbers, and a line at 1."""
    axis.set(xscale="log", yscale="log", ylim=limits)
    axis.set_xlim(cost.min() / 1.6, cost.max() * 1.6)
    set_plain_ticks(axis.xaxis, cost)
    set_plain_ticks(axis.yaxis, np.array(limits))
    axis.axhline(1.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)


def list_front_corners(points: np.ndarray, top: float) -> np.ndarray:
    """Return the corners of the steps of points that no point surpasses in both coordinates.

    Args:
        points: Points, [n, 2]; smaller is better.
        top: Upper end of the first step.

    Returns:
        Corners, [m, 2].
    """
    corners, least = [], top
    for x, y in points[np.lexsort((points[:, 1], points[:, 0]))]:
        if y < least:
            corners += [(x, least), (x, y)]
            least = y
    if corners:
        corners.append((points[:, 0].max(), least))
    return np.array(corners).reshape(-1, 2)


def _write_dagger(axis: Axes, y: int, text: str, setting: FigureSetting) -> None:
    """Write a dagger after a number at the right of a row."""
    size = setting.page.tick_size
    axis.annotate(
        setting.escape(DAGGER), (1.0, y), xycoords=("axes fraction", "data"), xytext=(3 + 0.52 * size * len(text), 1.5),
        textcoords="offset points", va="center", fontsize=0.8 * size, annotation_clip=False,
    )  # fmt: skip


def _draw_diamond(axis: Axes, y: int, pair: Pack, colour: str, limits: tuple[float, float]) -> None:
    """Draw an effect as a diamond between the ends of its interval, filled if it is decided."""
    low, value, high = (
        float(np.clip(pair[name], *limits)) if is_number(pair[name]) else np.nan
        for name in ("low", "estimate", "high")
    )
    corners = [(low, y), (value, y - _HALF_DIAMOND), (high, y), (value, y + _HALF_DIAMOND)]
    is_decided = pair["word"] in ("better", "worse")
    axis.fill(
        *zip(*corners, strict=True),
        facecolor=colour if is_decided else "white",
        edgecolor=colour,
        lw=0.8,
        zorder=3,
    )
