"""Figures of a study of many worlds: every filter in every cell at one glance, and proposed methods beside their baselines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array
from matplotlib.figure import Figure

from pfbench.report.across import Across, Blocks
from pfbench.report.canvas import COLUMN, SHADES, SMALL, plain_ticks, roomy, slug, wrapped
from pfbench.report.figures import Drawing
from pfbench.report.headline import Planned
from pfbench.report.significance import NO_DIFFERENCE

_BETTER, _WORSE, _OPEN = "#0072B2", "#E69F00", "0.72"  # apart in grey too: dark, light, and a ring
_STEPS = (1.05, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0)  # edges between the shades of the map
_BESIDE = 170  # points beside the longest names, of those of a column
_WIDE = 60  # cells of which each has a column of its own
_HELD = 28  # cells that one column of print holds, with names of letters that can be read; more are drawn wider


def drawings(one: Across, source: Blocks, pairs: Sequence[Planned], alpha: float, said: str) -> list[Drawing]:
    """Both figures, where there is what they show; `said` is what is compared, in words."""
    found = []
    if pairs:
        text = (
            f"Proposed methods against the baselines of their own papers: ratio of the median RMSE of {said}, a dot for each "
            f"of {len(source.cells)} cells. Blue: the method is shown to be better there, orange: worse (Holm within the cell), "
            "a ring: neither; arrows lie beyond the edge, where lost runs decide it too. Bars: median over cells, thick where "
            f"Wilcoxon's test across cells shows a difference at {100 * alpha:g} % (Holm over these {len(pairs)} pairs)."
        )
        found.append(Drawing(f"proposed_{slug(one.group)}", text, partial(proposed, pairs)))
    if len(source.filters) > 2 and 2 < len(source.cells) <= _WIDE:
        text = (
            f"Median RMSE of each filter over that of the best one of the cell, of {said}: the darker the worse; a cross where "
            f"half of the runs or more were lost. Filters by {'mean rank' if one.ranks else 'the median of these ratios'}."
        )
        found.append(Drawing(f"map_{slug(one.group)}", text, partial(ratio_map, one, source)))
    return found


def proposed(pairs: Sequence[Planned]) -> Figure:
    """A row per pair, a dot per cell."""
    figure = Figure(figsize=(COLUMN, 0.7 + 0.21 * len(pairs)), layout=roomy())
    axis = figure.subplots()
    ends = np.array([r for pair in pairs for r in pair.ratios if np.isfinite(r) and r > 0])
    low, high = float(np.quantile(ends, 0.01)), float(np.quantile(ends, 0.99))
    low, high = min(low / 1.1, 0.8), max(1.1 * high, 1.25)
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    for row, pair in enumerate(pairs):
        for k, (ratio, shown) in enumerate(zip(pair.ratios, pair.shown, strict=True)):
            open_ = shown == NO_DIFFERENCE
            colour = _OPEN if open_ else _BETTER if shown == pair.method else _WORSE
            marker = "<" if ratio < low else ">" if ratio > high else "o"
            y = row + 0.3 * ((k * 0.6180339887) % 1 - 0.5)
            face: Any = {"mfc": "white", "mec": "0.55"} if open_ else {"mfc": colour, "mec": colour}
            face |= {"ls": "none", "marker": marker, "ms": 2.6, "mew": 0.6, "zorder": 2, "clip_on": False}
            axis.plot(float(np.clip(ratio, low, high)), y, **face)
        width = 0.9 if pair.winner == NO_DIFFERENCE else 2.4
        axis.plot([float(np.clip(pair.ratio, low, high))] * 2, [row - 0.38, row + 0.38], color="black", lw=width, zorder=3)
    names = [f"{pair.method} / {pair.baseline}" for pair in pairs]
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set_ylim(len(pairs) - 0.4, -0.6)
    for row in range(1, len(pairs)):
        if pairs[row].method != pairs[row - 1].method:
            axis.axhline(row - 0.5, color="0.8", lw=0.6, zorder=0)
    axis.set(xscale="log", xlim=(low, high))
    figure.supxlabel("RMSE over that of the baseline", fontsize=8)  # wider than a panel beside long names
    plain_ticks(axis.xaxis, [low, high])
    axis.grid(False, axis="y")
    return figure


def ratio_map(one: Across, source: Blocks) -> Figure:
    """Filters against cells, shaded by how many times the RMSE of the best filter of the cell theirs is."""
    with np.errstate(invalid="ignore"):
        ratio = np.exp(source.values - np.min(source.values, axis=1, keepdims=True))
    ratio = np.where(np.isfinite(source.values), ratio, np.inf)
    by = one.ranks or np.median(ratio, axis=0)
    order = sorted(range(len(source.filters)), key=lambda i: (by[i], source.filters[i]))
    shown = ratio[:, order].T
    wide = COLUMN + max(0, len(source.cells) - _HELD) * SMALL / 72
    names = [wrapped(source.filters[i]) for i in order]
    lines = max(1 + (a.count("\n") + b.count("\n")) / 2 for a, b in pairwise(names))  # neighbours do not touch
    figure = Figure(figsize=(wide, 1.35 + 0.018 * SMALL * lines * len(order)), layout=roomy())
    axis = figure.subplots()
    shades = to_rgba_array(SHADES)
    image = shades[np.searchsorted(_STEPS, np.where(np.isfinite(shown), shown, 1.0), side="right")]
    image[~np.isfinite(shown)] = (1, 1, 1, 1)
    axis.imshow(image, aspect="auto", interpolation="nearest")
    rows, columns = np.nonzero(~np.isfinite(shown))
    axis.plot(columns, rows, ls="none", marker="x", ms=2.5, color="0.4", mew=0.6)
    axis.set_yticks(range(len(order)), names, fontsize=SMALL, linespacing=1.0)
    _worlds(axis, source.cells)
    axis.grid(False)
    axis.tick_params(length=0)
    for edge, shade in zip((1.0, *_STEPS), shades, strict=True):
        axis.plot([], [], ls="none", marker="s", color=shade, label=f"{edge:g}")
    figure.legend(
        loc="outside lower center", ncols=8, fontsize=SMALL, handletextpad=0.1, columnspacing=0.7, title="times the best, from",
        title_fontsize=SMALL,
    )  # fmt: skip
    return figure


def _worlds(axis: Any, cells: Sequence[str]) -> None:
    """Names of the worlds above their columns, those of the regimes below, and lines between worlds."""
    places, names, start = [], [], 0
    for world, own in groupby(cells, key=lambda cell: cell.split(" / ")[0]):
        width = len(list(own))
        places.append(start + (width - 1) / 2)
        names.append(world)
        start += width
        if start < len(cells):
            axis.axvline(start - 0.5, color="white", lw=1.6)
    axis.set_xticks(range(len(cells)), [cell.split(" / ")[1] for cell in cells], rotation=90, fontsize=SMALL)
    above = axis.secondary_xaxis("top")
    apart = min((b - a for a, b in pairwise(places)), default=len(cells)) * _BESIDE / max(len(cells), _HELD)
    turned = max(25.0, np.degrees(np.arcsin(min(1.0, 1.2 * SMALL / apart))))  # lines of letters side by side need that much
    above.set_xticks(places, names, fontsize=SMALL, rotation=turned, ha="left", rotation_mode="anchor")
    above.tick_params(length=0)
    above.spines["top"].set_visible(False)


