"""View of a board: rows of one metric, scope and baseline. Everything shown is decided here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from pfbench.report.board.levels import FilterLevels, RunArrays, arrange_runs, compute_levels
from pfbench.results.statistics.paired_effects import MIN_RUNS

BEST, EQUAL, OPEN, WORSE, LOST, MISSING = "best", "equal", "open", "worse", "lost", "missing"
IDENTICAL = "identical"
_SAME = 1e-6  # difference of levels of identical filters


@dataclass(frozen=True)
class ViewOptions:
    """Options of all views.

    Attributes:
        alpha: Error of all comparisons of a view together.
        margin: Relative difference of errors within which filters are equal.
        planned: Words of planned pairs by (filter, other filter), which decide over those of all pairs.
    """

    alpha: float = 0.05
    margin: float = 0.05
    planned: Mapping[tuple[str, str], str] | None = None


@dataclass(frozen=True)
class BoardRow:
    """Row of a board. A value that does not exist is NaN or an empty text.

    Attributes:
        filter: Label.
        rank: Rank by level, None without a level.
        tied: Whether the filter is not shown to be worse than the best.
        value: Error, the exponential of the level; for a single condition only.
        low: Lower end of its 95 % interval over runs.
        high: Upper end.
        unit: Unit of the error.
        ratio: Error divided by that of the baseline.
        ratio_low: Lower end of its interval.
        ratio_high: Upper end.
        verdict: best, equal, open, worse, lost or missing.
        words: Verdict as a short text.
        track: Share of runs that keep track.
        lost: Number of lost runs.
        coverage: Coverage of 90 % intervals.
        nees: Mean NEES divided by its degrees of freedom.
        calibration: overconfident, consistent or cautious.
        ms: Time per step, ms.
    """

    filter: str
    rank: int | None
    tied: bool
    value: float
    low: float
    high: float
    unit: str
    ratio: float
    ratio_low: float
    ratio_high: float
    verdict: str
    words: str
    track: float
    lost: int
    coverage: float
    nees: float
    calibration: str
    ms: float


def build_rows(
    table: pd.DataFrame,
    metric: str,
    baseline: str,
    filters: tuple[str, ...],
    options: ViewOptions,
) -> list[BoardRow]:
    """Build the rows of a view, ordered by level.

    Args:
        table: Rows of `build_run_table` in the scope of the view.
        metric: Column of the error.
        baseline: Label of the baseline.
        filters: Labels of all filters of the study.
        options: Options.
    """
    runs = arrange_runs(table, metric, filters)
    levels = compute_levels(runs)
    level = levels.level
    order = sorted(range(len(filters)), key=lambda i: (np.isnan(level[i]), level[i], filters[i]))
    best = order[0] if np.isfinite(level[order[0]]) else None
    descriptions = _describe_filters(table, runs)
    unit = str(table["unit"].iloc[0]) if len(runs.weights) == 1 else ""
    rows = []
    for i in order:
        verdict, words = _decide(levels, i, best, filters, options)
        rows.append(
            BoardRow(
                filters[i],
                int((level < level[i] - _SAME).sum()) + 1 if np.isfinite(level[i]) else None,
                verdict in (EQUAL, OPEN),
                *_level_interval(levels, i, len(runs.weights) == 1, options.alpha),
                unit,
                *_ratio(levels, i, filters.index(baseline), options.alpha),
                verdict,
                words,
                **descriptions[filters[i]],
            )
        )
    return rows


def _decide(
    levels: FilterLevels, i: int, best: int | None, filters: tuple[str, ...], options: ViewOptions
) -> tuple[str, str]:
    """Return the verdict on a filter against the best, and its words."""
    if np.isnan(levels.level[i]):
        return MISSING, "not run in all conditions"
    if best is None or not np.isfinite(levels.level[i]):
        return LOST, "decided by lost track"
    if i == best:
        return BEST, "smallest"
    estimate = levels.difference(i, best)
    if abs(float(estimate.value)) <= _SAME and not estimate.standard_error:
        return EQUAL, IDENTICAL
    runs = int(min(levels.runs[i], levels.runs[best]))
    if runs < MIN_RUNS:
        return OPEN, f"{runs} {'run' if runs == 1 else 'runs'}"
    pairs = len(filters) * (len(filters) - 1) / 2
    low, high = map(float, estimate.interval(options.alpha / pairs))
    planned = (options.planned or {}).get((filters[i], filters[best]), "")
    if low > 0 or planned == WORSE:
        return (WORSE, f"+{percent(float(estimate.value))} %") if planned != BEST else (OPEN, "")
    if high < math.log1p(options.margin) or planned == "equivalent":
        return EQUAL, f"within {percent(math.log1p(options.margin))} %"
    return OPEN, f"{_signed(low)} to {_signed(high)} %"


def percent(log_ratio: float) -> str:
    """Format a log ratio as a change in percent with two digits, without its sign.

    Args:
        log_ratio: Log ratio.
    """
    value = abs(100 * math.expm1(min(log_ratio, 20.0)))
    digits = 0 if value >= 10 else 1 if value >= 1 else 2
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"


def _signed(log_ratio: float) -> str:
    return f"{'-' if log_ratio < 0 else '+'}{percent(log_ratio)}"


def _level_interval(
    levels: FilterLevels, i: int, is_single: bool, alpha: float
) -> tuple[float, float, float]:
    """Return the error of a filter and its interval, NaN for several conditions."""
    if not is_single or not np.isfinite(levels.level[i]):
        return math.nan, math.nan, math.nan
    low, high = levels.single(i).interval(alpha)
    return float(np.exp(levels.level[i])), float(np.exp(low)), float(np.exp(high))


def _ratio(levels: FilterLevels, i: int, base: int, alpha: float) -> tuple[float, float, float]:
    """Return the ratio to the baseline and its interval."""
    if not np.isfinite(levels.level[[i, base]]).all():
        return math.nan, math.nan, math.nan
    estimate = levels.difference(i, base)
    with np.errstate(over="ignore"):
        low, high = (float(np.exp(end)) for end in estimate.interval(alpha))
        return float(np.exp(estimate.value)), low, high


def _describe_filters(table: pd.DataFrame, runs: RunArrays) -> dict[str, dict[str, Any]]:
    """Return track, lost runs, calibration and cost of each filter."""
    by_condition = table.groupby(["filter", "family", "scenario", "regime"], sort=False)
    columns = ["keeps_track", "coverage_90", "nees_ratio"]
    mean = by_condition[columns].mean().groupby("filter").mean()
    by_run = table.groupby(["filter", "seed", "run"], sort=False)["coverage_90"].mean()
    spread = by_run.groupby("filter").agg(["mean", "std", "count"])
    lost = table.groupby("filter")["lost"].sum()
    cost = np.exp(np.log(table.groupby(["filter", "scenario", "regime"])["ms"].first()).groupby("filter").mean())  # fmt: skip
    return {
        label: {
            "track": float(mean["keeps_track"].get(label, np.nan)),
            "lost": int(lost.get(label, 0)),
            "coverage": float(mean["coverage_90"].get(label, np.nan)),
            "nees": float(mean["nees_ratio"].get(label, np.nan)),
            "calibration": _calibration(pd.Series(spread.loc[label]))
            if label in spread.index
            else "",
            "ms": float(cost.get(label, np.nan)),
        }
        for label in runs.filters
    }


def _calibration(coverage: pd.Series[Any]) -> str:
    """Return a word on the coverage of 90 % intervals over runs, from its 95 % interval."""
    count = float(coverage["count"])
    if count < MIN_RUNS:
        return ""
    half = -float(stdtrit(count - 1, 0.025)) * float(coverage["std"]) / math.sqrt(count)
    if coverage["mean"] + half < 0.9:
        return "overconfident"
    return "cautious" if coverage["mean"] - half > 0.9 else "consistent"
