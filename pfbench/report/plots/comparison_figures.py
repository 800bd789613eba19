"""Figures of comparisons: effects within a condition, ranks and decisions across conditions, Pareto fronts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pfbench.report.cost import ParetoFront
from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.condition_figures import FigureSpec
from pfbench.report.plots.cost_plots import plot_pareto_fronts
from pfbench.report.plots.label_placement import break_settings, wrap_label
from pfbench.report.plots.plotting import (
    COLUMN,
    LETTER,
    SMALL,
    LineStyle,
    build_padded_layout,
    format_slug,
)
from pfbench.report.plots.rank_plots import plot_critical_difference, plot_profiles
from pfbench.results.comparison.condition_blocks import RankingBlocks
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.ranking_results import RankingResult

_PAIRS = 28  # pairs of a forest plot at most
_LONG = 34  # letters of a pair on one line
MATRIX_FILTERS = 10  # filters of a matrix at most
_BETTER, _WORSE = "#0072B2", "#E69F00"  # dark and light, distinct in grey


def comparison_figures_of_condition(
    tests: Sequence[PairwiseTest],
    fronts: Sequence[ParetoFront],
    style: Mapping[str, LineStyle],
    note: str = "",
) -> list[FigureSpec]:
    """List the figures of a condition: the Pareto front, and a forest plot per group.

    Args:
        own: Pairwise tests of the condition.
        fronts: Accuracy and time by group.
        style: Line styles by label.
        note: Sentence about grey filters for captions.
    """
    figures = []
    shown = [front for front in fronts if np.isfinite(front.rmse).any()]
    if shown:
        text = (
            "Time per step and median over runs of the RMSE, where a lost run counts as infinite. Ringed and joined: the Pareto "
            f"front, on which no other filter is both faster and more accurate.{note}"
        )
        figures.append(FigureSpec("front", text, partial(plot_pareto_fronts, shown, style)))
    for group in dict.fromkeys(v.group for v in tests):
        pairs = [v for v in tests if v.group == group]
        if 0 < len(pairs) <= _PAIRS:
            level = f"{100 * pairs[0].level:g}"
            text = (
                f"RMSE of {group}, first filter divided by second filter (below 1 the first is better): median over runs and "
                f"{level} % interval. Filled: significant difference. Square: equivalent within the shaded margin of "
                f"{100 * pairs[0].margin:g} %."
            )
            figures.append(
                FigureSpec(f"forest_{format_slug(group)}", text, partial(plot_forest, pairs))
            )
    return figures


def study_figures(
    rankings: Sequence[tuple[RankingResult, RankingBlocks]],
    decided: Sequence[PairwiseTest],
    style: Mapping[str, LineStyle],
    note: str = "",
) -> list[FigureSpec]:
    """List the figures across the conditions of a study.

    Args:
        found: Ranking and its blocks by group.
        decided: Pairwise tests of the study.
        style: Line styles by label.
        note: Sentence about grey filters for captions.
    """
    drawings = []
    for one, sources in rankings:
        name = format_slug(one.group)
        if not one.refused:
            text = (
                f"Mean ranks of {one.group} over {len(one.cells)} conditions, 1 is best. A bar joins filters whose comparison is "
                f"inconclusive in Nemenyi's test (alpha {one.alpha:g}). CD: critical difference."
            )
            drawings.append(
                FigureSpec(
                    f"critical_difference_{name}",
                    text,
                    partial(plot_critical_difference, one, style),
                )
            )
        own = [v for v in decided if v.group == one.group]
        if own and len({(v.scenario, v.noise, v.model) for v in own}) > 1:
            text = (
                f"{one.group}: number of conditions in which the row filter is better than the column filter, and in which it is "
                "worse, with Holm's correction within each condition."
            )
            labels = order_by_rank(own, one)
            named = (
                [label for label in labels if not style[label].quiet][:MATRIX_FILTERS]
                if len(labels) > MATRIX_FILTERS
                else []
            )
            if len(labels) > MATRIX_FILTERS:
                best = (
                    "best mean ranks"
                    if one.ranks
                    else "largest numbers of better minus worse comparisons"
                )
                rows = (
                    f"the coloured filters, and of the others the {MATRIX_FILTERS - len(named)}"
                    if named
                    else f"the {MATRIX_FILTERS}"
                )
                text += f" Shown of {len(labels)} filters: {rows} with the {best}."
            drawings.append(
                FigureSpec(
                    f"matrix_{name}", text + _starred(one), partial(plot_matrix, own, one, named)
                )
            )
        if len(sources.runs) > 1 and len(sources.filters) > 1:
            text = (
                f"{one.group}: performance profile, the percentage of runs in which RMSE / best RMSE of the run is at most "
                f"the value on the x axis. The {len(sources.cells)} conditions have equal weight. A lost run counts as "
                f"infinite.{note}"
            )
            drawings.append(
                FigureSpec(f"profile_{name}", text, partial(plot_profiles, sources, style))
            )
    return drawings


def plot_matrix(
    tests: Sequence[PairwiseTest], ranking: RankingResult, required_labels: Sequence[str] = ()
) -> Figure:
    """Plot the numbers of conditions in which row filters are better and worse.

    Args:
        own: Pairwise tests of a group.
        one: Ranking of the group.
        named: Filters that are always included; the best others fill the matrix.
    """
    ranked = order_by_rank(tests, ranking)
    others = [label for label in ranked if label not in required_labels][
        : MATRIX_FILTERS - len(required_labels)
    ]
    labels = [label for label in ranked if label in required_labels or label in others]
    tests = [v for v in tests if v.a in labels and v.b in labels]
    won, met = np.zeros((len(labels),) * 2, dtype=int), np.zeros((len(labels),) * 2, dtype=int)
    for v in tests:
        i, j = labels.index(v.a), labels.index(v.b)
        met[i, j] += 1
        met[j, i] += 1
        won[i, j] += v.winner == v.a
        won[j, i] += v.winner == v.b
    share = np.divide(won - won.T, met, out=np.full(met.shape, np.nan), where=met > 0)
    names = list(map(wrap_label, labels))
    high = max(0.27, 0.11 * (1 + max(name.count("\n") for name in names)))
    figure = Figure(
        figsize=(COLUMN, max(COLUMN - 0.25, 1.0 + high * len(labels))), layout=build_padded_layout()
    )
    axis = figure.subplots()
    axis.imshow(share, cmap=_blue_and_orange(), vmin=-1, vmax=1, aspect="auto")
    stars = {frozenset((p.a, p.b)) for p in ranking.pairs if p.winner != INCONCLUSIVE}
    longest = (
        max(len(f"{a}–{b}") for a, b in zip(won[met > 0], won.T[met > 0], strict=True))
        + bool(stars)
        if met.any()
        else 0
    )
    beside = (
        72 * COLUMN - 20 - LETTER * max(len(line) for name in names for line in name.split("\n"))
    )
    between = (
        "–\n" if LETTER * longest > beside / len(labels) - 1 else "–"
    )  # two lines in narrow squares
    for i, row in enumerate(labels):
        for j, column in enumerate(labels):
            if met[i, j]:
                star = "*" if frozenset((row, column)) in stars else ""
                ink = "white" if share[i, j] > 0.55 else "black"
                font: Any = {
                    "ha": "center",
                    "va": "center",
                    "fontsize": SMALL,
                    "linespacing": 1.0,
                    "color": ink,
                }
                axis.text(j, i, f"{won[i, j]}{between}{won[j, i]}{star}", **font)
    axis.set_xticks(
        range(len(labels)),
        names,
        rotation=40,
        ha="right",
        rotation_mode="anchor",
        fontsize=SMALL,
        linespacing=1.0,
    )
    axis.set_yticks(range(len(labels)), names, fontsize=SMALL, linespacing=1.0)
    figure.supxlabel(
        f"better – worse, of {met.max()} conditions", fontsize=8
    )  # may be wider than the panel
    axis.grid(False)
    axis.tick_params(length=0)
    return figure


def plot_forest(pairs: Sequence[PairwiseTest]) -> Figure:
    """Plot the RMSE ratio and its interval, a row per pair."""
    names = [f"{v.a} / {v.b}" for v in pairs]
    if max(map(len, names)) > _LONG:
        names = [f"{break_settings(v.a, _LONG)}\n/ {break_settings(v.b, _LONG)}" for v in pairs]
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
        shown = v.winner != INCONCLUSIVE
        colour = "0.35" if not shown else _BETTER if v.winner == v.a else "#B35900"
        # Limits decided by lost runs are infinite: the line ends at the edge.
        left, right = (float(np.clip(x, *edges)) for x in (v.low, v.high))
        axis.plot([left, right], [row, row], color=colour, lw=1.1, zorder=2)
        axis.plot(
            float(np.clip(v.ratio, *edges)), row, ls="none", marker="s" if v.equivalent else "o", ms=4, mec=colour,
            mfc=colour if shown else "white", mew=0.9, zorder=3,
        )  # fmt: skip
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set_ylim(len(pairs) - 0.4, -0.6)
    axis.set(xscale="log", xlim=edges, xlabel="RMSE ratio")
    set_plain_ticks(axis.xaxis, [low, high])
    if high < 3 * low:
        axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.grid(False, axis="y")
    return figure


def _starred(one: RankingResult) -> str:
    """Format the caption of stars."""
    return (
        f" Star: significant in Nemenyi's test across {len(one.cells)} conditions."
        if one.shown
        else ""
    )


def order_by_rank(own: Sequence[PairwiseTest], one: RankingResult) -> list[str]:
    """Order labels by mean rank, or by better minus worse comparisons."""
    labels = dict.fromkeys(label for v in own for label in (v.a, v.b))
    lost = {
        label: sum(label in (v.a, v.b) and v.winner != INCONCLUSIVE for v in own)
        for label in labels
    }
    lost = {label: n - 2 * sum(v.winner == label for v in own) for label, n in lost.items()}
    return sorted(labels, key=lambda label: (_rank(one, label), lost[label]))


def _rank(one: RankingResult, label: str) -> float:
    """Return the mean rank of a filter, or the last rank."""
    ranks = dict(zip(one.filters, one.ranks, strict=False))
    return ranks.get(label, float(len(ranks)))


def _blue_and_orange() -> Any:
    """Return the colour map from worse to better."""
    return LinearSegmentedColormap.from_list("better", [_WORSE, "#ffffff", _BETTER])
