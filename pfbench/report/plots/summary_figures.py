"""Figures of the summary: RMSE of all filters in all conditions, and proposed methods against baselines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure

from pfbench.report.baselines import BaselineComparison
from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.label_placement import wrap_label
from pfbench.report.plots.plotting import COLUMN, SHADES, SMALL, build_padded_layout, format_slug
from pfbench.results.comparison.condition_blocks import RankingBlocks
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE
from pfbench.results.comparison.ranking_results import RankingResult

_BETTER, _WORSE, _OPEN = "#0072B2", "#E69F00", "0.72"  # dark, light and a ring, distinct in grey
_STEPS = (1.05, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)  # limits between the shades of the map
_MAP_WIDTH = 170  # points of a column without the longest names
_WIDE = 60  # conditions of the map at most
_HELD = 28  # conditions that fit one column of print; the map is wider with more


def summary_figures(
    ranking: RankingResult,
    source: RankingBlocks,
    pairs: Sequence[BaselineComparison],
    alpha: float,
    quantity: str,
) -> list[FigureSpec]:
    """List the figures of the summary that the data allow.

    Args:
        ranking: Ranking of the main groups.
        source: Blocks of the ranking.
        pairs: Proposed methods against baselines.
        alpha: Level of the tests.
        quantity: Compared quantity, as text.
    """
    figures = []
    if pairs:
        text = (
            f"Proposed methods against the baselines of their papers: ratio of the median RMSE of {quantity}, a dot for each of "
            f"{len(source.cells)} conditions. Blue: better, orange: worse (Holm within the condition), ring: inconclusive. "
            "Arrows are outside the axis, also if lost runs decide. Bars: median over conditions, thick if Wilcoxon's test "
            f"across conditions is significant (alpha {alpha:g}, Holm over {len(pairs)} pairs)."
        )
        figures.append(
            FigureSpec(
                f"proposed_{format_slug(ranking.group)}", text, partial(plot_baseline_ratios, pairs)
            )
        )
    if len(source.filters) > 2 and 2 < len(source.cells) <= _WIDE:
        text = (
            f"Median RMSE of each filter / best median RMSE of the condition, for {quantity}. Darker is worse. Cross: at least "
            f"half of the runs lost. Filters are ordered by {'mean rank' if ranking.ranks else 'the median of these ratios'}."
        )
        figures.append(
            FigureSpec(
                f"map_{format_slug(ranking.group)}", text, partial(plot_ratio_map, ranking, source)
            )
        )
    return figures


def plot_baseline_ratios(pairs: Sequence[BaselineComparison]) -> Figure:
    """Plot the RMSE ratios, a row per pair and a dot per condition."""
    figure = Figure(figsize=(COLUMN, 0.7 + 0.21 * len(pairs)), layout=build_padded_layout())
    axis = figure.subplots()
    ends = np.array([r for pair in pairs for r in pair.ratios if np.isfinite(r) and r > 0])
    low, high = float(np.quantile(ends, 0.01)), float(np.quantile(ends, 0.99))
    low, high = min(low / 1.1, 0.8), max(1.1 * high, 1.25)
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    for row, pair in enumerate(pairs):
        _plot_pair(axis, row, pair, (low, high))
    names = [f"{pair.method} / {pair.baseline}" for pair in pairs]
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set_ylim(len(pairs) - 0.4, -0.6)
    for row in range(1, len(pairs)):
        if pairs[row].method != pairs[row - 1].method:
            axis.axhline(row - 0.5, color="0.8", lw=0.6, zorder=0)
    axis.set(xscale="log", xlim=(low, high))
    figure.supxlabel("RMSE / RMSE of the baseline", fontsize=8)  # may be wider than the panel
    set_plain_ticks(axis.xaxis, [low, high])
    axis.grid(False, axis="y")
    return figure


def _plot_pair(axis: Axes, row: int, pair: BaselineComparison, limits: tuple[float, float]) -> None:
    """Plot the ratio of a pair in each condition, and the median as a bar."""
    low, high = limits
    dot: Any = {"ls": "none", "ms": 2.6, "mew": 0.6, "zorder": 2, "clip_on": False}
    for k, (ratio, winner) in enumerate(zip(pair.ratios, pair.decisions, strict=True)):
        is_open = winner == INCONCLUSIVE
        colour = _OPEN if is_open else _BETTER if winner == pair.method else _WORSE
        face: Any = {"mfc": "white", "mec": "0.55"} if is_open else {"mfc": colour, "mec": colour}
        marker = "<" if ratio < low else ">" if ratio > high else "o"
        y = row + 0.3 * ((k * 0.6180339887) % 1 - 0.5)
        axis.plot(float(np.clip(ratio, low, high)), y, marker=marker, **face, **dot)
    width = 0.9 if pair.winner == INCONCLUSIVE else 2.4
    x = float(np.clip(pair.ratio, low, high))
    axis.plot([x, x], [row - 0.38, row + 0.38], color="black", lw=width, zorder=3)


def plot_ratio_map(ranking: RankingResult, source: RankingBlocks) -> Figure:
    """Plot filters by conditions, shaded by the ratio to the best RMSE of the condition.

    Args:
        ranking: Ranking of the main groups.
        source: Blocks of the ranking.
    """
    with np.errstate(invalid="ignore"):
        ratio = np.exp(source.values - np.min(source.values, axis=1, keepdims=True))
    ratio = np.where(np.isfinite(source.values), ratio, np.inf)
    by = ranking.ranks or np.median(ratio, axis=0)
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
