"""How the papers' figures are drawn: quantities over time with bands over runs, and against the experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench import metrics, store
from pfbench.report.canvas import Look, labelled, legend, log_if_wide, quantiles, stack, thinned, told
from pfbench.report.frame import Block

SYMLOG = " Beyond the grey lines, where there are any, the scale is logarithmic."
_BAND = (0.05, 0.5, 0.95)
_SIDE = 3  # ticks on each side of 0 that a panel has room for
Shown = Mapping[str, tuple[store.Result, Block]]


def errors(own: Shown, style: Mapping[str, Look], before: bool = False) -> Figure:
    """Signed error over time, one panel per component: what holds 90 % of the runs, and their median.

    Args:
        own: by label, with the block shown.
        style: from `looks`.
        before: adds the band of the error at the first instant.
    """
    components = list(dict.fromkeys(name for _, block in own.values() for name in block.components))
    figure, panels = stack(len(components), 1.45)
    for component, axis in zip(components, panels, strict=True):
        curves = []
        for label, (result, block) in own.items():
            if component not in block.components:
                continue
            place = block.places[block.components.index(component)]
            time, values = _known(result, result.arrays["error"][..., place])
            found = quantiles(values * block.scale, _BAND)
            _banded(axis, time, found, style[label], label, len(own))
            curves.append(found)
            if before and len(curves) == 1:  # all filters see the same worlds
                for edge in found[::2, 0]:
                    axis.axhline(edge, color="black", lw=0.9, ls=(0, (4, 2)), zorder=4)
        unit = next(block.unit for _, block in own.values())
        axis.set(title=component, ylabel=labelled("error", unit))
        _symlog_if_wide(axis, curves)
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0])
    return figure


def trace(
    own: Mapping[str, store.Result], name: str, unit: str, style: Mapping[str, Look], printed: Sequence[float]
) -> Figure:
    """A trace over time, and the limits between which it is printed to lie."""
    figure, (axis,) = stack(1, 2.0)
    for label, result in own.items():
        time, values = _known(result, result.arrays[name])
        _banded(axis, time, quantiles(values, _BAND), style[label], label, len(own))
    if np.isfinite(printed).all():
        axis.axhspan(*printed, color="0.88", lw=0, zorder=0)
    axis.set(xlabel="time in s", ylabel=unit)
    axis.set_ylim(bottom=0)
    legend(figure, axis)
    return figure


def escape(own: Mapping[str, tuple[float, int]], style: Mapping[str, Look]) -> Figure:
    """Escape factors over the iterations, by their size and the number of iterations, as meant and as printed."""
    figure, (axis,) = stack(1, 2.0)
    for label, (size, most) in own.items():
        k = np.arange(most + 1)
        axis.plot(k, size * (1.0 - np.cos(np.pi * k / most)), marker="." if most < 10 else "", **style[label].line(label))
        axis.plot(k, size - size * np.cos(np.pi * k) / most, color=style[label].colour, ls=":", lw=0.8)
    axis.set(xlabel="iteration", ylabel="c3")
    axis.set_ylim(bottom=0)
    legend(figure, axis)
    return figure


def relatives(own: Mapping[str, Mapping[str, store.Result]], style: Mapping[str, Look]) -> Figure:
    """Horizontal error in % of the range over time, one panel per experiment."""
    figure, panels = stack(len(own), 1.6)
    for (name, results), axis in zip(own.items(), panels, strict=True):
        lines = []
        for label, result in results.items():
            time, values = _known(result, _relative(result))
            found = quantiles(values, _BAND)
            _banded(axis, time, found, style[label], label, len(results))
            lines += list(found)
        axis.set(title=name, ylabel="Err in %")
        log_if_wide(axis, axis.yaxis, lines)
    panels[-1].set_xlabel("time in s")
    legend(figure, panels[0])
    return figure


def against(values: Mapping[str, Mapping[str, np.ndarray]], style: Mapping[str, Look], what: str) -> Figure:
    """Numbers of the runs [n] of each experiment and filter: median and band side by side, one place per experiment."""
    labels = list(dict.fromkeys(label for own in values.values() for label in own))
    figure, (axis,) = stack(1, 2.1)
    for i, label in enumerate(labels):
        offset = 0.7 * ((i + 0.5) / len(labels) - 0.5)
        there = [(x + offset, own[label]) for x, own in enumerate(values.values()) if label in own]
        _dots(axis, there, style[label], label)
    axis.set_xticks(range(len(values)), list(values))
    axis.set(ylabel=what, xlim=(-0.6, len(values) - 0.4))
    axis.grid(False, axis="x")
    log_if_wide(axis, axis.yaxis, [one for own in values.values() for one in own.values()])
    if axis.get_yscale() == "linear":
        axis.set_ylim(bottom=0)
    legend(figure, axis)
    return figure


def maxima(own: Shown, style: Mapping[str, Look], start: float, printed: Mapping[str, Sequence[float]]) -> Figure:
    """Largest error and RMSE of each component, one place per component, crosses where the paper prints a number."""
    components = list(dict.fromkeys(name for _, block in own.values() for name in block.components))
    places = sorted(components, key=lambda name: "NEU".find(name[-1]))  # the order in which numbers are printed
    figure, (axis,) = stack(1, 2.3)
    seen = []
    for i, (label, (result, block)) in enumerate(own.items()):
        offset = 0.75 * ((i + 0.5) / len(own) - 0.5)
        kept, late = ~result.arrays["lost"], result.arrays["time"] >= start
        peaks, sizes = [], []
        for x, component in enumerate(places):
            error = result.arrays["error"][kept][:, late][..., [block.places[block.components.index(component)]]]
            none = np.zeros(len(error), dtype=bool)
            peaks.append((x + offset - 0.05, block.scale * metrics.max_error(error, none)))
            sizes.append((x + offset + 0.05, block.scale * metrics.rmse_per_run(error, none)))
        _dots(axis, peaks, style[label], label)
        _dots(axis, sizes, style[label], "", open_=True)
        seen += [value for _, value in (*peaks, *sizes)]
        if label in printed:
            crosses: Any = {"ls": "none", "marker": "x", "ms": 6, "mew": 1.3, "color": "black", "zorder": 5}
            axis.plot([x + offset - 0.05 for x in range(len(places))], printed[label][: len(places)], **crosses)
            seen.append(np.asarray(printed[label]))
    axis.set_xticks(range(len(places)), places)
    axis.set(ylabel=labelled("error", next(block.unit for _, block in own.values())), xlim=(-0.6, len(places) - 0.4))
    axis.grid(False, axis="x")
    log_if_wide(axis, axis.yaxis, seen)
    legend(figure, axis)
    return figure


def relative(result: store.Result) -> np.ndarray:
    """Mean over time of Err of each run that was not lost, %."""
    kept = _relative(result)[~result.arrays["lost"]]
    return metrics.mean_per_run(kept, np.zeros(len(kept), dtype=bool))


def run_means(result: store.Result, name: str) -> np.ndarray:
    """Mean over time of a trace of each run that was not lost."""
    kept = result.arrays[name][~result.arrays["lost"]]
    return metrics.mean_per_run(kept, np.zeros(len(kept), dtype=bool))


def _relative(result: store.Result) -> np.ndarray:
    horizontal = result.meta["state"]["groups"]["position"][:2]  # as in the tables
    error = result.arrays["error"][..., horizontal].astype(np.float64)
    return np.asarray(100 * np.sqrt((error**2).sum(-1)) / result.arrays["range"])


def _known(result: store.Result, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Instants drawn, and values [R, T] of the runs that were not lost at them."""
    kept = values[~result.arrays["lost"]].astype(np.float64)
    there = np.flatnonzero(~np.isnan(kept).all(0))
    thin = there[thinned(there.size)]
    return result.arrays["time"][thin], kept[:, thin]


def _banded(axis: Axes, time: np.ndarray, found: np.ndarray, look: Look, label: str, among: int) -> None:
    """A median with its band; the edges are lines too, so that bands that overlap are told apart in grey."""
    low, middle, high = found
    axis.fill_between(time, low, high, color=look.colour, alpha=0.24 / (1 + among), lw=0)
    for edge in (low, high):
        axis.plot(time, edge, color=look.colour, ls=look.dash, lw=0.6)
    axis.plot(time, middle, color=look.colour, ls=look.dash, lw=look.width, label=label, marker="." if time.size == 1 else "")


def _dots(axis: Axes, there: Sequence[tuple[float, np.ndarray]], look: Look, label: str, open_: bool = False) -> None:
    """Medians with a bar over the band of each [(x, values [n])]."""
    for k, (x, values) in enumerate(there):
        known = values[np.isfinite(values)]
        if not known.size:
            continue
        low, middle, high = np.quantile(known, _BAND)
        axis.plot([x, x], [low, high], color=look.colour, lw=1.0, zorder=2)
        axis.plot(
            x, middle, ls="none", marker=look.marker, ms=4.5, color=look.colour, mfc="white" if open_ else look.colour,
            label=label if k == 0 and label else "", zorder=3,
        )  # fmt: skip


def _late(curve: np.ndarray) -> float:
    """What a filter's quantiles [q, T] come to: nine tenths of them after the first third are smaller; 0 where none is known."""
    sizes = np.abs(curve[:, curve.shape[1] // 3 :])
    known = sizes[np.isfinite(sizes)]
    return float(np.quantile(known, 0.9)) if known.size else 0.0


def _symlog_if_wide(axis: Axes, curves: Sequence[np.ndarray]) -> None:
    """A scale that shows both a start and what comes after it where the one dwarfs the other, and good filters beside bad ones.

    It is linear up to what the best filter comes to: filters that are as good are told apart there, whatever the others do.
    """
    sizes = np.concatenate([np.abs(curve).ravel() for curve in curves]) if curves else np.empty(0)
    sizes = sizes[np.isfinite(sizes)]
    late = [_late(curve) for curve in curves]
    level = min((size for size in late if size > 0), default=0.0)
    if sizes.max(initial=0.0) > 8 * level > 0:
        decades = float(np.log10(sizes.max() / level))
        axis.set_yscale("symlog", linthresh=level, linscale=max(1.2, 0.7 * decades))  # two fifths are linear at least
        for edge in (level, -level):
            axis.axhline(edge, color="0.55", lw=0.7, zorder=1)
        tens = 10.0 ** np.arange(np.floor(np.log10(level)), np.floor(np.log10(sizes.max())) + 1)
        beyond = tens[tens >= 1.5 * level]
        top = np.floor(sizes.max() / tens[-1]) * tens[-1]  # the largest number of one digit
        if not beyond.size or top > 3 * beyond[-1]:
            beyond = np.append(beyond, top)
        beyond = beyond[:: -(-beyond.size // _SIDE)]  # no more than have room
        ticks = [*(-beyond[::-1]), 0.0, *beyond]
        axis.set_yticks(ticks, told(ticks))
        axis.minorticks_off()
