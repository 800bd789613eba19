"""Specification curve of a claim: its ratio in all readings that decide, sorted, and the levels of the factors below.

References:
    U. Simonsohn, J. P. Simmons and L. D. Nelson (2020), Specification curve analysis.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from matplotlib.figure import Figure

from pfbench.claims.claim_lines import ClaimPlan, list_options, read_readings
from pfbench.claims.words import FALSE, TRUE, UNDECIDED, ClaimDecision
from pfbench.report import RC, FigureSpec, draw_figure

_COLOURS = {TRUE: "#1a7f55", FALSE: "#c4362b", UNDECIDED: "#8292a0"}
_WIDTH, _CURVE, _ROW = 6.4, 1.7, 0.135  # inches: of the figure, and heights of the curve and of a level
_FARTHEST = math.log(1e4)  # of a log ratio that is drawn


def render_curve(plan: ClaimPlan, decision: ClaimDecision) -> bytes:
    """Render the specification curve of a claim as SVG."""
    spec = FigureSpec("curve", "", lambda: plot_curve(plan, decision))
    return draw_figure(spec, ("svg",))["svg"]


def plot_curve(plan: ClaimPlan, decision: ClaimDecision) -> Figure:
    """Plot ratios with their intervals, coloured by outcome, and below them a mark for each level of a reading.

    Levels that the paper prints have a star, the central ones are the first of their factor.
    """
    import matplotlib
    import seaborn

    dots = [dot for dot in decision.readings.values() if dot.outcome in _COLOURS and dot.shown.runs]
    dots.sort(key=lambda dot: dot.shown.ratio)
    rows = [(factor, level) for factor, levels in list_options(plan).items() for level in levels]
    heights = (_CURVE, _ROW * len(rows))
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(_WIDTH, sum(heights) + 0.5), layout="constrained")
        curve, marks = figure.subplots(2, 1, height_ratios=heights)
        shown = np.array([(d.shown.ratio, d.shown.low, d.shown.high) for d in dots])
        logs = np.clip(np.log(np.maximum(shown, math.exp(-_FARTHEST))), -_FARTHEST, _FARTHEST)
        places = np.arange(len(dots)) + 0.5
        colours = [_COLOURS[dot.outcome] for dot in dots]
        curve.vlines(places, logs[:, 1] / math.log(10), logs[:, 2] / math.log(10), colors=colours, lw=0.9, alpha=0.5)  # fmt: skip
        seaborn.scatterplot(x=places, y=logs[:, 0] / math.log(10), c=colours, s=9, linewidth=0, ax=curve, zorder=3)  # fmt: skip
        curve.axhline(0.0, color="#1b1b1b", lw=0.8)
        curve.set(xlim=(0, len(dots)), xticks=[], ylabel="ratio")
        curve.yaxis.set_major_formatter(lambda value, _: f"{10**value:.3g}")
        grid = np.array([[dot.levels[factor] == level for dot in dots] for factor, level in rows])
        seaborn.heatmap(grid, ax=marks, cmap=["white", "#4a5a6a"], cbar=False, xticklabels=False, yticklabels=[_name_row(plan, *row) for row in rows], rasterized=True)  # fmt: skip
        marks.tick_params(length=0, labelsize=6)
        marks.set_xlabel(f"{len(dots)} readings, sorted by their ratio")
        for k, (one, other) in enumerate(pairwise(rows)):
            if one[0] != other[0]:
                marks.axhline(k + 1, color="#b0b8c0", lw=0.6)
    return figure


def _name_row(plan: ClaimPlan, factor: str, level: str) -> str:
    """Name a level: a star marks one that the paper prints."""
    reading = read_readings(plan.claim.paper).get(level)
    is_printed = reading is not None and reading.factor == factor and reading.grade == "printed"
    name = level.removeprefix(f"{factor}_").replace("_", " ")
    return f"{factor}: {name}{' *' if is_printed else ''}"
