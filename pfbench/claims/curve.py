"""Specification curve of a claim: its ratio in all readings that decide, sorted, and the levels of the factors below.

References:
    U. Simonsohn, J. P. Simmons and L. D. Nelson (2020), Specification curve analysis.
"""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from pfbench.claims.claim_lines import ClaimPlan, list_factor_levels
from pfbench.claims.words import FALSE, TRUE, UNDECIDED, ClaimDecision
from pfbench.job.readings import read_reading_table
from pfbench.report import RC, FigureSpec, draw_figure
from pfbench.results.plotting import set_plain_ticks

_COLOURS = {TRUE: "#1a7f55", FALSE: "#c4362b", UNDECIDED: "#8292a0"}
_WIDTH, _CURVE, _ROW = (
    6.4,
    1.7,
    0.135,
)  # inches: of the figure, and heights of the curve and of a level
_FARTHEST = 1e4  # ratio that is drawn


def render_curve(plan: ClaimPlan, decision: ClaimDecision) -> bytes:
    """Render the specification curve of a claim as SVG."""
    spec = FigureSpec("curve", "", lambda: plot_curve(plan, decision))
    return draw_figure(spec, ("svg",))["svg"]


def plot_curve(plan: ClaimPlan, decision: ClaimDecision) -> Figure:
    """Plot ratios with their intervals, coloured by outcome, and below them a mark for each level of a reading.

    Levels that the paper prints have a star, the central ones are the first of their factor.
    """
    import seaborn

    dots = [
        dot for dot in decision.readings.values() if dot.outcome in _COLOURS and dot.effect.runs
    ]
    dots.sort(key=lambda dot: dot.effect.ratio)
    options, heights = list_factor_levels(plan), (_CURVE, _ROW * sum(map(len, list_factor_levels(plan).values())))  # fmt: skip
    rows = [(factor, level) for factor, levels in options.items() for level in levels]
    with rc_context(RC):
        figure = Figure(figsize=(_WIDTH, sum(heights) + 0.5), layout="constrained")
        curve, marks = figure.subplots(2, 1, height_ratios=heights)
        ratios = np.clip([dot.effect[:3] for dot in dots], 1 / _FARTHEST, _FARTHEST)
        places, colours = np.arange(len(dots)) + 0.5, [_COLOURS[dot.outcome] for dot in dots]
        curve.vlines(places, ratios[:, 1], ratios[:, 2], colors=colours, lw=0.9, alpha=0.5)
        seaborn.scatterplot(x=places, y=ratios[:, 0], c=colours, s=9, linewidth=0, ax=curve, zorder=3)  # fmt: skip
        curve.axhline(1.0, color="#1b1b1b", lw=0.8)
        curve.set(xlim=(0, len(dots)), xticks=[], yscale="log", ylabel="ratio")
        set_plain_ticks(curve.yaxis, ratios[:, 0])
        grid = np.array([[dot.levels[factor] == level for dot in dots] for factor, level in rows])
        names = [_name_row(plan, *row) for row in rows]
        seaborn.heatmap(grid, ax=marks, cmap=["white", "#4a5a6a"], vmin=0, vmax=1, cbar=False, xticklabels=False, yticklabels=names, rasterized=True)  # fmt: skip
        marks.grid(visible=False)
        marks.tick_params(length=0, labelsize=6)
        marks.set_xlabel(f"{len(dots)} readings, sorted by their ratio")
        marks.hlines(np.cumsum([len(levels) for levels in options.values()])[:-1], 0, len(dots), color="#b0b8c0", lw=0.6)  # fmt: skip
    return figure


def _name_row(plan: ClaimPlan, factor: str, level: str) -> str:
    """Name a level: a star marks one that the paper prints."""
    row = read_reading_table(plan.claim.paper).get(level, {})
    star = " *" if (row.get("factor"), row.get("class")) == (factor, "printed") else ""
    return f"{factor}: {level.removeprefix(f'{factor}_').replace('_', ' ')}{star}"
