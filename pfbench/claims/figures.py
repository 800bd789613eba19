"""Figures of the claims: printed against measured values, and links to figures of studies."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.claims.claim_tests import ClaimTestResult
from pfbench.claims.schema import Claim, ClaimTest
from pfbench.claims.verdicts import ClaimVerdict
from pfbench.report.plots.axis_ticks import set_plain_ticks
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.paper.paper_catalogue import FIGURES
from pfbench.report.plots.plotting import COLUMN, SMALL, format_slug
from pfbench.results.decisions.words import FAILS, HOLDS

_COLOURS = {HOLDS: "#0072B2", FAILS: "#D55E00"}  # open results are grey


def figure_anchor(claim: Claim, test: ClaimTest, anchors: Collection[str]) -> str:
    """Find the anchor of the figure of the paper that shows a test.

    Args:
        claim: Claim, whose source names the figures of its paper.
        test: Test of the claim.
        anchors: Anchors of the figures on the page of the study.

    Returns:
        The anchor, empty without one.
    """
    condition = format_slug(test.cell.replace("/", "_"))
    for name, figure in FIGURES.items():
        if name.startswith(claim.paper) and figure_numbers(claim.source) & figure_numbers(
            figure.title
        ):
            start = format_slug(f"paper_{name}")
            starts = (f"{start}_{condition}", f"{start}_over_time")
            candidates = sorted(a for a in anchors if a == start or a.startswith(starts))
            any_group = not test.group or not figure.groups
            suffix = f"_{format_slug(test.group)}"
            if matches := [a for a in candidates if any_group or a.endswith(suffix)]:
                return matches[0]
    return ""


def figure_numbers(source: str) -> set[int]:
    """Extract figure numbers from texts such as "figures 2, 4 and 5" or "figures 12 to 14"."""
    numbers: set[int] = set()
    for text in re.findall(r"figures? (\d+(?:(?:, | and | to )\d+)*)", source):
        for low, high in re.findall(r"(\d+)(?: to (\d+))?", text):
            numbers |= set(range(int(low), int(high or low) + 1))
    return numbers


def claim_figures(verdicts: Sequence[ClaimVerdict]) -> list[FigureSpec]:
    """Specify the figures of printed against measured ratios, and of levels."""
    rows: dict[ClaimTest, tuple[str, ClaimTestResult]] = {}
    for verdict in verdicts:
        for result in (r for results in verdict.findings.values() for r in results):
            test = result.comparison
            if np.isfinite(test.printed) and np.isfinite(result.effect) and result.effect > 0:
                rows.setdefault(test, (verdict.claim.id, result))
    ratios = [row for test, row in rows.items() if test.b]
    levels = [row for test, row in rows.items() if not test.b]
    tail = " Filled blue: the test holds. Open orange: it fails. Grey: it is open."
    drawings = []
    if ratios:
        text = "Ratio of the first filter to the second: printed (cross), measured (dot, interval)."
        make = partial(plot_claims, ratios, relative=False)
        drawings.append(FigureSpec("printed_ratios", text + tail, make))
    if levels:
        text = "Measured level divided by the printed level, with its interval."
        make = partial(plot_claims, levels, relative=True)
        drawings.append(FigureSpec("printed_levels", text + tail, make))
    return drawings


def plot_claims(rows: Sequence[tuple[str, ClaimTestResult]], relative: bool) -> Figure:
    """Plot measured and printed values, one row per test.

    Args:
        rows: Identifier of the claim and result of the test.
        relative: Plot the measured value divided by the printed one.

    Returns:
        The figure.
    """
    figure = Figure(figsize=(COLUMN, 0.7 + 0.17 * len(rows)), layout="constrained")
    axis = figure.subplots()
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    values = [1.0]
    for index, (_, result) in enumerate(rows):
        printed = result.comparison.printed
        values += _plot_row(axis, index, result, printed if relative else 1.0)
        if not relative:
            axis.plot(printed, index, ls="none", marker="x", ms=5, mew=1.2, color="black", zorder=4)
            values.append(printed)
    labels = [_row_label(claim, result.comparison) for claim, result in rows]
    axis.set_yticks(range(len(rows)), labels, fontsize=SMALL)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    positive = [value for value in values if np.isfinite(value) and value > 0]
    low, high = min(positive), max(positive)
    edge = (high / low) ** 0.06
    label = "measured / printed" if relative else "ratio"
    axis.set(xscale="log", xlim=(low / edge, high * edge), xlabel=label)
    set_plain_ticks(axis.xaxis, [low, high])
    axis.grid(False, axis="y")
    return figure


def _plot_row(axis: Axes, index: int, result: ClaimTestResult, scale: float) -> list[float]:
    """Plot the result of one test; return its values."""
    colour = _COLOURS.get(result.outcome, "0.5")
    low, middle, high = result.low / scale, result.effect / scale, result.high / scale
    if np.isfinite([low, high]).all() and low > 0:
        axis.plot([low, high], [index, index], color=colour, lw=1.1, zorder=2)
    fill = colour if result.outcome == HOLDS else "white"
    axis.plot(middle, index, "o", ls="none", ms=4, mec=colour, mfc=fill, mew=0.9, zorder=3)
    return [low, middle, high]


def _row_label(claim: str, test: ClaimTest) -> str:
    """Format the label of a row."""
    measure = test.group or test.metric.replace("_", " ")
    measure = test.component if test.component != "norm" else measure
    return f"{claim}: {test.a}{f' / {test.b}' if test.b else ''}, {measure}"
