"""Whether filters know how wrong they are: how often the truth lies in the regions that they give, decided once per cell.

The measure is the probability that a filter gives to values below the truth, which is uniform for one that knows what it knows.
Components and instants of one run hang together, so that runs alone are counted: intervals rest on the scatter between runs, and
the band of the rank histogram is that of as many numbers as there are runs, wide enough whatever hangs together in them [ours].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench import metrics, store
from pfbench.report.canvas import Look, legend, stack
from pfbench.report.figures import Drawing
from pfbench.report.frame import blocks
from pfbench.report.significance import share_interval

NARROW, WIDE, UNDECIDED = "too narrow", "too wide", "no departure shown"
LEVEL = 90  # per cent, of the regions by which it is decided
_BINS = 10


@dataclass(frozen=True)
class Calibrated:
    """How often the truth lay in the central 90 % regions of one filter, one group of one cell.

    Attributes:
        scenario, noise, model, group, label: where, and whose.
        share: of the components and instants scored, mean over runs that were not lost.
        low, high: its interval over runs, together with those of the other `family` - 1 of coverage 1 - alpha (Bonferroni).
        runs: that entered.
        family: groups and filters of the cell.
        seen: the regions are too narrow, too wide, or no departure is shown.
    """

    scenario: str
    noise: str
    model: str
    group: str
    label: str
    share: float
    low: float
    high: float
    runs: int
    family: int
    seen: str


def calibrated(runs: pd.DataFrame, alpha: float = 0.05) -> list[Calibrated]:
    """Of every group and filter of a cell that was scored; `runs` are its rows of `frame`."""
    own = runs[(runs.metric == f"coverage_{LEVEL}") & runs.value.notna()]
    parts = list(own.groupby(["scenario", "noise", "model", "group", "label"], sort=False).value)
    return [_judged(key, values.to_numpy(dtype=np.float64), alpha, len(parts)) for key, values in parts]


def said(found: Sequence[Calibrated], group: str) -> str:
    """What is seen of one group, in a sentence; empty where nothing was scored."""
    own = [one for one in found if one.group == group]
    parts = []
    for seen in (NARROW, WIDE):
        names = [f"{one.label} ({100 * one.share:.0f} %)" for one in own if one.seen == seen]
        if names:
            parts.append(f"{seen} for {', '.join(names)}")
    rest = [one.label for one in own if one.seen == UNDECIDED]
    if rest:
        parts.append(f"{UNDECIDED} for {', '.join(rest)}")
    return f"Central {LEVEL} % regions, by how often they hold the truth: {'; '.join(parts)}." if parts else ""


def drawings(
    results: Mapping[str, store.Result], groups: Sequence[str], style: Mapping[str, Look], alpha: float = 0.05, note: str = ""
) -> list[Drawing]:
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
    return [Drawing("calibration", text, partial(histograms, results, shown, style, alpha))]


def histograms(
    results: Mapping[str, store.Result], groups: Sequence[str], style: Mapping[str, Look], alpha: float = 0.05
) -> Figure:
    """Rank histograms as lines, one panel per group, all filters."""
    figure, panels = stack(len(groups), 1.35)
    centres = 100 * (np.arange(_BINS) + 0.5) / _BINS
    for group, axis in zip(groups, panels, strict=True):
        runs = []
        for label, (pit, lost) in _numbers(results, group).items():
            found = metrics.rank_histogram(pit, lost, _BINS)
            look = style[label]
            axis.plot(centres, 100 * found.value, marker="" if look.quiet else look.marker, ms=2.5, **look.line(label))
            runs.append(found.runs)
        low, high = metrics.share_band(1 / _BINS, max(runs), alpha)
        axis.axhspan(100 * low, 100 * high, color="0.88", lw=0, zorder=0)
        axis.axhline(100 / _BINS, color="0.4", lw=0.8, zorder=1)
        axis.set(title=group, ylabel="share in %", xlim=(0, 100), ylim=(0, None))
    panels[-1].set_xlabel("probability given to values below the truth in %")
    legend(figure, panels[0])
    return figure


def _numbers(results: Mapping[str, store.Result], group: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Probabilities below the truth [R, S, K] and lost runs [R] of each filter that has any of the group."""
    found = {}
    for label, result in results.items():
        for block in blocks(result.meta["state"]):
            if block.group == group and "pit" in result.arrays:
                pit, lost = result.arrays["pit"][..., block.places], result.arrays["lost"]
                if not np.isnan(pit[~lost]).all():
                    found[label] = pit, lost
    return found


def _judged(key: Any, values: np.ndarray, alpha: float, family: int) -> Calibrated:
    runs, share = len(values), float(values.mean())
    variance = float(values.var(ddof=1)) / runs if runs > 1 else np.nan
    if 0 < share < 1 and not variance > 0:  # one run, or all runs alike: no scatter to go by, so at most that of single cases
        variance = share * (1 - share) / runs
    low, high, _ = share_interval(share, variance, runs, 1 - alpha / family)
    seen = NARROW if high < LEVEL / 100 else WIDE if low > LEVEL / 100 else UNDECIDED
    scenario, noise, model, group, label = map(str, key)
    return Calibrated(scenario, noise, model, group, label, share, low, high, runs, family, seen)
