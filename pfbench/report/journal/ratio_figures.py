"""Figures of ratios: leaderboard, planned pairs, error against cost, headline."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.journal.figure_style import (
    DAGGER,
    MARGIN,
    ROW,
    FigureSetting,
    LegendEntries,
    add_legend_below,
    draw_interval,
    find_page_format,
    label_rows,
    mark_style,
    measure_rows,
    ratio_limits,
    use_ratio_scale,
)
from pfbench.report.journal.study_pack import (
    Pack,
    Row,
    filters_by_key,
    find_rows,
    is_number,
    list_pairs,
    name_baseline,
    name_of,
)
from pfbench.results.plotting import format_axis_label, set_plain_ticks

_GREY = "0.45"
_HALF_DIAMOND = 0.26  # rows
_FAR = 5e3  # m; from there errors are in km
Columns = tuple[str, str, str]
_RATIO: Columns = ("ratio", "ratio_low", "ratio_high")
_LEVEL: Columns = ("value", "low", "high")


def plot_leaderboard(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the error of each filter relative to the baseline, with its interval."""
    rows = _select_rows(find_rows(pack))
    looks = filters_by_key(pack)
    names = [str(looks[key]["name"]) for key in rows]
    figure = setting.make_figure(MARGIN + measure_rows(names, setting.page))
    _draw_leaderboard(figure.subplots(), pack, rows, setting)
    return figure


def plot_worlds(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot each world side by side, in its own order, with the share of runs that keep track.

    A world shows ratios, or median errors if a ratio is missing since a filter or the baseline loses too many runs.
    """
    worlds = [str(order["world"]) for order in pack["world_orders"]]
    tables = [find_rows(pack, world) for world in worlds]
    columns = [
        _RATIO if all(is_number(r["ratio"]) or not is_number(r["value"]) for r in rows.values()) else _LEVEL
        for rows in tables
    ]  # fmt: skip
    tables = [_select_rows(*table) for table in zip(tables, columns, strict=True)]
    figure = setting.make_figure(MARGIN + 0.2 + 1.3 * ROW * max(map(len, tables)))
    for axis, world, rows, names in zip(
        figure.subplots(1, len(worlds), squeeze=False)[0], worlds, tables, columns, strict=True
    ):
        _draw_leaderboard(axis, pack, rows, setting, names)
        axis.set_title(setting.escape(name_of(pack, "worlds", world)), fontweight="bold")
        for y, row in enumerate(rows.values()):
            if row["verdict"] == "loses track" or "loses track" in row["words"]:
                text = setting.escape(f"{100 * float(row['track']):.0f} % keep track")
                axis.annotate(
                    text, (0.02, y), xycoords=("axes fraction", "data"), ha="left", va="center",
                    fontsize=setting.page.tick_size, color=_GREY,
                )  # fmt: skip
    return figure


def _select_rows(rows: Mapping[str, Row], columns: Columns = _RATIO) -> dict[str, Row]:
    """Select the rows that have a value of the columns."""
    return {key: row for key, row in rows.items() if is_number(row[columns[0]])}


def _draw_leaderboard(
    axis: Axes,
    pack: Pack,
    rows: Mapping[str, Row],
    setting: FigureSetting,
    columns: Columns = _RATIO,
) -> None:
    """Draw the rows of a leaderboard: a value with the ends of its interval; the upper end may be open."""
    looks, is_ratio = filters_by_key(pack), columns == _RATIO
    values = [[float(row[n]) if is_number(row[n]) else np.inf for n in columns] for row in rows.values()]  # fmt: skip
    is_far = not is_ratio and min(row[0] for row in values) > _FAR
    ends = np.multiply(values, 1e-3 if is_far else 1.0)
    finite = ends[np.isfinite(ends)]
    limits = ratio_limits(list(finite)) if is_ratio else (finite.min() / 1.08, finite.max() * 1.08)
    use_ratio_scale(axis, *limits)
    label_rows(axis, [str(looks[key]["name"]) for key in rows], setting)
    texts = [f"{value:.2f}" if is_ratio else f"{float(f'{value:.3g}'):g}" for value in ends[:, 0]]
    for y, ((key, row), text) in enumerate(zip(rows.items(), texts, strict=True)):
        draw_interval(axis, y, tuple(ends[y]), looks[key], limits)
        axis.annotate(
            text, (1.0, y), xycoords=("axes fraction", "data"), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=setting.page.tick_size, fontweight="bold" if text == min(texts, key=float) else "normal", annotation_clip=False,
        )  # fmt: skip
        if row["verdict"] == "worse":
            size = setting.page.tick_size
            axis.annotate(
                setting.escape(DAGGER), (1.0, y), xycoords=("axes fraction", "data"), xytext=(3 + 0.52 * size * len(text), 1.5),
                textcoords="offset points", va="center", fontsize=0.8 * size, annotation_clip=False,
            )  # fmt: skip
    metric, unit = (
        pack["metrics"][0],
        next(iter(rows.values()))["unit"] or "",
    )  # worlds differ in their units
    level = f"median {format_axis_label(metric['name'], 'k' * is_far + unit)}"
    axis.set_xlabel(
        setting.escape(f"{metric['name']} relative to {name_baseline(pack)}" if is_ratio else level)
    )


def plot_planned(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot the pairs that were compared in advance: ratio of errors in these worlds, in each, and in a new world."""
    pairs, looks = list_pairs(pack), filters_by_key(pack)
    names = [f"{looks[p['a']]['name']} / {looks[p['b']]['name']}" for p in pairs]
    figure = setting.make_figure(MARGIN + 1.05 * measure_rows(names, setting.page))
    axis = figure.subplots()
    effects = [pair[name] for pair in pairs for name in ("estimate", "low", "high")]
    effects += [cell["estimate"] for pair in pairs for cell in pair["cells"]]
    limits = ratio_limits([float(value) for value in effects if is_number(value)])
    use_ratio_scale(axis, *limits)
    axis.set_xlabel("ratio of errors, first / second", loc="right")  # names are wide
    label_rows(axis, names, setting)
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
    return figure


def plot_error_against_cost(pack: Pack, setting: FigureSetting) -> Figure:
    """Plot error against time per step, with the filters that no filter surpasses in both."""
    figure = setting.make_figure(2.4)
    axis = figure.subplots()
    add_legend_below(axis, draw_error_against_cost(axis, pack, setting), setting)
    return figure


def draw_error_against_cost(
    axis: Axes, pack: Pack, setting: FigureSetting, column: str = "ratio"
) -> LegendEntries:
    """Draw the ratio to the baseline, or the median error `value`, against time per step; return the entries of a legend."""
    looks, is_ratio = filters_by_key(pack), column == "ratio"
    rows = {k: r for k, r in find_rows(pack).items() if is_number(r[column]) and is_number(r["ms"])}
    cost, values = (np.array([float(r[n]) for r in rows.values()]) for n in ("ms", column))
    limits = (
        ratio_limits(list(values), most=2.6) if is_ratio else (min(values) / 2, max(values) * 2)
    )
    errors, marks = np.clip(values, *limits), []
    axis.set(xscale="log", yscale="log", ylim=limits, xlim=(cost.min() / 1.6, cost.max() * 1.6))
    set_plain_ticks(axis.xaxis, cost)
    set_plain_ticks(axis.yaxis, np.array(limits))
    for key, x, value, y in zip(rows, cost, values, errors, strict=True):
        mark, name = {**mark_style(looks[key]), "linestyle": "none"}, str(looks[key]["name"])
        if value != y:
            mark, name = {**mark, "marker": "^"}, f"{name} {value:.3g}"
        axis.plot([x], [y], clip_on=False, zorder=3, **mark)
        marks.append((name, mark))
    path = list_front_corners(np.column_stack([cost, errors]), limits[1])
    axis.plot(*path.T, color="0.6", lw=0.7, zorder=1.2)
    axis.set_xlabel("time per step of a batch of runs [ms]")
    metric = pack["metrics"][0]
    label = f"median {format_axis_label(metric['name'], metric['unit'])}"
    if is_ratio:
        axis.axhline(1.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)
        label = f"{metric['name']} / {name_baseline(pack)}"
    axis.set_ylabel(setting.escape(label))
    return marks


def list_front_corners(points: np.ndarray, top: float) -> np.ndarray:
    """Return the corners of the steps of points that no point surpasses in both coordinates.

    Shapes: points [n, 2].
    """
    corners: list[tuple[float, float]] = []
    for x, y in points[np.lexsort((points[:, 1], points[:, 0]))]:
        least = corners[-1][1] if corners else top
        if y < least:
            corners += [(x, least), (x, y)]
    corners += [(points[:, 0].max(), y) for _, y in corners[-1:]]
    return np.array(corners).reshape(-1, 2)


def _draw_diamond(axis: Axes, y: int, pair: Pack, colour: str, limits: tuple[float, float]) -> None:
    """Draw an effect as a diamond between the ends of its interval, filled if it is decided."""
    low, value, high = (
        float(np.clip(pair[name], *limits)) if is_number(pair[name]) else np.nan
        for name in ("low", "estimate", "high")
    )
    across, along = [low, value, high, value], [y, y - _HALF_DIAMOND, y, y + _HALF_DIAMOND]
    face = colour if pair["word"] in ("better", "worse") else "white"
    axis.fill(across, along, facecolor=face, edgecolor=colour, lw=0.8, zorder=3)


# --------------------------------------------------------------------------------------------------
# Static figure of a published study: the leaderboard, drawn as for a paper.

HEADLINE = "headline.svg"
_WIDTH, _WORLD_WIDTH = "150mm", 105  # of all worlds together, and of each [mm]
_NUMBER = re.compile(r"(?<![\w#.])-?\d+\.\d+(?!\w)")  # not in names
_EQUAL_WITHIN = 1e-3  # units of the drawing
_SVG: Any = {"svg.hashsalt": "pfbench", "svg.fonttype": "none"}  # equal bytes, text as text


def render_headline(pack: Pack, stored: bytes = b"") -> bytes:
    """Draw the error of each filter relative to the baseline as SVG; empty if no filter has a ratio.

    A stored drawing that differs in the last digits alone stays. Equal data give equal bytes.

    Args:
        pack: Data of the page.
        stored: An earlier drawing.
    """
    opening = next(iter(pack["views"].values()))
    if all(row["ratio"] is None for row in opening["rows"]):
        return b""
    worlds = pack.get("world_orders")
    plot, width = (plot_worlds, f"{_WORLD_WIDTH * len(worlds)}mm") if worlds else (plot_leaderboard, _WIDTH)  # fmt: skip
    setting, buffer = FigureSetting(find_page_format(width=width)), io.BytesIO()
    with setting.applied(), matplotlib.rc_context(_SVG):
        plot(pack, setting).savefig(buffer, format="svg", metadata={"Date": None})
    drawing = buffer.getvalue()
    return stored if stored and is_equal_drawing(stored, drawing) else drawing


def is_equal_drawing(first: bytes, second: bytes) -> bool:
    """Return whether two SVG drawings differ in their numbers by less than 0.001 at most.

    The last digit of a coordinate differs between processors.

    Args:
        first: SVG.
        second: SVG.
    """
    texts = [drawing.decode() for drawing in (first, second)]
    if len({_NUMBER.sub("#", text) for text in texts}) > 1:
        return False
    numbers = zip(*map(_NUMBER.findall, texts), strict=True)
    return all(abs(float(a) - float(b)) < _EQUAL_WITHIN for a, b in numbers)
