"""View of a board: rows of one metric, scope and baseline. Everything shown is decided here."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from pfbench.report.board.levels import FilterLevels, StudyArrays
from pfbench.results.decisions.sentence_formats import percent
from pfbench.results.decisions.words import IDENTICAL, WORSE
from pfbench.results.error_measures import Array
from pfbench.results.statistics.paired_effects import MIN_RUNS
from pfbench.results.step_times import StepTimes, describe_costs

BEST, EQUAL, OPEN, MISSING = "best", "equal", "open", "missing"
NOT_KEPT = "not_kept"  # too few runs keep track for an error
_SAME = 1e-6  # difference of levels of identical filters, and its standard error


@dataclass(frozen=True)
class ViewOptions:
    """Options of all views.

    Attributes:
        alpha: Error of all comparisons of a view together, and of each interval.
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
        low: Lower end of its interval over runs, of level 1 - alpha.
        high: Upper end.
        unit: Unit of the error.
        ratio: Error divided by that of the baseline.
        ratio_low: Lower end of its interval.
        ratio_high: Upper end.
        verdict: best, equal, open, worse, not_kept or missing.
        words: Verdict as a short text.
        track: Share of runs that keep track.
        lost: Number of lost runs.
        coverage: Coverage of 90 % intervals.
        nees: Mean NEES divided by its degrees of freedom.
        calibration: Coverage against its level: too low, consistent or too high.
        ms: Time per step, ms: the median of rounds, or one timing per job.
        ms_low: Lower quartile of the rounds.
        ms_high: Upper quartile.
        cost: Time per step divided by that of the baseline, paired by round.
        cost_low: Lower end of its interval.
        cost_high: Upper end.
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
    ms_low: float = math.nan
    ms_high: float = math.nan
    cost: float = math.nan
    cost_low: float = math.nan
    cost_high: float = math.nan


def show_row(row: BoardRow, *, has_limit: bool) -> dict[str, Any]:
    """Return the values of a row for the page.

    Args:
        row: Row.
        has_limit: Whether all scenarios of the view state a divergence threshold. Otherwise a run that is not lost
            need not keep track: the share does not exist, and a filter without an error has lost runs.
    """
    values = dict(vars(row))
    if not has_limit:
        values |= {"track": math.nan, "words": row.words.replace("track not kept", "runs lost")}
    return values


class Scope(NamedTuple):
    """Filters in the conditions of a view, before a baseline is chosen.

    Attributes:
        filters: Labels of all filters of the study, [F].
        levels: Levels of the error.
        descriptions: Track, lost runs, calibration and cost of each filter.
        unit: Unit of the error, empty for several conditions.
        is_single: Whether there is one condition.
        times: Times of the filters in rounds, by label in each condition.
    """

    filters: tuple[str, ...]
    levels: FilterLevels
    descriptions: Mapping[str, Mapping[str, Any]]
    unit: str
    is_single: bool
    times: Sequence[Mapping[str, StepTimes]] = ()


def build_rows(scope: Scope, baseline: str, options: ViewOptions) -> list[BoardRow]:
    """Build the rows of a view, ordered by level. Filters without a level follow in the order of their tracks.

    Args:
        scope: Filters in the conditions of the view.
        baseline: Label of the baseline.
        options: Options.
    """
    filters, levels = scope.filters, scope.levels
    level = levels.level
    track = np.array([scope.descriptions[label]["track"] for label in filters])
    order = np.lexsort((np.array(filters), -track, levels.off.sum(axis=1), level)).tolist()
    best = order[0] if np.isfinite(level[order[0]]) else None
    base = filters.index(baseline)
    rows = []
    for i in order:
        verdict, words = _decide(levels, i, best, filters, options)
        rows.append(
            BoardRow(
                filters[i],
                int((level < level[i] - _SAME).sum()) + 1 if np.isfinite(level[i]) else None,
                verdict in (EQUAL, OPEN),
                *_level_interval(levels, i, scope.is_single, options.alpha),
                scope.unit,
                *_ratio(levels, i, base, options.alpha),
                verdict,
                words,
                **{
                    **scope.descriptions[filters[i]],
                    **describe_costs(scope.times, filters[i], baseline, options.alpha),
                },
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
        off = levels.off[i]
        return NOT_KEPT, "track not kept" + f", {off.sum()}/{off.size}" * (off.size > 1)
    if i == best:
        return BEST, "smallest"
    estimate = levels.difference(i, best)
    if max(abs(float(estimate.value)), float(estimate.standard_error)) <= _SAME:
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


def describe_filters(runs: StudyArrays, alpha: float = 0.05) -> dict[str, dict[str, Any]]:
    """Describe track, lost runs, calibration and cost of each filter.

    Args:
        runs: Runs of the conditions of a view.
        alpha: Probability outside the interval of the coverage.
    """
    lost = np.nansum(runs.values["lost"], axis=(1, 2))
    names = ("keeps_track", "coverage_90", "nees_ratio", "ms")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # filters without runs
        by_condition = {name: np.nanmean(runs.values[name], axis=2) for name in names}
        track, coverage, nees = (np.nanmean(by_condition[name], axis=1) for name in names[:3])
        cost = np.exp(np.nanmean(np.log(by_condition["ms"]), axis=1))
        by_run = np.nanmean(runs.values["coverage_90"], axis=1)
    return {
        label: {
            "track": float(track[i]),
            "lost": int(lost[i]),
            "coverage": float(coverage[i]),
            "nees": float(nees[i]),
            "calibration": _calibration(by_run[i][~np.isnan(by_run[i])], alpha),
            "ms": float(cost[i]),
        }
        for i, label in enumerate(runs.filters)
    }


def _calibration(coverage: Array, alpha: float) -> str:
    """Return a word on the coverage [N] of 90 % regions from the interval of its mean."""
    count = coverage.size
    if count < MIN_RUNS:
        return ""
    half = -float(stdtrit(count - 1, alpha / 2)) * float(coverage.std(ddof=1)) / math.sqrt(count)
    if coverage.mean() + half < 0.9:
        return "too low"
    return "too high" if coverage.mean() - half > 0.9 else "consistent"
