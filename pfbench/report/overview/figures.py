"""Figures of the first page, drawn by seaborn: worlds by methods, and methods against each other.

Each is drawn for a page, for a telephone and for a column of a journal, never scaled.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pfbench.report.overview.tables import Overview, World, count_wins
from pfbench.results.plotting import RC, line_styles, set_plain_ticks
from pfbench.stats.comparison import EQUAL_WORDS, Verdict
from pfbench.stats.court import Pair

BLUE, ORANGE, GREY, INK = "#2166ac", "#c4561a", "#d4d4d4", "#1b1b1b"
_SCALE = math.log(3.0)  # log ratio of the strongest colour
_DPI = 96  # a pixel of CSS
GROUPS = {
    True: "Worlds that Kalman filters fit, by runs of another seed",
    False: "Worlds that Kalman filters do not fit, by runs of another seed",
    None: "Worlds",
}

_KEY = (
    (BLUE, "smaller error"), (ORANGE, "larger error"), ("white", "not decided; = within 5 %"),
    (GREY, "loses track; % of runs that keep it"),
)  # fmt: skip


class Format(NamedTuple):
    """Size of a figure.

    Attributes:
        name: Suffix of its files.
        width: Width [px].
        font: Size of text [pt].
        row: Height of a row [px].
        label_width: Width of the names of rows [px].
        note_width: Width of the notes at the right [px]; 0 for none.
        top: Height of the names of columns [px].
    """

    name: str
    width: int
    font: float
    row: int
    label_width: int
    note_width: int
    top: int


HEAT_FORMATS = (
    Format("", 860, 7.6, 30, 208, 178, 104),
    Format("_390", 374, 6.6, 27, 96, 34, 92),
    Format("_column", 336, 6.5, 19, 88, 34, 84),
)
DOSE_FORMATS = (Format("", 1360, 7.6, 30, 0, 0, 0), Format("_390", 374, 6.6, 27, 0, 0, 0))
MATRIX_FORMATS = (
    Format("", 520, 7.4, 27, 122, 56, 88),
    Format("_390", 374, 6.6, 27, 104, 40, 84),
    Format("_column", 336, 6.5, 19, 96, 34, 80),
)


def fold_name(name: str, longest: int = 16) -> str:
    """Return a long name of a filter with its form in a second line."""
    return name.replace(" (", "\n(") if len(name) > longest else name


def palette() -> Colormap:
    """Return the colours from better to worse."""
    import seaborn  # takes a second

    colours: Colormap = seaborn.color_palette(
        f"blend:{BLUE},#a9cde6,#fbfbfb,#f3b98f,{ORANGE}", as_cmap=True
    )
    return colours


def draw_heat_map(overview: Overview, size: Format) -> Figure:
    """Draw the ratio of each method to the reference of each world.

    Colour marks what is decided, a grey ground a filter that loses track, = equality within 5 %.
    """
    columns = list(overview.methods) if size.name else overview.columns
    names = [fold_name(overview.names[label]) for label in columns]
    groups = group_worlds(overview)
    foot = size.row * (1 if size.width > 600 else 2)
    with matplotlib.rc_context({**RC, "font.size": size.font, "axes.grid": False}):
        figure, panels = _lay_out(size, [(title, len(rows)) for title, rows in groups], foot)
        for axes, (_, worlds) in zip(panels, groups, strict=True):
            cells = [[describe_cell(overview, w, label) for label in columns] for w in worlds]
            _draw_cells(axes, cells, (palette(), _SCALE), size)
            axes.set_yticks(
                np.arange(len(worlds)) + 0.5, [_short(w.part_name.name, size) for w in worlds]
            )
            if not size.name:
                _name_references(axes, overview, worlds, size)
        if panels:
            _name_columns(panels[0], names, len(overview.methods), size)
        _draw_key(figure, size, foot)
    return figure


def draw_matrices(overview: Overview, size: Format) -> Figure:
    """Draw in how many worlds the method of a row is better and worse than that of a column, by group of worlds."""
    methods = overview.methods
    names = [fold_name(overview.names[method]) for method in methods]
    groups = group_worlds(overview)
    with matplotlib.rc_context({**RC, "font.size": size.font, "axes.grid": False}):
        rows = [(f"{title} ({len(worlds)})", len(methods)) for title, worlds in groups]
        figure, panels = _lay_out(size, rows, 8)
        for axes, (_, worlds) in zip(panels, groups, strict=True):
            wins = count_wins(overview.pairs, [world.key for world in worlds])
            counts = [[_describe_wins(wins, a, b) for b in methods] for a in methods]
            _draw_cells(axes, counts, (palette().reversed(), len(worlds)), size)
            axes.set_yticks(np.arange(len(methods)) + 0.5, names)
        if panels:
            _name_columns(panels[0], names, len(methods), size)
    return figure


def draw_doses(
    overviews: Mapping[int, Overview], worlds: Sequence[World], axis: str, size: Format
) -> Figure:
    """Draw the error of methods and conventional filters against the number of particles, or the time of a step.

    A panel is a world, at most three in a row. Points have the simultaneous intervals of the heat map; those of neighbours are moved apart.
    """
    first = next(iter(overviews.values()))
    columns = 1 if size.name else max(1, min(len(worlds), 3))
    rows = -(-len(worlds) // columns)
    shape = (size.width / _DPI, rows * (250 if size.name else 300) / _DPI)
    with matplotlib.rc_context({**RC, "font.size": size.font}):
        figure = Figure(figsize=shape, dpi=_DPI, layout="constrained")
        panels = np.ravel(figure.subplots(rows, columns, squeeze=False))
        for empty in panels[len(worlds) :]:
            empty.remove()
        for axes, world in zip(panels, worlds, strict=False):
            for label in first.columns:
                _draw_dose(axes, dose_points(overviews, world, label, axis), label, first)
            axes.set(xscale="log", yscale="log", title=world.part_name.name)
            axes.set_xlabel(
                "number of particles" if axis == "particles" else "time of a step of a run [ms]"
            )
            lines = [np.asarray(line.get_xydata()) for line in axes.lines]
            points = np.concatenate([*lines, np.ones((1, 2))])
            set_plain_ticks(axes.xaxis, points[:-1, 0])
            set_plain_ticks(axes.yaxis, points[:, 1])
            axes.axhline(1.0, color=INK, lw=1.2)
        if worlds:
            figure.axes[0].set_ylabel("error / best Kalman filter")
            side: Any = (
                {"loc": "outside lower center", "ncols": 2}
                if size.name
                else {"loc": "outside right center"}
            )
            figure.legend(*figure.axes[0].get_legend_handles_labels(), **side)
    return figure


def dose_points(
    overviews: Mapping[int, Overview], world: World, label: str, axis: str
) -> list[tuple[float, Verdict]]:
    """List the verdicts with a ratio on a filter in a world, with their positions on the axis."""
    return [
        (float(level) if axis == "particles" else overview.times[world.key, label], cell.verdict)
        for level, overview in overviews.items()
        if (cell := overview.find(world, label))
        and cell.verdict.ratio > 0
        and (axis == "particles" or np.isfinite(overview.times[world.key, label]))
    ]


def _draw_dose(
    axes: Axes, points: Sequence[tuple[float, Verdict]], label: str, first: Overview
) -> None:
    """Draw the line of one filter, a proposed one solid."""
    if not points:
        return
    style = line_styles([label])[label]
    offset = first.columns.index(label) - len(first.methods) / 2
    x = np.array([x for x, _ in points]) * (1 + 0.03 * offset)
    y = np.array([verdict.ratio for _, verdict in points])
    ends = np.clip([[v.low, v.high] for _, v in points], y.min() / 10, y.max() * 10)
    axes.plot(x, y, **style.line(first.names[label]), **style.mark(), ms=4)
    axes.vlines(x, ends[:, 0], ends[:, 1], color=style.colour, alpha=0.35, lw=1)


def group_worlds(overview: Overview) -> list[tuple[str, list[World]]]:
    """Return the worlds by title: those that Kalman filters fit, those that they do not fit, and others."""
    groups = [(GROUPS[k], [w for w in overview.worlds if w.facts.kalman_fits is k]) for k in GROUPS]
    return [(title, worlds) for title, worlds in groups if worlds]


def _lay_out(
    size: Format, groups: Sequence[tuple[str, int]], foot: int
) -> tuple[Figure, list[Axes]]:
    """Return a figure with titles and axes of groups of rows, one below the other."""
    gap = _gap(size)
    height = size.top + sum(gap + rows * size.row for _, rows in groups) + foot
    figure = Figure(figsize=(size.width / _DPI, height / _DPI), dpi=_DPI)
    across, y, panels = size.width - size.label_width - size.note_width, size.top, []
    for title, rows in groups:
        middle = 1 - (y + 0.55 * gap) / height
        figure.text(4 / size.width, middle, title, color="#555555", weight="bold", va="center")
        y += gap + rows * size.row
        box = (
            size.label_width / size.width,
            1 - y / height,
            across / size.width,
            rows * size.row / height,
        )
        panels.append(figure.add_axes(box))
    return figure, panels


def _gap(size: Format) -> int:
    """Return the height of the title of a group of rows."""
    return round(0.85 * size.row)


def _draw_cells(
    axes: Axes,
    cells: Sequence[Sequence[CellLook]],
    colours: tuple[Colormap, float],
    size: Format,
) -> None:
    """Draw cells without axes: colours of their values up to a scale, and their texts; one without a text stays empty."""
    import seaborn

    palette, scale = colours
    values = np.array([[cell.value for cell in row] for row in cells])
    seaborn.heatmap(
        values, ax=axes, cmap=palette, vmin=-scale, vmax=scale, cbar=False, linewidths=1.2, linecolor="white",
        mask=np.isnan(values), xticklabels=False, yticklabels=False,
    )  # fmt: skip
    axes.set_facecolor("#ececec")
    axes.set(xlabel="", ylabel="")
    axes.tick_params(length=0, pad=3)
    grounds = palette(Normalize(-scale, scale)(values))
    for i, row in enumerate(cells):
        for j, cell in enumerate(row):
            if cell.text:
                _write_cell(axes, cell, (i, j), grounds[i, j], size)


def to_svg(figure: Figure) -> str:
    """Return a figure as SVG, equal for equal figures."""
    buffer = io.StringIO()
    with matplotlib.rc_context(RC):
        figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


class CellLook(NamedTuple):
    """Text, log ratio of the colour (NaN for none), and look of a cell."""

    text: str
    value: float = math.nan
    is_grey: bool = False
    is_strong: bool = False


def describe_cell(overview: Overview, world: World, label: str) -> CellLook:
    """Return how a cell is drawn."""
    cell = overview.find(world, label)
    if cell is None:
        return CellLook("1" if world.reference == label else "–")
    word, ratio, share = cell.verdict.word, cell.verdict.ratio, f"{100 * cell.track_share:.0f} %"
    if cell.loses_track:
        return CellLook(share, is_grey=True)
    if word in EQUAL_WORDS:
        return CellLook("=")
    has_ratio = ratio > 0  # else too many runs are lost, and the share that keeps track is drawn
    text = (format_ratio(ratio) if has_ratio else share) + "☆" * bool(cell.wins)
    if word == "not decided":
        return CellLook(text)
    value = math.log(ratio) if has_ratio else _SCALE * (1 if word == "worse" else -1)
    return CellLook(text, value, is_strong=word == "better")


def format_ratio(value: float) -> str:
    """Format a ratio of errors in few letters."""
    if value >= 9.95:
        return f"{value:.0f}"
    return f"{value:.2f}" if value < 1.995 else f"{value:.1f}"


def _write_cell(
    axes: Axes, cell: CellLook, index: tuple[int, int], ground: np.ndarray, size: Format
) -> None:
    """Write the text of a cell in a row and a column, and draw one without a colour."""
    i, j = index
    ink = choose_ink(ground)
    if math.isnan(cell.value):
        ink, face = ("#444444", GREY) if cell.is_grey else ("#6a6a6a", "white")
        axes.add_patch(Rectangle((j + 0.03, i + 0.04), 0.94, 0.92, fc=face, ec="#dcdcdc", lw=0.6))
    axes.text(
        j + 0.5, i + 0.5, cell.text, ha="center", va="center", color=ink, fontsize=size.font,
        weight="bold" if cell.is_strong else "normal", style="italic" if cell.is_grey else "normal",
    )  # fmt: skip


def choose_ink(ground: Sequence[float] | np.ndarray) -> str:
    """Return white or black, whichever has the larger contrast on a ground: at least 4.5 (WCAG)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in ground[:3]]
    luminance = float(np.dot((0.2126, 0.7152, 0.0722), linear))
    return "white" if 1.05 / (luminance + 0.05) > (luminance + 0.05) / 0.05 else "#000000"


def _describe_wins(wins: Mapping[Pair, int], a: str, b: str) -> CellLook:
    """Return how a cell of a matrix is drawn, with wins and losses of a method."""
    if a == b:
        return CellLook("")
    some = (wins[a, b], wins[b, a])
    return CellLook("{}–{}".format(*some) if any(some) else "·", some[0] - some[1])


def _name_columns(axes: Axes, names: Sequence[str], methods: int, size: Format) -> None:
    """Write the names of columns above the axes and their title, those of the methods in bold."""
    y = -0.12 - _gap(size) / size.row
    for j, name in enumerate(names):
        axes.text(
            j + 0.4, y, name, rotation=42, rotation_mode="anchor", ha="left", va="bottom", fontsize=size.font,
            color=INK if j < methods else "#555555", weight="bold" if j < methods < len(names) else "normal",
        )  # fmt: skip


def _name_references(axes: Axes, overview: Overview, worlds: Sequence[World], size: Format) -> None:
    """Write the reference of each world and its error at the right of the row."""
    x, font = len(overview.columns) + 0.2, 0.9 * size.font
    for i, world in enumerate(worlds):
        text = f"1 = {format_reference(overview, world)}"
        axes.text(x, i + 0.5, text, va="center", fontsize=font, color="#555555")


def format_reference(overview: Overview, world: World) -> str:
    """Format the reference of a world with its error."""
    return f"{overview.names[world.reference]}, {format_reference_error(world.level, world.part_name.unit)}"


def format_reference_error(value: float | None, unit: str) -> str:
    """Format an error with its unit; a dash without one."""
    if value is None:
        return "–"
    if unit == "m" and value >= 1000:
        return f"{value / 1000:.1f} km"
    return f"{value:.0f} {unit}".strip() if value >= 10 else f"{value:.2g} {unit}".strip()


def _draw_key(figure: Figure, size: Format, foot: int) -> None:
    """Draw the key of the colours below the map."""
    height = figure.get_size_inches()[1] * _DPI
    in_row = 4 if size.width > 600 else 2
    side = 0.36 * size.row
    for k, (colour, text) in enumerate(_KEY):
        x = 6 + (k % in_row) * (size.width - 12) / in_row
        y = foot - 6 - (k // in_row) * 0.62 * size.row
        figure.add_artist(Rectangle(
            (x / size.width, (y - side) / height), side / size.width, side / height,
            fc=colour, ec="#999999", lw=0.6, transform=figure.transFigure,
        ))  # fmt: skip
        position = ((x + side + 5) / size.width, (y - side / 2) / height)
        figure.text(*position, text, va="center", fontsize=0.9 * size.font, color="#444444")


def _short(name: str, size: Format) -> str:
    """Break a long name of a world into two lines where the figure is narrow."""
    limit = 34 if size.width > 600 else 17
    space = name.rfind(" ", 0, limit + 1) if len(name) > limit else 0
    return f"{name[:space]}\n{name[space + 1 :]}" if space > 0 else name
