"""Pictures of the ledger: what the papers print against what was measured; and which figure of a study's page shows a claim."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.canvas import COLUMN, SMALL, plain_ticks, slug
from pfbench.report.claims import Claim, Comparison
from pfbench.report.figures import Drawing
from pfbench.report.paper_figures import FIGURES
from pfbench.report.rulings import FAILS, HOLDS, Finding, Ruling

_INK = {HOLDS: "#0072B2", FAILS: "#D55E00"}  # what is open is grey
_SHOWN_IN = {  # figures of a cell, by the metric of a comparison
    "rmse": "rmse", "max_error": "error_{}", "mean_abs": "error_{}", "settled": "error_{}", "growth": "error_{}",
    "sd": "error_{}", "nees": "nees", "diverged": "nees", "ess": "ess", "effective": "ess", "accepted": "accepted_0",
    "seconds_per_step": "front",
}  # fmt: skip


def anchor(claim: Claim, one: Comparison, there: Collection[str]) -> tuple[str, bool]:
    """Where the page of its study shows a comparison, and whether that is a figure: the paper's own where it is drawn anew, else
    the one of the cell that shows the metric, else the cell.

    Args:
        claim: names the figures of its paper.
        one: one of its comparisons.
        there: all anchors of that page.
    """
    cell = slug(one.cell.replace("/", "_"))
    for name, figure in FIGURES.items():
        if name.startswith(claim.paper) and numbers(claim.source) & numbers(figure.said):
            begin = slug(f"paper_{name}")
            own = sorted(a for a in there if a == begin or a.startswith((f"{begin}_{cell}", f"{begin}_over_time")))
            fitting = [a for a in own if not one.group or not figure.groups or a.endswith(f"_{slug(one.group)}")]
            if fitting:
                return fitting[0], True
    metric = _SHOWN_IN.get(one.metric, one.metric)
    wanted = f"{cell}_{metric.format(slug(one.group))}"
    return (wanted, True) if wanted in there else (cell if cell in there else "", False)


def numbers(source: str) -> set[int]:
    """The figures that a text names: "figures 2, 4 and 5", "figure 3, section 4", "figures 12 to 14"."""
    found: set[int] = set()
    for part in re.findall(r"figures? (\d+(?:(?:, | and | to )\d+)*)", source):
        for low, high in re.findall(r"(\d+)(?: to (\d+))?", part):
            found |= set(range(int(low), int(high or low) + 1))
    return found


def drawings(rulings: Sequence[Ruling]) -> list[Drawing]:
    """Printed numbers against measured ones, with intervals: ratios of two filters, and levels."""
    rows: dict[Comparison, tuple[str, Finding]] = {}
    for ruling in rulings:
        for finding in (f for findings in ruling.findings.values() for f in findings):
            if np.isfinite(finding.comparison.printed) and np.isfinite(finding.effect) and finding.effect > 0:
                rows.setdefault(finding.comparison, (ruling.claim.id, finding))
    of_two = [row for row in rows.values() if row[1].comparison.b]
    alone = [row for row in rows.values() if not row[1].comparison.b]
    tail = " Blue and filled: the comparison holds; orange and open: it fails; grey: it is not decided."
    made = []
    if of_two:
        text = "Ratio of the first filter to the second: printed (cross) and measured (dot, with its interval)."
        made.append(Drawing("printed_ratios", text + tail, partial(forest, of_two, relative=False)))
    if alone:
        text = "Measured over printed, with its interval, where the paper prints a level: 1 is as printed."
        made.append(Drawing("printed_levels", text + tail, partial(forest, alone, relative=True)))
    return made


def forest(rows: Sequence[tuple[str, Finding]], relative: bool) -> Figure:
    """One row per comparison: what was measured, with its interval, and what is printed, or the one over the other."""
    figure = Figure(figsize=(COLUMN, 0.7 + 0.17 * len(rows)), layout="constrained")
    axis = figure.subplots()
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    seen = [1.0]
    for place, (_, found) in enumerate(rows):
        printed = found.comparison.printed
        seen += _row(axis, place, found, printed if relative else 1.0)
        if not relative:
            axis.plot(printed, place, ls="none", marker="x", ms=5, mew=1.2, color="black", zorder=4)
            seen.append(printed)
    axis.set_yticks(range(len(rows)), [_name(claim, found.comparison) for claim, found in rows], fontsize=SMALL)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    known = [value for value in seen if np.isfinite(value) and value > 0]
    low, high = min(known), max(known)
    edge = (high / low) ** 0.06
    axis.set(xscale="log", xlim=(low / edge, high * edge), xlabel="measured / printed" if relative else "ratio")
    plain_ticks(axis.xaxis, [low, high])
    axis.grid(False, axis="y")
    return figure


def _row(axis: Axes, place: int, found: Finding, scale: float) -> list[float]:
    ink = _INK.get(found.outcome, "0.5")
    low, middle, high = found.low / scale, found.effect / scale, found.high / scale
    if np.isfinite([low, high]).all() and low > 0:
        axis.plot([low, high], [place, place], color=ink, lw=1.1, zorder=2)
    fill = ink if found.outcome == HOLDS else "white"
    axis.plot(middle, place, ls="none", marker="o", ms=4, mec=ink, mfc=fill, mew=0.9, zorder=3)
    return [low, middle, high]


def _name(claim: str, one: Comparison) -> str:
    what = one.component if one.component != "norm" else one.group or one.metric.replace("_", " ")
    return f"{claim}: {one.a}{f' / {one.b}' if one.b else ''}, {what}"
