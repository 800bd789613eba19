"""Figures of who is better: effects within a cell, ranks, decisions and profiles across cells, fronts of accuracy and time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
import scikit_posthocs as posthocs
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pfbench.report import across
from pfbench.report.across import Across, Blocks
from pfbench.report.budget import Front
from pfbench.report.canvas import (
    COLUMN,
    LETTER,
    SMALL,
    Look,
    broken,
    labelled,
    legend,
    named_beside,
    plain_ticks,
    roomy,
    slug,
    stack,
    wrapped,
)
from pfbench.report.figures import Drawing
from pfbench.report.significance import NO_DIFFERENCE, Verdict

_PAIRS = 28  # of a forest that a column's height still holds
_MANY = 12  # filters of a diagram of which each rank has a tick
_TITLE = 52  # letters of a line above a panel
_LONG = 34  # letters of a pair that stand on one line of a column
_SIDE = 10  # filters of a matrix that a column's width still holds
_BETTER, _WORSE = "#0072B2", "#E69F00"  # apart in grey too: dark and light


def of_cell(own: Sequence[Verdict], fronts: Sequence[Front], style: Mapping[str, Look], note: str = "") -> list[Drawing]:
    """Figures of one cell: the front of accuracy and time, and a forest of effects per group; `note` says who is grey."""
    found = []
    shown = [front for front in fronts if np.isfinite(front.rmse).any()]
    if shown:
        text = (
            "Time per step against the median over runs of the RMSE, a lost run being worse than any other. Ringed and joined: "
            f"filters that no other one beats in both.{note}"
        )
        found.append(Drawing("front", text, partial(fronts_of, shown, style)))
    for group in dict.fromkeys(v.group for v in own):
        pairs = [v for v in own if v.group == group]
        if 0 < len(pairs) <= _PAIRS:
            level = f"{100 * pairs[0].level:g}"
            text = (
                f"RMSE of {group} of the first filter over that of the second (below 1 the first is better), median over runs "
                f"and {level} % interval. "
                f"Filled: a difference is shown; square: equivalence within the shaded margin of {100 * pairs[0].margin:g} % is."
            )
            found.append(Drawing(f"forest_{slug(group)}", text, partial(forest, pairs)))
    return found


def of_study(
    found: Sequence[tuple[Across, Blocks]], decided: Sequence[Verdict], style: Mapping[str, Look], note: str = ""
) -> list[Drawing]:
    """Figures across the cells of a study; `note` says who is grey."""
    drawings = []
    for one, sources in found:
        name = slug(one.group)
        if not one.refused:
            text = (
                f"Mean ranks of {one.group} over {len(one.cells)} cells, 1 is best. A bar joins filters between which Nemenyi's "
                f"test at {100 * one.alpha:g} % shows no difference; CD is its critical difference."
            )
            drawings.append(Drawing(f"critical_difference_{name}", text, partial(critical_difference, one, style)))
        own = [v for v in decided if v.group == one.group]
        if own and len({(v.scenario, v.noise, v.model) for v in own}) > 1:
            text = (
                f"{one.group}: cells in which the filter of the row is shown to be better than that of the column, and in "
                "which it is shown to be worse, after Holm's correction within each cell."
            )
            labels = _by_rank(own, one)
            named = [label for label in labels if not style[label].quiet][:_SIDE] if len(labels) > _SIDE else []
            if len(labels) > _SIDE:
                best = "best mean ranks" if one.ranks else "most won over lost comparisons"
                who = f"those in colour elsewhere and, of the others, the {_SIDE - len(named)}" if named else f"the {_SIDE}"
                text += f" Of {len(labels)} filters: {who} with the {best}."
            drawings.append(Drawing(f"matrix_{name}", text + _starred(one), partial(matrix, own, one, named)))
        if len(sources.runs) > 1 and len(sources.filters) > 1:
            text = (
                f"{one.group}: share of the runs in which the RMSE of a filter is at most so many times that of the best "
                f"filter of the same run; {len(sources.cells)} cells of equal weight. A lost run never gets there.{note}"
            )
            drawings.append(Drawing(f"profile_{name}", text, partial(profiles, sources, style)))
    return drawings


def critical_difference(one: Across, style: Mapping[str, Look]) -> Figure:
    """Mean ranks on a line, bars over those that are not told apart [Demsar 2006, figure 1]."""
    k = len(one.filters)
    half = -(-k // 2)
    names = {label: wrapped(label) for label in one.filters}
    apart = 0.17 + 0.08 * max(name.count("\n") for name in names.values())
    figure = Figure(figsize=(COLUMN, 0.85 + apart * (half + _bars(one))), layout=roomy())
    axis = figure.subplots()
    # Above the omnibus level nothing is told apart, whatever a single pair says.
    p = np.ones((k, k))
    for pair in one.pairs:
        i, j = one.filters.index(pair.a), one.filters.index(pair.b)
        p[i, j] = p[j, i] = pair.p_nemenyi if one.p_f <= one.alpha else 1.0
    axis.set_xlim(1, k)
    posthocs.critical_difference_diagram(
        dict(zip(one.filters, one.ranks, strict=True)),
        pd.DataFrame(p, index=one.filters, columns=one.filters),
        ax=axis, alpha=one.alpha, label_props={"fontsize": 7 if k <= _MANY else SMALL}, text_h_margin=0.1,
        color_palette={label: style[label].colour for label in one.filters},
        marker_props={"s": 14, "zorder": 4}, elbow_props={"linewidth": 0.9},
        crossbar_props={"linewidth": 2.2, "color": "0.25", "marker": "|"},
        label_fmt_left="{label} {rank:.2f} ", label_fmt_right=" {rank:.2f} {label}",
    )  # fmt: skip
    for text in axis.texts:  # a light colour is a line, but no letter
        text.set(color="black", linespacing=1.0)
        for label, name in names.items():
            if label in text.get_text().split():
                text.set_text(text.get_text().replace(label, name.replace("\n", "\n ")))
    for mark in (*axis.collections, *axis.lines):  # the first and the last stand on the edge
        mark.set_clip_on(False)
    axis.spines["top"].set(visible=True, bounds=(1, k))
    axis.set_xlim(1, max(k, 1 + one.critical))
    axis.set_xticks(range(1, k + 1) if k <= _MANY else [1, *range(5, k + 1, 5)])
    axis.plot([1, 1 + one.critical], [1.9, 1.9], color="0.25", lw=1.2, marker="|", ms=4, clip_on=False)
    axis.text(1 + one.critical / 2, 2.1, f"CD {one.critical:.2f}", ha="center", va="bottom", fontsize=7)
    axis.grid(False)
    return figure


def matrix(own: Sequence[Verdict], one: Across, named: Sequence[str] = ()) -> Figure:
    """Cells won and lost of each pair, rows against columns; of many filters those named, and the best of the others."""
    ranked = _by_rank(own, one)
    others = [label for label in ranked if label not in named][: _SIDE - len(named)]
    labels = [label for label in ranked if label in named or label in others]
    own = [v for v in own if v.a in labels and v.b in labels]
    won, met = np.zeros((len(labels),) * 2, dtype=int), np.zeros((len(labels),) * 2, dtype=int)
    for v in own:
        i, j = labels.index(v.a), labels.index(v.b)
        met[i, j] += 1
        met[j, i] += 1
        won[i, j] += v.winner == v.a
        won[j, i] += v.winner == v.b
    share = np.divide(won - won.T, met, out=np.full(met.shape, np.nan), where=met > 0)
    names = list(map(wrapped, labels))
    high = max(0.27, 0.11 * (1 + max(name.count("\n") for name in names)))
    figure = Figure(figsize=(COLUMN, max(COLUMN - 0.25, 1.0 + high * len(labels))), layout=roomy())
    axis = figure.subplots()
    axis.imshow(share, cmap=_blue_and_orange(), vmin=-1, vmax=1, aspect="auto")
    stars = {frozenset((p.a, p.b)) for p in one.pairs if p.winner != NO_DIFFERENCE}
    longest = max(len(f"{a}–{b}") for a, b in zip(won[met > 0], won.T[met > 0], strict=True)) + bool(stars) if met.any() else 0
    beside = 72 * COLUMN - 20 - LETTER * max(len(line) for name in names for line in name.split("\n"))
    between = "–\n" if LETTER * longest > beside / len(labels) - 1 else "–"  # two lines where a square is too narrow for one
    for i, row in enumerate(labels):
        for j, column in enumerate(labels):
            if met[i, j]:
                star = "*" if frozenset((row, column)) in stars else ""
                ink = "white" if share[i, j] > 0.55 else "black"
                said: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "linespacing": 1.0, "color": ink}
                axis.text(j, i, f"{won[i, j]}{between}{won[j, i]}{star}", **said)
    axis.set_xticks(range(len(labels)), names, rotation=40, ha="right", rotation_mode="anchor", fontsize=SMALL, linespacing=1.0)
    axis.set_yticks(range(len(labels)), names, fontsize=SMALL, linespacing=1.0)
    figure.supxlabel(f"shown better – shown worse, of {met.max()} cells", fontsize=8)  # wider than squares beside long names
    axis.grid(False)
    axis.tick_params(length=0)
    return figure


def profiles(sources: Blocks, style: Mapping[str, Look]) -> Figure:
    """Share of runs within a factor of the best filter, over the factor."""
    reach = float(np.clip(max(_worst(own) for own in sources.runs), 1.1, 100.0))
    at = np.geomspace(1.0, reach, 200)
    figure, (axis,) = stack(1, 2.1)
    for label, share in zip(sources.filters, across.profile(sources, at), strict=True):
        axis.plot(at, 100 * share, **style[label].line(label))
    axis.set(xscale="log", xlabel="RMSE over that of the best filter of the run", ylabel="runs in %", ylim=(0, 102))
    plain_ticks(axis.xaxis, at)
    legend(figure, axis)
    return figure


def forest(pairs: Sequence[Verdict]) -> Figure:
    """Ratio of RMSE and its interval, one row per pair."""
    names = [f"{v.a} / {v.b}" for v in pairs]
    if max(map(len, names)) > _LONG:
        names = [f"{broken(v.a, _LONG)}\n/ {broken(v.b, _LONG)}" for v in pairs]
    figure = Figure(figsize=(COLUMN, 0.75 + 0.17 * sum(1 + name.count("\n") for name in names)), layout=roomy())
    axis = figure.subplots()
    ends = [x for v in pairs for x in (v.low, v.ratio, v.high) if np.isfinite(x) and x > 0]
    low, high = min([*ends, 1 / (1 + pairs[0].margin)]), max([*ends, 1 + pairs[0].margin])
    edges = low / (high / low) ** 0.06, high * (high / low) ** 0.06
    axis.axvspan(1 / (1 + pairs[0].margin), 1 + pairs[0].margin, color="0.88", lw=0, zorder=0)
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    for row, v in enumerate(pairs):
        shown = v.winner != NO_DIFFERENCE
        colour = "0.35" if not shown else _BETTER if v.winner == v.a else "#B35900"
        # What lost runs decide has no finite end: the line goes on to the edge.
        left, right = (float(np.clip(x, *edges)) for x in (v.low, v.high))
        axis.plot([left, right], [row, row], color=colour, lw=1.1, zorder=2)
        axis.plot(
            float(np.clip(v.ratio, *edges)), row, ls="none", marker="s" if v.equivalent else "o", ms=4, mec=colour,
            mfc=colour if shown else "white", mew=0.9, zorder=3,
        )  # fmt: skip
    axis.set_yticks(range(len(pairs)), names, fontsize=SMALL)
    axis.set_ylim(len(pairs) - 0.4, -0.6)
    axis.set(xscale="log", xlim=edges, xlabel="ratio of RMSE")
    plain_ticks(axis.xaxis, [low, high])
    if high < 3 * low:
        axis.xaxis.set_major_locator(MaxNLocator(5))
    axis.grid(False, axis="y")
    return figure


def fronts_of(fronts: Sequence[Front], style: Mapping[str, Look]) -> Figure:
    """Median RMSE against time per step, one panel per group, the front ringed and joined.

    Named in the panel are those on the front and those in colour; the others are small and grey.
    """
    many = max(sum(kept or not style[label].quiet for label, kept in zip(f.filters, f.kept, strict=True)) for f in fronts)
    figure, panels = stack(len(fronts), 1.5 + 0.06 * many)
    for front, axis in zip(fronts, panels, strict=True):
        best = [i for i, kept in enumerate(front.kept) if kept]
        milliseconds = [1e3 * s for s in front.seconds]
        corner: Any = {"drawstyle": "steps-post", "color": "0.55", "lw": 0.9, "zorder": 1}
        axis.plot([milliseconds[i] for i in best], [front.rmse[i] for i in best], **corner)
        for label, time, error, kept in zip(front.filters, milliseconds, front.rmse, front.kept, strict=True):
            look = style[label]
            if not np.isfinite(error):
                continue
            if look.quiet:
                axis.scatter(time, error, s=9, color="0.45" if kept else look.colour, marker="o", zorder=2.5, lw=0)
            else:  # a white rim tells marks apart that lie on each other
                axis.scatter(time, error, s=26, color=look.colour, marker=look.marker, zorder=3, lw=0.4, edgecolors="white")
            if kept:
                axis.scatter(time, error, s=80, facecolors="none", edgecolors="0.2", lw=0.9, zorder=2)
        finite = [e for e in front.rmse if np.isfinite(e)]
        axis.margins(0.15)
        if any(e > 0 for e in finite):
            axis.set(xscale="log", yscale="log")
            plain_ticks(axis.yaxis, finite)
            plain_ticks(axis.xaxis, milliseconds)
        lost = [label for label, e in zip(front.filters, front.rmse, strict=True) if np.isinf(e)]
        note = f" (off the chart, half of the runs lost: {', '.join(lost)})" if lost else ""
        axis.set(title=fill(front.group + note, _TITLE), ylabel=labelled("RMSE", front.unit))
    panels[-1].set_xlabel("time per step in ms")
    if any(style[label].quiet for front in fronts for label in front.filters):
        panels[0].scatter([], [], s=9, color="0.78", marker="o", lw=0, label="other filters")
    legend(figure, panels[0])
    engine = figure.get_layout_engine()
    if engine is not None:  # where names have room is known once the panels have their places
        engine.execute(figure)
    for front, axis in zip(fronts, panels, strict=True):
        _name(axis, front, style)
    return figure


def _name(axis: Axes, front: Front, style: Mapping[str, Look]) -> None:
    """Names of those on the front and of those in colour beside their points."""
    known = [i for i, error in enumerate(front.rmse) if np.isfinite(error)]
    points = np.array([(1e3 * front.seconds[i], front.rmse[i]) for i in known])
    names = {k: front.filters[i] for k, i in enumerate(known) if front.kept[i] or not style[front.filters[i]].quiet}
    reach = np.array([6.0 if front.kept[i] else 4.0 if k in names else 2.0 for k, i in enumerate(known)])
    best = points[[k for k, i in enumerate(known) if front.kept[i]]]
    best = best[np.lexsort((-best[:, 1], best[:, 0]))]
    corners = np.repeat(best, 2, axis=0)[1:]
    corners[1::2, 1] = best[:-1, 1]  # at the error before until the next one's time
    named_beside(axis, points, {k: broken(name) for k, name in names.items()}, reach, corners)



def _starred(one: Across) -> str:
    return f" A star: Nemenyi's test across {len(one.cells)} cells shows a difference." if one.shown else ""


def _by_rank(own: Sequence[Verdict], one: Across) -> list[str]:
    """Labels by mean rank, and where there is none by comparisons won less lost."""
    labels = dict.fromkeys(label for v in own for label in (v.a, v.b))
    lost = {label: sum(label in (v.a, v.b) and v.winner != NO_DIFFERENCE for v in own) for label in labels}
    lost = {label: n - 2 * sum(v.winner == label for v in own) for label, n in lost.items()}
    return sorted(labels, key=lambda label: (_rank(one, label), lost[label]))


def _rank(one: Across, label: str) -> float:
    known = dict(zip(one.filters, one.ranks, strict=False))
    return known.get(label, float(len(known)))


def _bars(one: Across) -> int:
    """Bars of the diagram at most: one for each filter that begins a group of its own."""
    order = sorted(range(len(one.ranks)), key=lambda i: one.ranks[i])
    rank = [one.ranks[i] for i in order]
    alike = one.p_f > one.alpha
    ends = [max(j for j in range(i, len(rank)) if alike or rank[j] - rank[i] < one.critical) for i in range(len(rank))]
    return len({end for i, end in enumerate(ends) if end > i})


def _worst(own: np.ndarray) -> float:
    """Largest finite ratio to the best filter of a run."""
    best = own.min(axis=1, keepdims=True)
    known = np.isfinite(own) & (best > 0)
    return float(np.divide(own, best, out=np.ones(own.shape), where=known).max())


def _blue_and_orange() -> Any:
    return LinearSegmentedColormap.from_list("better", [_WORSE, "#ffffff", _BETTER])
