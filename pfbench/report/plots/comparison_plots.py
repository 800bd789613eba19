"""Plots of comparisons: RMSE ratios of pairs, decisions and performance profiles across conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.label_placement import name_pairs, wrap_label
from pfbench.report.plots.plotting import (
    COLUMN,
    LETTER,
    SMALL,
    LineStyle,
    add_legend,
    build_padded_layout,
    stacked_axes,
)
from pfbench.results.comparison.condition_blocks import RankingBlocks, performance_profile
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest

MATRIX_FILTERS = 10  # filters of a matrix at most
_BETTER, _WORSE = "#0072B2", "#E69F00"  # dark and light, distinct in grey


def plot_matrix(tests: Sequence[PairwiseTest], required_labels: Sequence[str] = ()) -> Figure:
    """Plot the numbers of conditions in which row filters are better and worse.

    Args:
        tests: Pairwise tests of a group.
        required_labels: Filters that are always included; the best others fill the matrix.
    """
    labels = _select_labels(order_by_decisions(tests), required_labels)
    wins, counts = _count_wins(tests, labels)
    names = list(map(wrap_label, labels))
    row_height = max(0.27, 0.11 * (1 + max(name.count("\n") for name in names)))
    height = max(COLUMN - 0.25, 1.0 + row_height * len(labels))
    figure = Figure(figsize=(COLUMN, height), layout=build_padded_layout())
    axis = figure.subplots()
    share = np.divide(wins - wins.T, counts, out=np.full(counts.shape, np.nan), where=counts > 0)
    axis.imshow(share, cmap=_blue_and_orange(), vmin=-1, vmax=1, aspect="auto")
    label_width = LETTER * max(len(line) for name in names for line in name.split("\n"))
    dash = _choose_dash(wins, counts, (72 * COLUMN - 20 - label_width) / len(labels))
    font: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "linespacing": 1.0}
    for i, j in zip(*np.nonzero(counts), strict=True):
        ink = "white" if share[i, j] > 0.55 else "black"
        axis.text(j, i, f"{wins[i, j]}{dash}{wins[j, i]}", color=ink, **font)
    ticks: Any = {"labels": names, "fontsize": SMALL, "linespacing": 1.0}
    axis.set_xticks(range(len(labels)), rotation=40, ha="right", rotation_mode="anchor", **ticks)
    axis.set_yticks(range(len(labels)), **ticks)
    # Below the figure, since the text may be wider than the panel.
    figure.supxlabel(f"better – worse, of {counts.max()} conditions", fontsize=8)
    axis.grid(False)
    axis.tick_params(length=0)
    return figure


def _select_labels(ranked: Sequence[str], required: Sequence[str]) -> list[str]:
    """Select the required labels and the best others, up to the size of a matrix."""
    others = [label for label in ranked if label not in required]
    selection = {*required, *others[: MATRIX_FILTERS - len(required)]}
    return [label for label in ranked if label in selection]


def _count_wins(
    tests: Sequence[PairwiseTest], labels: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Count the conditions in which row filters win, and in which both were compared, [K, K]."""
    wins, counts = np.zeros((2, len(labels), len(labels)), dtype=int)
    for v in tests:
        if v.a in labels and v.b in labels:
            i, j = labels.index(v.a), labels.index(v.b)
            counts[i, j] += 1
            counts[j, i] += 1
            wins[i, j] += v.winner == v.a
            wins[j, i] += v.winner == v.b
    return wins, counts


def _choose_dash(wins: np.ndarray, counts: np.ndarray, width: float) -> str:
    """Return the dash between two numbers, with a line break in squares too narrow for both."""
    compared = counts > 0
    texts = [f"{a}–{b}" for a, b in zip(wins[compared], wins.T[compared], strict=True)]
    longest = max(map(len, texts)) if texts else 0
    return "–\n" if LETTER * longest > width - 1 else "–"


def plot_forest(pairs: Sequence[PairwiseTest]) -> Figure:
    """Plot the RMSE ratio and its interval, a row per pair."""
    names = name_pairs([(v.a, v.b) for v in pairs])
    figure = Figure(
        figsize=(COLUMN, 0.75 + 0.17 * sum(1 + name.count("\n") for name in names)),
        layout=build_padded_layout(),
    )
    axis = figure.subplots()
    ends = [x for v in pairs for x in (v.low, v.ratio, v.high) if np.isfinite(x) and x > 0]
    low, high = min([*ends, 1 / (1 + pairs[0].margin)]), max([*ends, 1 + pairs[0].margin])
    edges = low / (high / low) ** 0.06, high * (high / low) ** 0.06
    axis.axvspan(1 / (1 + pairs[0].margin), 1 + pairs[0].margin, color="0.88", lw=0, zorder=0)
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    for row, v in enumerate(pairs):
        is_decided = v.winner != INCONCLUSIVE
        colour = "0.35" if not is_decided else _BETTER if v.winner == v.a else "#B35900"
        # Limits decided by lost runs are infinite: the line ends at the edge.
        start, end = (float(np.clip(x, *edges)) for x in (v.low, v.high))
        axis.plot([start, end], [row, row], color=colour, lw=1.1, zorder=2)
        axis.plot(
            float(np.clip(v.ratio, *edges)), row, ls="none", marker="s" if v.equivalent else "o", ms=4, mec=colour,
            mfc=colour if is_decided else "white", mew=0.9, zorder=3,
        )  # fmt: skip
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set_ylim(len(pairs) - 0.4, -0.6)
    axis.set(xscale="log", xlim=edges, xlabel="RMSE ratio")
    set_plain_ticks(axis.xaxis, [low, high])
    if high < 3 * low:
        axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.grid(False, axis="y")
    return figure


def order_by_decisions(tests: Sequence[PairwiseTest]) -> list[str]:
    """Order labels by better minus worse comparisons, most first.

    Args:
        tests: Pairwise tests of a group.
    """
    decided = [v for v in tests if v.winner != INCONCLUSIVE]
    labels = dict.fromkeys(label for v in tests for label in (v.a, v.b))
    losses = {label: sum(label in (v.a, v.b) for v in decided) for label in labels}
    losses = {label: n - 2 * sum(v.winner == label for v in tests) for label, n in losses.items()}
    return sorted(labels, key=losses.__getitem__)


def _blue_and_orange() -> Any:
    """Return the colour map from worse to better."""
    return LinearSegmentedColormap.from_list("better", [_WORSE, "#ffffff", _BETTER])


def plot_profiles(blocks: RankingBlocks, style: Mapping[str, LineStyle]) -> Figure:
    """Plot the percentage of runs within a factor of the best filter.

    Args:
        blocks: Runs of the conditions.
        style: Line styles by label.
    """
    reach = float(np.clip(max(_worst_ratio(errors) for errors in blocks.runs), 1.1, 100.0))
    at = np.geomspace(1.0, reach, 200)
    figure, (axis,) = stacked_axes(1, 2.1)
    for label, share in zip(blocks.filters, performance_profile(blocks, at), strict=True):
        axis.plot(at, 100 * share, **style[label].line(label))
    axis.set(xscale="log", xlabel="RMSE / best RMSE of the run", ylabel="runs [%]", ylim=(0, 102))
    set_plain_ticks(axis.xaxis, at)
    add_legend(figure, axis)
    return figure


def _worst_ratio(errors: np.ndarray) -> float:
    """Return the largest finite ratio to the best filter of a run."""
    best = errors.min(axis=1, keepdims=True)
    finite_mask = np.isfinite(errors) & (best > 0)
    return float(np.divide(errors, best, out=np.ones(errors.shape), where=finite_mask).max())
