"""Figures of comparisons: effects within a condition, decisions and profiles across conditions, Pareto fronts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from pfbench.report.cost import ParetoFront
from pfbench.report.plots.comparison_plots import (
    MATRIX_FILTERS,
    order_by_decisions,
    plot_forest,
    plot_matrix,
    plot_profiles,
)
from pfbench.report.plots.cost_plots import plot_pareto_fronts
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.plotting import LineStyle, format_slug
from pfbench.results.comparison.condition_blocks import RankingBlocks
from pfbench.results.comparison.pairwise_results import PairwiseTest

_PAIRS = 28  # pairs of a forest plot at most


def comparison_figures_of_condition(
    tests: Sequence[PairwiseTest],
    fronts: Sequence[ParetoFront],
    style: Mapping[str, LineStyle],
    note: str = "",
) -> list[FigureSpec]:
    """List the figures of a condition: the Pareto front, and a forest plot per group.

    Args:
        tests: Pairwise tests of the condition.
        fronts: Accuracy and time by group.
        style: Line styles by label.
        note: Sentence about grey filters for captions.
    """
    figures = []
    drawable = [front for front in fronts if np.isfinite(front.rmse).any()]
    if drawable:
        text = (
            "Time per step and median over runs of the RMSE, where a lost run counts as infinite. Ringed and joined: the Pareto "
            f"front, on which no other filter is both faster and more accurate.{note}"
        )
        figures.append(FigureSpec("front", text, partial(plot_pareto_fronts, drawable, style)))
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
    blocks: RankingBlocks,
    tests: Sequence[PairwiseTest],
    style: Mapping[str, LineStyle],
    note: str = "",
) -> list[FigureSpec]:
    """List the figures of a group across the conditions of a study.

    Args:
        blocks: Errors of the group by condition.
        tests: Pairwise tests of the study.
        style: Line styles by label.
        note: Sentence about grey filters for captions.

    Returns:
        The matrix of decisions and the performance profile, if the data allow them.
    """
    group_tests = [v for v in tests if v.group == blocks.group]
    return [
        *_matrix_figures(blocks.group, group_tests, style),
        *_profile_figures(blocks.group, blocks, style, note),
    ]


def _matrix_figures(
    group: str, tests: Sequence[PairwiseTest], style: Mapping[str, LineStyle]
) -> Iterator[FigureSpec]:
    """Yield the matrix of decisions, if the tests of a group belong to several conditions."""
    if len({(v.scenario, v.noise, v.model) for v in tests}) < 2:
        return
    text = (
        f"{group}: number of conditions in which the row filter is better than the column filter, and in which it is worse. "
        "Exploratory, with Holm's correction within each condition."
    )
    labels, coloured = order_by_decisions(tests), []
    if len(labels) > MATRIX_FILTERS:
        coloured = [label for label in labels if not style[label].quiet][:MATRIX_FILTERS]
        rest = MATRIX_FILTERS - len(coloured)
        start = "the coloured filters, and of the others " if coloured else ""
        text += f" Shown of {len(labels)} filters: {start}the {rest} with the largest numbers of better minus worse comparisons."
    name = f"matrix_{format_slug(group)}"
    yield FigureSpec(name, text, partial(plot_matrix, tests, coloured))


def _profile_figures(
    group: str, blocks: RankingBlocks, style: Mapping[str, LineStyle], note: str
) -> Iterator[FigureSpec]:
    """Yield the performance profile of several filters in several conditions."""
    if len(blocks.runs) > 1 and len(blocks.filters) > 1:
        text = (
            f"{group}: performance profile, the percentage of runs in which RMSE / best RMSE of "
            f"the run is at most the value on the x axis. The {len(blocks.cells)} conditions have "
            f"equal weight. A lost run counts as infinite.{note}"
        )
        name = f"profile_{format_slug(group)}"
        yield FigureSpec(name, text, partial(plot_profiles, blocks, style))
