"""Plots of decisions on planned pairs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.label_placement import name_pairs
from pfbench.report.plots.plotting import COLUMN, SMALL, build_padded_layout
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.words import BETTER, WORSE

_COLOURS = {BETTER: "#0072B2", WORSE: "#E69F00"}  # dark and light, distinct in grey
_OPEN = "0.45"
_WIDTHS = {"a": 2.6, "b": 0.9}
_LARGEST = 3.0  # of the axis, as a factor beyond the largest estimate


def plot_planned_pairs(decisions: Sequence[Decision], margin: float) -> Figure:
    """Plot the ratio of errors of planned pairs, a row per pair.

    Args:
        decisions: Records of the error of each pair, for both questions.
        margin: Relative difference within which filters are equivalent.

    Returns:
        The figure.
    """
    pairs = list(dict.fromkeys((d.a, d.b) for d in decisions))
    names = name_pairs(pairs)
    lines = sum(1 + name.count("\n") for name in names)
    height = 0.75 + max(0.26 * len(pairs), 0.17 * lines)
    figure = Figure(figsize=(COLUMN, height), layout=build_padded_layout())
    axis = figure.subplots()
    ratios = [d.estimate for d in decisions if d.scale == "log ratio" and np.isfinite(d.estimate)]
    low = min([*ratios, -margin]) - np.log(_LARGEST) / 2
    high = max([*ratios, margin]) + np.log(_LARGEST) / 2
    limits = float(np.exp(low)), float(np.exp(high))
    axis.axvspan(1.0 / (1.0 + margin), 1.0 + margin, color="0.92", zorder=0)
    axis.axvline(1.0, color="0.4", lw=0.8, zorder=1)
    for decision in decisions:
        _plot_decision(axis, pairs.index((decision.a, decision.b)), decision, limits)
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set(xscale="log", xlim=limits, ylim=(len(pairs) - 0.4, -0.6))
    figure.supxlabel("error / error of the second filter", fontsize=8)
    set_plain_ticks(axis.xaxis, list(limits))
    axis.grid(False, axis="y")
    return figure


def _plot_decision(axis: Axes, row: int, decision: Decision, limits: tuple[float, float]) -> None:
    """Plot estimate and interval of a record; without an interval of errors, (a) has a text."""
    y = row - 0.12 if decision.question == "a" else row + 0.18
    ends = np.array([decision.low, decision.high])
    if decision.scale != "log ratio" or not np.isfinite([decision.estimate, *ends]).all():
        if decision.question == "a":
            text = decision.reason or decision.word
            axis.text(1.0, y, text, fontsize=SMALL, ha="center", va="center")
        return
    colour = _COLOURS.get(decision.word, _OPEN)
    low, high = np.exp(np.clip(ends, *np.log(limits)))  # clipped first: wide ends overflow
    axis.plot([low, high], [y, y], color=colour, lw=_WIDTHS[decision.question], zorder=2)
    is_decided = decision.word in _COLOURS
    face: Any = {"mfc": colour if is_decided else "white", "mec": colour, "mew": 0.8}
    size = 4.5 if decision.question == "a" else 3.0
    axis.plot(np.exp(decision.estimate), y, marker="o", ms=size, ls="none", zorder=3, **face)
