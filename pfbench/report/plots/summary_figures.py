"""Figure of the summary: RMSE of all filters in all conditions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure

from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.label_placement import wrap_label
from pfbench.report.plots.plotting import COLUMN, SHADES, SMALL, build_padded_layout, format_slug
from pfbench.results.comparison.condition_blocks import RankingBlocks

_STEPS = (1.05, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)  # limits between the shades of the map
_MAP_WIDTH = 170  # points of a column without the longest names
_WIDE = 60  # conditions of the map at most
_HELD = 28  # conditions that fit one column of print; the map is wider with more


def summary_figures(source: RankingBlocks, quantity: str) -> list[FigureSpec]:
    """List the figures of the summary that the data allow.

    Args:
        source: Median errors of the conditions.
        quantity: Compared quantity, as text.

    Returns:
        The map of filters and conditions, if there are several.
    """
    if len(source.filters) < 3 or not 2 < len(source.cells) <= _WIDE:
        return []
    text = (
        f"Median RMSE of each filter / best median RMSE of the condition, for {quantity}. Darker is worse. Cross: at least "
        "half of the runs lost. Filters are ordered by the median of these ratios."
    )
    name = f"map_{format_slug(source.group)}"
    return [FigureSpec(name, text, partial(plot_ratio_map, source))]


def plot_ratio_map(source: RankingBlocks) -> Figure:
    """Plot filters by conditions, shaded by the ratio to the best RMSE of the condition.

    Args:
        source: Median errors of the conditions.
    """
    with np.errstate(invalid="ignore"):
        ratio = np.exp(source.values - np.min(source.values, axis=1, keepdims=True))
    ratio = np.where(np.isfinite(source.values), ratio, np.inf)
    by = np.median(ratio, axis=0)
    order = sorted(range(len(source.filters)), key=lambda i: (by[i], source.filters[i]))
    ordered = ratio[:, order].T
    wide = COLUMN + max(0, len(source.cells) - _HELD) * SMALL / 72
    names = [wrap_label(source.filters[i]) for i in order]
    lines = max(
        1 + (a.count("\n") + b.count("\n")) / 2 for a, b in pairwise(names)
    )  # neighbouring names must not touch
    figure = Figure(
        figsize=(wide, 1.35 + 0.018 * SMALL * lines * len(order)), layout=build_padded_layout()
    )
    axis = figure.subplots()
    shades = to_rgba_array(SHADES)
    image = shades[
        np.searchsorted(_STEPS, np.where(np.isfinite(ordered), ordered, 1.0), side="right")
    ]
    image[~np.isfinite(ordered)] = (1, 1, 1, 1)
    axis.imshow(image, aspect="auto", interpolation="nearest")
    rows, columns = np.nonzero(~np.isfinite(ordered))
    axis.plot(columns, rows, ls="none", marker="x", ms=2.5, color="0.4", mew=0.6)
    axis.set_yticks(range(len(order)), names, fontsize=SMALL, linespacing=1.0)
    _label_columns(axis, source.cells)
    axis.grid(False)
    axis.tick_params(length=0)
    for edge, shade in zip((1.0, *_STEPS), shades, strict=True):
        axis.plot([], [], ls="none", marker="s", color=shade, label=f"{edge:g}")
    figure.legend(
        loc="outside lower center", ncols=8, fontsize=SMALL, handletextpad=0.1, columnspacing=0.7, title_fontsize=SMALL,
        title="ratio to the best, from",
    )  # fmt: skip
    return figure


def _label_columns(axis: Any, cells: Sequence[str]) -> None:
    """Label scenarios above and noise regimes below the columns, with lines between scenarios."""
    positions, names, start = [], [], 0
    for scenario, group in groupby(cells, key=lambda cell: cell.split(" / ")[0]):
        width = len(list(group))
        positions.append(start + (width - 1) / 2)
        names.append(scenario)
        start += width
        if start < len(cells):
            axis.axvline(start - 0.5, color="white", lw=1.6)
    axis.set_xticks(
        range(len(cells)), [cell.split(" / ")[1] for cell in cells], rotation=90, fontsize=SMALL
    )
    above = axis.secondary_xaxis("top")
    distance = (
        min((b - a for a, b in pairwise(positions)), default=len(cells))
        * _MAP_WIDTH
        / max(len(cells), _HELD)
    )
    turned = max(
        25.0, np.degrees(np.arcsin(min(1.0, 1.2 * SMALL / distance)))
    )  # room for adjacent lines of text
    above.set_xticks(
        positions, names, fontsize=SMALL, rotation=turned, ha="left", rotation_mode="anchor"
    )
    above.tick_params(length=0)
    above.spines["top"].set_visible(False)
