"""Rank histograms: share of truths in each bin of the filters' distribution functions.

The probability integral transform is the probability that a filter assigns to values below the
truth. It is uniform for a calibrated filter. Components and steps of a run are dependent, so runs
are the sample: the band is that of as many numbers as runs [ours].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.plotting import LineStyle, add_legend, stacked_axes
from pfbench.results import consistency, store
from pfbench.results.state_groups import component_groups
from pfbench.results.statistics import intervals

_BINS = 10


def calibration_figures(
    results: Mapping[str, store.JobResult],
    groups: Sequence[str],
    style: Mapping[str, LineStyle],
    alpha: float = 0.05,
    note: str = "",
) -> list[FigureSpec]:
    """List the rank histograms of a condition, none without scores.

    Args:
        results: Results by label, from the start time on.
        groups: Names of the component groups.
        style: Line styles by label.
        alpha: Probability outside the band of one bin.
        note: Sentence about grey filters for captions.
    """
    scored = [group for group in groups if _select_pit(results, group)]
    if not scored:
        return []
    text = (
        "Rank histograms: share of truths by the probability that a filter gives to values below "
        "the truth. Flat: calibrated. High at both ends: overconfident. High in the middle: "
        f"underconfident. Shaded: {100 * (1 - alpha):g} % binomial band of one bin for as many "
        f"numbers as runs, because components and steps of a run are dependent.{note}"
    )
    return [
        FigureSpec(
            "calibration", text, partial(plot_rank_histograms, results, scored, style, alpha)
        )
    ]


def plot_rank_histograms(
    results: Mapping[str, store.JobResult],
    groups: Sequence[str],
    style: Mapping[str, LineStyle],
    alpha: float = 0.05,
) -> Figure:
    """Plot rank histograms as lines, a panel per group.

    Args:
        results: Results by label.
        groups: Names of the component groups.
        style: Line styles by label.
        alpha: Probability outside the band of one bin.
    """
    figure, panels = stacked_axes(len(groups), 1.35)
    centres = 100 * (np.arange(_BINS) + 0.5) / _BINS
    for group, axis in zip(groups, panels, strict=True):
        runs = []
        for label, (pit, lost) in _select_pit(results, group).items():
            histogram = consistency.rank_histogram(pit, lost, _BINS)
            look = style[label]
            mark = {} if look.quiet else look.mark()
            axis.plot(centres, 100 * histogram.value, ms=2.5, **mark, **look.line(label))
            runs.append(histogram.runs)
        low, high = intervals.binomial_interval(1 / _BINS, max(runs), alpha)
        axis.axhspan(100 * low, 100 * high, color="0.88", lw=0, zorder=0)
        axis.axhline(100 / _BINS, color="0.4", lw=0.8, zorder=1)
        axis.set(title=group, ylabel="share in %", xlim=(0, 100), ylim=(0, None))
    panels[-1].set_xlabel("probability given to values below the truth in %")
    add_legend(figure, panels[0])
    return figure


def _select_pit(
    results: Mapping[str, store.JobResult], group: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the probability integral transform [R, S, K] and lost runs [R] of each filter."""
    selection = {}
    for label, result in results.items():
        for block in component_groups(result.meta["state"]):
            if block.group == group and "pit" in result.data:
                pit, lost = result.data["pit"][..., block.places], result.data["lost"]
                if not np.isnan(pit[~lost]).all():
                    selection[label] = pit, lost
    return selection
