"""Figures of a cell, in physical units: each is one column of a paper wide and survives printing in grey."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
import seaborn as sns
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench import metrics, store
from pfbench.report import vector
from pfbench.report.canvas import (
    COLUMN,
    INSTANTS,
    RC,
    SMALL,
    Look,
    broken,
    indexed,
    jitter,
    labelled,
    legend,
    log_if_wide,
    plain_ticks,
    quantiles,
    slug,
    stack,
    thinned,
    zoom,
)
from pfbench.report.frame import Block, blocks, in_use

Results = Mapping[str, store.Result]

_FEW = 4  # filters of which each has a picture of its spread; of more, two have, chosen by `worth_a_spread` [ours]
_BOUND: Any = {"color": "black", "ls": (0, (3, 1.2)), "lw": 0.8, "zorder": 4}
_NARROW = 120  # instants of a panel of half a column
_MEDIAN = 0.6745  # of the absolute value of a standard normal number
_LETTERS = 30  # beside a panel, as high as one of these figures
_BOXES = 12  # filters that a figure of boxes and points holds; more have a row each, by rank
_TRACES = {  # what a trace shows, the unit, and whether it is a share of the particles
    "ess": ("effective sample size", "% of N", True),
    "ancestors": ("number of distinct ancestors after resampling", "% of N", True),
    "unique": ("number of unique particles after moves", "% of N", True),
    "particles": ("number of particles", "", False),
    "iterations": ("iterations until the swarm stopped", "", False),
    "accepted_0": ("share of moves that were accepted, where there were any", "", False),
}


class Drawing(NamedTuple):
    """One figure, drawn when asked for.

    Attributes:
        name: of its files, without folder and ending.
        caption: what is seen.
        make: draws it.
    """

    name: str
    caption: str
    make: Callable[[], Figure]


def drawings(
    results: Results,
    runs: pd.DataFrame,
    style: Mapping[str, Look],
    groups: Sequence[str],
    alpha: float = 0.05,
    *,
    brief: bool = False,
    note: str = "",
) -> list[Drawing]:
    """All figures that a cell has data for.

    Args:
        results: by label, whole.
        runs: rows of `frame` of this cell.
        style: from `looks`, or from `dimmed`.
        groups: names of the blocks shown.
        alpha: probability outside the NEES band.
        brief: leave out the track, NIS, cost, the traces and the spread of single filters.
        note: on who is drawn how, for captions of figures with a line per filter.
    """
    shown = [block for block in _all_blocks(results) if block.group in groups]
    if not shown:
        return []
    wholes = list(dict.fromkeys(block.whole for block in shown))
    kept = "runs that were not lost"
    found = []
    row = None if brief else _common_run(results)
    if row is not None and any("track" in r.arrays and _east_north_up(r.meta["state"]) for r in results.values()):
        number = row + int(next(iter(results.values())).meta.get("first_run", 0))
        text = f"True and estimated track of run {number}, the first that no filter lost: plan view and height.{note}"
        found.append(Drawing("track", text, partial(track, results, row, style)))
    for block in shown:
        text = f"Absolute error of {block.group} over time, median of the {kept}."
        if any(bound_of(result) is not None for result in results.values()):
            text += " Dashed black: what the median is of a normal error that reaches the Cramer-Rao bound."
        found.append(Drawing(f"error_{slug(block.group)}", text + note, partial(error, results, block, style)))
    if len(results) > _BOXES:
        text = f"RMSE of each run, filters by their median: median (dot), quartiles and 5 to 95 % of the {kept}."
    else:
        text = f"RMSE of each run: quartiles, whiskers to 1.5 quartile ranges, one point for each of the {kept}."
    found.append(Drawing("rmse", text, partial(rmse, runs, [block.group for block in shown], style)))
    text = f"NEES averaged over the {kept}, with its two-sided {100 * (1 - alpha):g} % chi-square band.{note}"
    found.append(Drawing("nees", text, partial(nees, results, wholes, style, alpha)))
    if not brief and any(_innovations(result) is not None for result in results.values()):
        text = (
            f"NIS, the normalised innovation squared per component seen, over the {kept} at the instants scored, with its "
            f"two-sided {100 * (1 - alpha):g} % chi-square band; 1 when measurements are as far from what was predicted as the "
            f"filter says.{note}"
        )
        found.append(Drawing("nis", text, partial(nis, results, style, alpha)))
    if not brief and len(results) > 1:
        text = (
            "What a filter costs: time per step of all runs together, and memory that its job took beyond what was held before. "
            "Each is measured once, on one machine, and has no band."
        )
        found.append(Drawing("cost", text, partial(cost, results, style)))
    traces = [name for name in _TRACES if any(name in result.arrays for result in results.values())]
    for name in () if brief else traces:
        what = _TRACES[name][0]
        text = f"{what[0].upper()}{what[1:]}, median and 5 to 95 % of the {kept}.{note}"
        found.append(Drawing(name, text, partial(trace, results, name, style)))
    for label, why in ({} if brief else worth_a_spread(results, runs, groups)).items():
        result = results[label]
        text = (
            f"{label}{why}: error over time, median and 5 to 95 % of the {kept} (shaded), and three times the filter's own "
            f"standard deviation, median over runs (dashed). The first fifth is cut where it dwarfs the rest."
        )
        if bound_of(result) is not None:
            text += " Thin black: three times the Cramer-Rao bound."
        found.append(Drawing(f"spread_{slug(label)}", text, partial(spread, result, groups, style[label])))
    return found


def worth_a_spread(results: Results, runs: pd.DataFrame, groups: Sequence[str]) -> dict[str, str]:
    """Filters whose spread is drawn, and why: every one where they are few, else the most and the least believable [ours].

    Of more than four filters these are the one with the smallest median RMSE, of the position where it is shown and else of the
    first group, and the one whose NEES is farthest from its degrees of freedom in any group, as a ratio, median over runs.
    """
    drawable = {
        label: block
        for label, result in results.items()
        if not result.arrays["lost"].all() and (block := _main(result.meta["state"], groups)) is not None
    }
    if len(drawable) <= _FEW:
        return dict.fromkeys(drawable, "")
    rmse_of, nees_of = {}, {}
    for label, block in drawable.items():
        own = runs[runs.label == label]
        rmse_of[label] = _middle(own[(own.metric == "rmse") & (own.component == "norm") & (own.group == block.group)])
        nees_of[label] = _off(own[own.metric == "nees"], results[label].meta["state"], groups)
    chosen: dict[str, str] = {}
    for value, better, said in (
        (rmse_of, min, "the smallest median RMSE of {}"),
        (nees_of, max, "the NEES farthest from its degrees of freedom, of any group"),
    ):
        known = {label: number for label, number in value.items() if not np.isnan(number)}
        if known:
            label = better(known, key=lambda name: known[name])
            of = said.format(drawable[label].group)
            chosen[label] = f"{chosen[label]} and {of}" if label in chosen else f", of {len(drawable)} filters the one with {of}"
    return chosen


def save(drawing: Drawing, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draws and writes one file per format; the same drawing gives the same bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(RC):
        figure = drawing.make()
        engine = figure.get_layout_engine()
        if engine is not None:  # laid out once and not by each format anew, which would be most of the work
            engine.execute(figure)
            figure.set_layout_engine(None)
        paths = [folder / f"{drawing.name}.{ending}" for ending in formats]
        for path, ending in zip(paths, formats, strict=True):
            if ending == "png":
                path.write_bytes(indexed(figure))
            else:
                path.write_text(vector.drawn(figure), encoding="utf-8")
    return paths


def track(results: Results, row: int, style: Mapping[str, Look]) -> Figure:
    """Plan view and height over time of one run, row of the arrays."""
    figure = Figure(figsize=(COLUMN, 4.8), layout="constrained")
    plan, height = figure.subplots(2, 1, height_ratios=(2.2, 1))
    first = next(result for result in results.values() if "track" in result.arrays)
    time, truth = first.arrays["time"], first.arrays["track"][row].astype(np.float64)
    plan.plot(truth[:, 0], truth[:, 1], color="0.75", lw=4, solid_capstyle="round", label="truth")
    height.plot(time, truth[:, 2], color="0.75", lw=4, solid_capstyle="round")
    plan.plot(*truth[0, :2], marker="o", mfc="white", color="0.3", ls="none", zorder=5, label="start")
    for label, result in results.items():
        axes = _east_north_up(result.meta["state"])
        if axes is None or "track" not in result.arrays:
            continue
        off = result.arrays["error"][row][:, axes[0]].astype(np.float64) * axes[1]
        estimate = result.arrays["track"][row] + off
        known = ~np.isnan(estimate).any(-1)  # rare steps would leave gaps in which no line shows
        plan.plot(estimate[known, 0], estimate[known, 1], **style[label].line(label))
        height.plot(result.arrays["time"][known], estimate[known, 2], **style[label].line())
    plan.set(xlabel="east in m", ylabel="north in m")
    plan.set_aspect("equal", adjustable="datalim")
    plan.locator_params(axis="x", nbins=4)
    height.set(xlabel="time in s", ylabel="height in m")
    legend(figure, plan)
    return figure


def error(results: Results, block: Block, style: Mapping[str, Look]) -> Figure:
    """Median absolute error over time, one panel per component, all filters."""
    figure, panels = stack(len(block.components), 1.3)
    for label, result in results.items():
        own = result.meta["state"]["names"]
        for name, axis in zip(block.components, panels, strict=True):
            if name in own:
                time, (values,) = _kept(result, own.index(name), "error", most=style[label].instants)
                middle = quantiles(np.abs(values) * block.scale, [0.5])[0]
                axis.plot(time, middle, marker=_mark(time), **style[label].line(label))
    for name, axis in zip(block.components, panels, strict=True):
        for time, sd in _bounds(results, name):
            axis.plot(time, _MEDIAN * sd * block.scale, label="Cramer-Rao bound", marker=_mark(time), **_BOUND)
    for name, axis in zip(block.components, panels, strict=True):
        axis.set(title=name, ylabel=labelled("|error|", block.unit))
        log_if_wide(axis, axis.yaxis, [np.asarray(line.get_ydata()) for line in axis.lines])
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0])
    return figure


def spread(result: store.Result, groups: Sequence[str], look: Look) -> Figure:
    """Error of one filter over time with its own three-sigma bounds, one panel per component, a row per group."""
    rows = [
        (block, range(start, min(start + 3, len(block.places))))
        for block in blocks(result.meta["state"])
        if block.group in groups
        for start in range(0, len(block.places), 3)
    ]
    columns = max(len(own) for _, own in rows)
    figure = Figure(figsize=(max(COLUMN, 2.4 * columns), 0.2 + 1.45 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), columns, squeeze=False, sharex=True)
    for line, (block, own) in zip(panels, rows, strict=True):
        for axis, k in zip(line, own, strict=False):
            place = block.places[k]
            time, (errors, sds) = _kept(result, place, "error", "sd", most=_NARROW)
            low, middle, high = quantiles(errors * block.scale, [0.05, 0.5, 0.95])
            own_sd = 3 * quantiles(sds * block.scale, [0.5])[0]
            axis.fill_between(time, low, high, color=look.colour, alpha=0.3, lw=0, label="5 to 95 % of runs")
            axis.plot(time, middle, color=look.colour, lw=1, label="median error", marker=_mark(time))
            axis.plot(time, own_sd, color=look.colour, ls="--", lw=1, label="3 sigma of the filter", marker=_mark(time))
            axis.plot(time, -own_sd, color=look.colour, ls="--", lw=1, marker=_mark(time))
            for instants, sd in _bounds({"": result}, block.components[k]):
                for sign in (1, -1):
                    axis.plot(instants, sign * 3 * sd * block.scale, label="3 sigma of the bound" if sign > 0 else "", **_BOUND)
            axis.set_title(block.components[k])
            zoom(axis, [low, high, own_sd, -own_sd])
        line[0].set_ylabel(labelled("error", block.unit))
        for axis in line[len(own) :]:
            axis.set_visible(False)
    for axis in panels[-1]:
        axis.set_xlabel("time in s")
    legend(figure, panels[0][0], columns=3)
    return figure


def rmse(runs: pd.DataFrame, groups: Sequence[str], style: Mapping[str, Look]) -> Figure:
    """RMSE of the norm of each group: one box per filter and one point per run, or of many filters one row each."""
    rows = runs[(runs.metric == "rmse") & (runs.component == "norm")]
    labels = [label for label in style if (rows.label == label).any()]
    many = len(labels) > _BOXES
    figure, panels = stack(len(groups), 0.55 + (0.125 if many else 0.3) * len(labels), sharex=False)
    for group, axis in zip(groups, panels, strict=True):
        own = rows[rows.group == group]
        kept = own[np.isfinite(own.value)]
        middle = own.groupby("label").value.median()  # a lost run is worse than any other
        order = sorted(labels, key=lambda label: (middle.get(label, np.inf), label)) if many else labels
        (_rows if many else _boxes)(axis, kept, order, style)
        for place, label in enumerate(order):
            lost = int(own.lost[own.label == label].sum())
            if lost:
                place_of = axis.get_yaxis_transform()
                size = SMALL if many else 7
                axis.text(1.01, place, f"{lost} lost", transform=place_of, ha="left", va="center", fontsize=size)
        # Said again because a filter that lost every run has no box, and its row must stay.
        axis.set_yticks(range(len(order)), list(map(broken, order)), fontsize=SMALL if many else None)
        axis.set_ylim(len(order) - 0.5, -0.5)
        unit = str(own.unit.iloc[0]) if len(own) else ""
        axis.set(title=group, xlabel=labelled("RMSE per run", unit), ylabel="")
        log_if_wide(axis, axis.xaxis, [kept.value.to_numpy()])
    return figure


def _boxes(axis: Axes, kept: pd.DataFrame, labels: Sequence[str], style: Mapping[str, Look]) -> None:
    colours = {label: style[label].colour for label in labels}
    sns.boxplot(
        kept, x="value", y="label", hue="label", order=labels, hue_order=labels, palette=colours, legend=False,
        orient="h", width=0.6, fliersize=0, linewidth=0.8, saturation=1, boxprops={"alpha": 0.45}, ax=axis,
    )  # fmt: skip
    for place, label in enumerate(labels):
        value = kept.value[kept.label == label].to_numpy()
        axis.scatter(value, place + jitter(value.size), s=5, color="0.15", alpha=0.55, lw=0, zorder=3)


def _rows(axis: Axes, kept: pd.DataFrame, labels: Sequence[str], style: Mapping[str, Look]) -> None:
    """Quartiles on a thin line from 5 to 95 %, the median a dot; named filters in their colour."""
    found: dict[str, list[tuple[int, np.ndarray]]] = {}
    for place, label in enumerate(labels):
        value = kept.value[kept.label == label].to_numpy()
        if value.size:
            colour = "0.45" if style[label].quiet else style[label].colour
            found.setdefault(colour, []).append((place, np.quantile(value, [0.05, 0.25, 0.5, 0.75, 0.95])))
    for colour, own in found.items():  # one line, with gaps, of all that look alike: it takes less room in a file
        places = np.array([[place, place, np.nan] for place, _ in own]).ravel()
        for low, high, width in ((0, 4, 0.8), (1, 3, 3.0)):
            ends = np.array([[q[low], q[high], np.nan] for _, q in own]).ravel()
            axis.plot(ends, places, color=colour, lw=width, solid_capstyle="butt", zorder=2 + 0.1 * (low == 1))
    middle = [(q[2], place) for own in found.values() for place, q in own]
    if middle:
        axis.plot(*np.array(middle).T, marker="o", ms=3.2, mfc="white", mec="black", mew=0.7, ls="none", zorder=3)


def nees(results: Results, groups: Sequence[str], style: Mapping[str, Look], alpha: float = 0.05) -> Figure:
    """NEES averaged over runs with the chi-square band of as many runs, one panel per group."""
    figure, panels = stack(len(groups), 1.4)
    for group, axis in zip(groups, panels, strict=True):
        lines, bands = [], []
        for label, result in results.items():
            own = result.meta["state"]["groups"]
            if group in own:
                dof = len(own[group])
                place = list(own).index(group)
                found = metrics.consistency(result.arrays["nees"][..., place], result.arrays["lost"], dof, alpha)
                thin = _thin(found.runs_at > 0, style[label].instants)
                time = result.arrays["time"][thin]
                look = style[label]._replace(width=0.8 * style[label].width)
                axis.plot(time, found.average[thin], marker=_mark(time), **look.line(label))
                lines.append(found.average)
                bands.append((found.runs, time, found.low[thin], found.high[thin], dof))
        _, time, low, high, dof = max(bands, key=lambda band: band[0])
        axis.fill_between(time, low, high, color="0.8", lw=0, zorder=0)
        for edge in (low, high):
            axis.plot(time, edge, color="0.35", lw=0.7, zorder=4)
        axis.set(title=f"{group}, {dof} degrees of freedom", ylabel="mean NEES")
        log_if_wide(axis, axis.yaxis, lines)
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0])
    return figure


def nis(results: Results, style: Mapping[str, Look], alpha: float = 0.05) -> Figure:
    """NIS per component seen, of all runs together, with the chi-square band of as many components."""
    figure, (axis,) = stack(1, 1.6)
    lines, bands = [], []
    for label, result in results.items():
        own = _innovations(result)
        if own is not None:
            time, squared, seen = own
            look = style[label]
            axis.plot(time, squared / seen, marker="" if look.quiet else look.marker, ms=2.5, **look.line(label))
            lines.append(squared / seen)
            bands.append((float(seen.sum()), time, *metrics.nees_band(1, seen, alpha)))
    _, time, low, high = max(bands, key=lambda band: band[0])
    axis.fill_between(time, low, high, color="0.8", lw=0, zorder=0)
    for edge in (low, high):
        axis.plot(time, edge, color="0.35", lw=0.7, zorder=4)
    axis.set(xlabel="time in s", ylabel="NIS per component")
    log_if_wide(axis, axis.yaxis, lines)
    legend(figure, axis)
    return figure


def cost(results: Results, style: Mapping[str, Look]) -> Figure:
    """Time per step and memory of each filter, a row each."""
    labels = list(results)
    milliseconds = [1e3 * results[label].meta["seconds"]["per_step"] for label in labels]
    mebibytes = [(results[label].meta.get("memory") or np.nan) / 2**20 for label in labels]
    shown = [("time per step in ms", milliseconds), ("memory in MiB", mebibytes)]
    shown = [(name, values) for name, values in shown if not np.isnan(values).all()]
    figure = Figure(figsize=(COLUMN, 0.6 + 0.16 * sum(1 + broken(label).count("\n") for label in labels)), layout="constrained")
    panels = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    for axis, (name, values) in zip(panels, shown, strict=True):
        for row, (label, value) in enumerate(zip(labels, values, strict=True)):
            axis.plot([0, value], [row, row], color="0.8", lw=0.8, zorder=1)
            axis.plot(value, row, ls="none", marker=style[label].marker, color=style[label].colour, ms=4)
        known = np.array([value for value in values if value > 0])
        axis.set_xlim(0, 1.1 * known.max(initial=1e-9))
        axis.set(xlabel=name, yticks=range(len(labels)), yticklabels=list(map(broken, labels)))
        axis.tick_params(axis="y", labelsize=SMALL)
        if known.size and known.max() > 10 * known.min():
            axis.set_xscale("log")
            axis.set_xlim(known.min() / 1.5, 1.5 * known.max())
            plain_ticks(axis.xaxis, known, narrow=True)
        axis.grid(False, axis="y")
    panels[0].set_ylim(len(labels) - 0.5, -0.5)
    return figure


def trace(results: Results, name: str, style: Mapping[str, Look]) -> Figure:
    """One trace of the filters that leave it over time."""
    what, unit, share = _TRACES[name]
    unit = unit.replace(" ", "\N{NO-BREAK SPACE}")
    figure, (axis,) = stack(1, 2.2)
    for label, result in results.items():
        if name in result.arrays and (result.meta.get("particles") or not share):
            whole = 100 * result.arrays[name] / in_use(result) if share else result.arrays[name]
            shown = result._replace(arrays={**result.arrays, name: whole})
            time, (values,) = _kept(shown, None, name, most=style[label].instants)
            low, middle, high = quantiles(values, [0.05, 0.5, 0.95])
            if not style[label].quiet:
                axis.fill_between(time, low, high, color=style[label].colour, alpha=0.18, lw=0)
            axis.plot(time, middle, marker=_mark(time), **style[label].line(label))
    axis.set(xlabel="time in s", ylabel=fill(labelled(what.partition(",")[0], unit), _LETTERS))
    axis.set_ylim(bottom=0)
    legend(figure, axis)
    return figure


def _innovations(result: store.Result) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Instants scored, and NIS and components seen there summed over the runs that were not lost; None where there are none."""
    arrays = result.arrays
    if "nis" not in arrays or "scored" not in arrays:
        return None
    kept = ~arrays["lost"]
    squared, seen = (np.asarray(arrays[name], dtype=np.float64)[kept] for name in ("nis", "nis_dof"))
    known = ~(np.isnan(squared) | np.isnan(seen))
    squared, seen = np.where(known, squared, 0.0), np.where(known, seen, 0.0)
    there = seen.sum(0) > 0
    if not there.any():
        return None
    return arrays["time"][arrays["scored"][there]], squared.sum(0)[there], seen.sum(0)[there]


def bound_of(result: store.Result) -> np.ndarray | None:
    """Standard deviations [T, d] of the Cramer-Rao bound, where the job has one."""
    return result.arrays.get("bound")


def _bounds(results: Results, component: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Instants at which the component is scored and the bound there: at most one, for all filters see the same worlds."""
    for result in results.values():
        sd, own = bound_of(result), result.meta["state"]["names"]
        if sd is not None and component in own:
            place = own.index(component)
            thin = _thin(~np.isnan(result.arrays["error"][..., place]).all(0))
            return [(result.arrays["time"][thin], sd[thin, place].astype(np.float64))]
    return []


def _kept(result: store.Result, place: int | None, *names: str, most: int = INSTANTS) -> tuple[np.ndarray, list[np.ndarray]]:
    """Instants and values [R, T] of the runs that were not lost, thinned; of one place in the state, or of a whole trace.

    Instants at which no run knows the first of them are left out before: where truth is rare, thinning would miss it.
    """
    kept = ~result.arrays["lost"]
    values = [result.arrays[name][kept] if place is None else result.arrays[name][kept][..., place] for name in names]
    thin = _thin(~np.isnan(values[0]).all(0), most)
    return result.arrays["time"][thin], [value[:, thin].astype(np.float64) for value in values]


def _thin(known: np.ndarray, most: int = INSTANTS) -> np.ndarray:
    """Indices of the instants drawn, of those that are known [T]."""
    there = np.flatnonzero(known)
    return there[thinned(there.size, most)]


def _mark(time: np.ndarray) -> str:
    """One instant makes no line."""
    return "." if time.size == 1 else ""


def _all_blocks(results: Results) -> list[Block]:
    found: dict[str, Block] = {}
    for result in results.values():
        for block in blocks(result.meta["state"]):
            found.setdefault(block.group, block)
    return list(found.values())


def _main(state: Mapping[str, Any], groups: Sequence[str]) -> Block | None:
    """The position where it is shown, else the first group that is."""
    own = [block for block in blocks(state) if block.group in groups]
    return next((block for block in own if block.group == "position"), own[0] if own else None)


def _off(nees: pd.DataFrame, state: Mapping[str, Any], groups: Sequence[str]) -> float:
    """Largest distance of the median NEES of a shown group from its degrees of freedom, on the logarithm."""
    wholes = {block.whole for block in blocks(state) if block.group in groups}
    with np.errstate(divide="ignore"):
        off = [abs(np.log(_middle(nees[nees.group == whole]) / len(state["groups"][whole]))) for whole in sorted(wholes)]
    known = [value for value in off if not np.isnan(value)]
    return float(max(known)) if known else np.nan


def _middle(rows: pd.DataFrame) -> float:
    known = rows.value.dropna()
    return float(known.median()) if len(known) else np.nan


def _common_run(results: Results) -> int | None:
    """Row of the first run that no filter lost, or None."""
    lost = [result.arrays["lost"] for result in results.values()]
    if len({flags.size for flags in lost}) > 1 or np.any(lost, axis=0).all():
        return None
    return int(np.argmin(np.any(lost, axis=0)))


def _east_north_up(state: Mapping[str, Any]) -> tuple[list[int], np.ndarray] | None:
    """Where position_E, position_N and position_U (or D, with its sign) stand in the state."""
    names = {str(name): i for i, name in enumerate(state["names"])}
    up = "position_U" if "position_U" in names else "position_D"
    wanted = ["position_E", "position_N", up]
    if not all(name in names for name in wanted):
        return None
    return [names[name] for name in wanted], np.array([1.0, 1.0, 1.0 if up == "position_U" else -1.0])
