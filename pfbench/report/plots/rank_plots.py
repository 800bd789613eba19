"""Figures of rankings across conditions: mean ranks and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
import scikit_posthocs as posthocs
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


def plot_critical_difference(one: RankingResult, style: Mapping[str, LineStyle]) -> Figure:
    """Plot mean ranks, with bars over inconclusive pairs [Demsar 2006, figure 1].

    Args:
        one: Ranking.
        style: Line styles by label.
    """
    k = len(one.filters)
    half = -(-k // 2)
    names = {label: wrap_label(label) for label in one.filters}
    apart = 0.17 + 0.08 * max(name.count("\n") for name in names.values())
    figure = Figure(
        figsize=(COLUMN, 0.85 + apart * (half + _bars(one))), layout=build_padded_layout()
    )
    axis = figure.subplots()
    # Without a significant omnibus test, all pairs are inconclusive.
    p = np.ones((k, k))
    for pair in one.pairs:
        i, j = one.filters.index(pair.a), one.filters.index(pair.b)
        p[i, j] = p[j, i] = pair.p_nemenyi if one.p_f <= one.alpha else 1.0
    axis.set_xlim(1, k)
    posthocs.critical_difference_diagram(
        dict(zip(one.filters, one.ranks, strict=True)),
        pd.DataFrame(p, index=one.filters, columns=one.filters),
        ax=axis, alpha=one.alpha, text_h_margin=0.1,
        label_props={"fontsize": 7 if k <= MANY_RANKS else SMALL},
        color_palette={label: style[label].colour for label in one.filters},
        marker_props={"s": 14, "zorder": 4}, elbow_props={"linewidth": 0.9},
        crossbar_props={"linewidth": 2.2, "color": "0.25", "marker": "|"},
        label_fmt_left="{label} {rank:.2f} ", label_fmt_right=" {rank:.2f} {label}",
    )  # fmt: skip
    for text in axis.texts:  # light colours suit lines, not text
        text.set(color="black", linespacing=1.0)
        for label, name in names.items():
            if label in text.get_text().split():
                text.set_text(text.get_text().replace(label, name.replace("\n", "\n ")))
    for mark in (*axis.collections, *axis.lines):  # the first and the last are on the edge
        mark.set_clip_on(False)
    axis.spines["top"].set(visible=True, bounds=(1, k))
    axis.set_xlim(1, max(k, 1 + one.critical))
    axis.set_xticks(range(1, k + 1) if k <= MANY_RANKS else [1, *range(5, k + 1, 5)])
    axis.plot(
        [1, 1 + one.critical], [1.9, 1.9], color="0.25", lw=1.2, marker="|", ms=4, clip_on=False
    )
    axis.text(
        1 + one.critical / 2, 2.1, f"CD {one.critical:.2f}", ha="center", va="bottom", fontsize=7
    )
    axis.grid(False)
    return figure


def plot_profiles(sources: RankingBlocks, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the percentage of runs within a factor of the best filter.

    Args:
        sources: Blocks of a ranking.
        style: Line styles by label.
    """
    reach = float(np.clip(max(_worst(own) for own in sources.runs), 1.1, 100.0))
    at = np.geomspace(1.0, reach, 200)
    figure, (axis,) = stacked_axes(1, 2.1)
    for label, share in zip(
        sources.filters, condition_blocks.performance_profile(sources, at), strict=True
    ):
        axis.plot(at, 100 * share, **style[label].line(label))
    axis.set(xscale="log", xlabel="RMSE / best RMSE of the run", ylabel="runs [%]", ylim=(0, 102))
    set_plain_ticks(axis.xaxis, at)
    add_legend(figure, axis)
    return figure


def _bars(one: RankingResult) -> int:
    """Count the bars of the diagram at most."""
    order = sorted(range(len(one.ranks)), key=lambda i: one.ranks[i])
    rank = [one.ranks[i] for i in order]
    alike = one.p_f > one.alpha
    ends = [
        max(j for j in range(i, len(rank)) if alike or rank[j] - rank[i] < one.critical)
        for i in range(len(rank))
    ]
    return len({end for i, end in enumerate(ends) if end > i})


def _worst(own: np.ndarray) -> float:
    """Return the largest finite ratio to the best filter of a run."""
    best = own.min(axis=1, keepdims=True)
    finite_mask = np.isfinite(own) & (best > 0)
    return float(np.divide(own, best, out=np.ones(own.shape), where=finite_mask).max())
