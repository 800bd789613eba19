"""Whether filters know how wrong they are: how often the truth lies in the regions that they give, decided once per cell.

The measure is the probability that a filter gives to values below the truth, which is uniform for one that knows what it knows.
Components and instants of one run hang together, so that runs alone are counted: intervals rest on the scatter between runs, and
the band of the rank histogram is that of as many numbers as there are runs, wide enough whatever hangs together in them [ours].
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
    """The rank histograms of a cell, where anything was scored.

    Args:
        results: by label, without the instants that are left out.
        groups: names of the blocks shown.
        style: from `looks`.
        alpha: probability outside the band, for one bin.
        note: on who is drawn how.
    """
    shown = [group for group in groups if _numbers(results, group)]
    if not shown:
        return []
    text = (
        "Rank histograms: how often the truth lay where a filter gives values below it so much probability; flat when it knows "
        "what it knows, high at both ends when its regions are too narrow, high in the middle when they are too wide. "
        f"Shaded: {100 * (1 - alpha):g} % binomial band of one bin, of as many numbers as runs, for components and instants of "
        f"one run hang together.{note}"
    )
    return [
        FigureSpec("calibration", text, partial(plot_rank_histograms, results, shown, style, alpha))
    ]


def plot_rank_histograms(
    results: Mapping[str, store.JobResult],
    groups: Sequence[str],
    style: Mapping[str, LineStyle],
    alpha: float = 0.05,
) -> Figure:
    """Rank histograms as lines, one panel per group, all filters."""
    figure, panels = stacked_axes(len(groups), 1.35)
    centres = 100 * (np.arange(_BINS) + 0.5) / _BINS
    for group, axis in zip(groups, panels, strict=True):
        runs = []
        for label, (pit, lost) in _numbers(results, group).items():
            found = consistency.rank_histogram(pit, lost, _BINS)
            look = style[label]
            axis.plot(
                centres,
                100 * found.value,
                marker="" if look.quiet else look.marker,
                ms=2.5,
                **look.line(label),
            )
            runs.append(found.runs)
        low, high = intervals.binomial_interval(1 / _BINS, max(runs), alpha)
        axis.axhspan(100 * low, 100 * high, color="0.88", lw=0, zorder=0)
        axis.axhline(100 / _BINS, color="0.4", lw=0.8, zorder=1)
        axis.set(title=group, ylabel="share in %", xlim=(0, 100), ylim=(0, None))
    panels[-1].set_xlabel("probability given to values below the truth in %")
    add_legend(figure, panels[0])
    return figure


def _numbers(
    results: Mapping[str, store.JobResult], group: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Probabilities below the truth [R, S, K] and lost runs [R] of each filter that has any of the group."""
    found = {}
    for label, result in results.items():
        for block in component_groups(result.meta["state"]):
            if block.group == group and "pit" in result.arrays:
                pit, lost = result.arrays["pit"][..., block.places], result.arrays["lost"]
                if not np.isnan(pit[~lost]).all():
                    found[label] = pit, lost
    return found
