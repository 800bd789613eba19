"""Figures of rankings across conditions: mean ranks and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import scikit_posthocs as posthocs
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.label_placement import wrap_label
from pfbench.report.plots.plotting import (
    COLUMN,
    SMALL,
    LineStyle,
    add_legend,
    build_padded_layout,
    stacked_axes,
)
from pfbench.results.comparison import condition_blocks
from pfbench.results.comparison.condition_blocks import RankingBlocks
from pfbench.results.comparison.ranking_results import RankingResult

MANY_RANKS = 12  # filters up to which each rank has a tick


def plot_critical_difference(ranking: RankingResult, style: Mapping[str, LineStyle]) -> Figure:
    """Plot mean ranks, with bars over inconclusive pairs [Demsar 2006, figure 1].

    Args:
        ranking: Ranking.
        style: Line styles by label.
    """
    k = len(ranking.filters)
    names = {label: wrap_label(label) for label in ranking.filters}
    line_height = 0.17 + 0.08 * max(name.count("\n") for name in names.values())
    height = 0.85 + line_height * (-(-k // 2) + _count_bars(ranking))
    figure = Figure(figsize=(COLUMN, height), layout=build_padded_layout())
    axis = figure.subplots()
    axis.set_xlim(1, k)
    posthocs.critical_difference_diagram(
        dict(zip(ranking.filters, ranking.ranks, strict=True)),
        pd.DataFrame(_p_matrix(ranking), index=ranking.filters, columns=ranking.filters),
        ax=axis, alpha=ranking.alpha, text_h_margin=0.1,
        label_props={"fontsize": 7 if k <= MANY_RANKS else SMALL},
        color_palette={label: style[label].colour for label in ranking.filters},
        marker_props={"s": 14, "zorder": 4}, elbow_props={"linewidth": 0.9},
        crossbar_props={"linewidth": 2.2, "color": "0.25", "marker": "|"},
        label_fmt_left="{label} {rank:.2f} ", label_fmt_right=" {rank:.2f} {label}",
    )  # fmt: skip
    _wrap_texts(axis, names)
    for mark in (*axis.collections, *axis.lines):  # the first and the last are on the edge
        mark.set_clip_on(False)
    axis.spines["top"].set(visible=True, bounds=(1, k))
    axis.set_xlim(1, max(k, 1 + ranking.critical))
    axis.set_xticks(range(1, k + 1) if k <= MANY_RANKS else [1, *range(5, k + 1, 5)])
    bar: Any = {"color": "0.25", "lw": 1.2, "marker": "|", "ms": 4, "clip_on": False}
    axis.plot([1, 1 + ranking.critical], [1.9, 1.9], **bar)
    font: Any = {"ha": "center", "va": "bottom", "fontsize": 7}
    axis.text(1 + ranking.critical / 2, 2.1, f"CD {ranking.critical:.2f}", **font)
    axis.grid(False)
    return figure


def _p_matrix(ranking: RankingResult) -> np.ndarray:
    """Return Nemenyi's p of all pairs, 1 for all without a significant omnibus test, [K, K]."""
    p = np.ones((len(ranking.filters),) * 2)
    if ranking.p_f <= ranking.alpha:
        for pair in ranking.pairs:
            i, j = ranking.filters.index(pair.a), ranking.filters.index(pair.b)
            p[i, j] = p[j, i] = pair.p_nemenyi
    return p


def _wrap_texts(axis: Axes, names: Mapping[str, str]) -> None:
    """Replace labels by names of several lines, in black, since light colours suit lines only."""
    for text in axis.texts:
        text.set(color="black", linespacing=1.0)
        for label, name in names.items():
            if label in text.get_text().split():
                text.set_text(text.get_text().replace(label, name.replace("\n", "\n ")))


def plot_profiles(blocks: RankingBlocks, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the percentage of runs within a factor of the best filter.

    Args:
        blocks: Blocks of a ranking.
        style: Line styles by label.
    """
    reach = float(np.clip(max(_worst_ratio(errors) for errors in blocks.runs), 1.1, 100.0))
    at = np.geomspace(1.0, reach, 200)
    figure, (axis,) = stacked_axes(1, 2.1)
    for label, share in zip(
        blocks.filters, condition_blocks.performance_profile(blocks, at), strict=True
    ):
        axis.plot(at, 100 * share, **style[label].line(label))
    axis.set(xscale="log", xlabel="RMSE / best RMSE of the run", ylabel="runs [%]", ylim=(0, 102))
    set_plain_ticks(axis.xaxis, at)
    add_legend(figure, axis)
    return figure


def _count_bars(ranking: RankingResult) -> int:
    """Count the bars of the diagram at most."""
    rank = sorted(ranking.ranks)
    is_flat = ranking.p_f > ranking.alpha
    ends = [
        max(j for j in range(i, len(rank)) if is_flat or rank[j] - rank[i] < ranking.critical)
        for i in range(len(rank))
    ]
    return len({end for i, end in enumerate(ends) if end > i})


def _worst_ratio(errors: np.ndarray) -> float:
    """Return the largest finite ratio to the best filter of a run."""
    best = errors.min(axis=1, keepdims=True)
    finite_mask = np.isfinite(errors) & (best > 0)
    return float(np.divide(errors, best, out=np.ones(errors.shape), where=finite_mask).max())
