"""View of a board: rows of one metric, scope and baseline. Everything shown is decided here."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from pfbench.report.board.levels import FilterLevels, StudyArrays
from pfbench.results.looks import MethodLook
from pfbench.results.step_times import StepTimes, describe_costs
from pfbench.stats.decision import IDENTICAL, WORSE
from pfbench.stats.effects import MIN_RUNS
from pfbench.stats.error_measures import Array
from pfbench.stats.sentences import format_digits, percent

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
    """Return the values of a row for the page."""
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
    """Build the rows of a view, ordered by level. Filters without a level follow in the order of their tracks."""
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
    """Describe track, lost runs, calibration and cost of each filter."""
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


# --------------------------------------------------------------------------------------------------
# The sentence of a view, and its small print.

TrackInterval = Callable[[str, str], tuple[float, float]]  # of two labels

_MOST_NAMES = 3  # in a sentence
# words where no divergence threshold says whether a track is kept
_LOST_WORDS = {
    "does not keep track in": "is lost in",
    "do not keep track in": "are lost in",
    r"Track is kept by (.*?) in (\d+ %) and by (.*?) in (\d+ %) of runs": r"Runs that are not lost: \1 \2, \3 \4",
}
_LOST_SHARE = 0.2  # share of runs off track from which a filter is counted


def describe_view(
    rows: Sequence[BoardRow],
    looks: Mapping[str, MethodLook],
    baseline: str,
    scope: str,
    metric: str,
    level: str = "95 %",
    track_interval: TrackInterval | None = None,
    *,
    has_limit: bool = True,
) -> str:
    """Describe a view: failures, the best filter, the best proposed method, ties.

    Returns sentences. Names of filters are enclosed in double square brackets.
    """
    ranked = [row for row in rows if row.rank is not None]
    failures = _describe_failures(rows, looks)
    tracks = _describe_tracks(rows, looks, baseline, level, track_interval)
    if not has_limit:
        failures, tracks = map(name_lost_runs, (failures, tracks))
    if not ranked:
        return f"{failures} No filter has an error to compare {scope}. {tracks}".strip()
    if len(rows) == 1:
        row = rows[0]
        value = "" if math.isnan(row.value) else f" of {row.value:.3g} {row.unit}".rstrip()
        return f"{failures} {_name(row, looks)} has a {metric}{value} {scope}. It is the only filter.".strip()
    return " ".join(
        filter(
            None,
            [
                failures,
                _describe_best(ranked, rows, looks, baseline, (f"{metric} {scope}", level)),
                tracks,
                _describe_proposed(ranked, looks),
                _describe_ties(ranked),
            ],
        )
    )


def count_words(number: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def count_failing(number: int, total: int) -> str:
    """Format the subject and verb of a sentence on the filters that do not keep track."""
    verb = "does" if number == 1 else "do"
    return f"{number} of {count_words(total, 'filter')} {verb} not keep track"


def name_lost_runs(text: str) -> str:
    """Replace the words on tracks in a sentence on conditions without a divergence threshold."""
    for words, lost in _LOST_WORDS.items():
        text = re.sub(words, lost, text)
    return text


def _name(row: BoardRow, looks: Mapping[str, MethodLook]) -> str:
    return f"[[{looks[row.filter].name}]]"


def _format_ends(low: float, high: float) -> str:
    """Format the ends of an interval with two significant digits."""
    return f"{format_digits(low, 2)} to {format_digits(high, 2)}"


def _join(names: Sequence[str]) -> str:
    """List up to three names in words, and count the others."""
    if len(names) > _MOST_NAMES:
        others = count_words(len(names) - _MOST_NAMES + 1, "more filter")
        names = [*names[: _MOST_NAMES - 1], others]
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _describe_failures(rows: Sequence[BoardRow], looks: Mapping[str, MethodLook]) -> str:
    """Count the filters that do not keep track in many runs, or were not run."""
    off = [r for r in rows if r.verdict != MISSING and 1 - r.track > _LOST_SHARE]
    missing = [_name(row, looks) for row in rows if row.verdict == MISSING]
    without = sum(row.verdict == NOT_KEPT for row in rows)
    text = ""
    if off:
        worst = min(off, key=lambda row: row.track)
        share = f"{100 * (1 - worst.track):.0f} %"
        if len(off) == 1:
            text = f"{_name(worst, looks)} does not keep track in {share} of runs."
        else:
            text = (
                f"{count_failing(len(off), len(rows))} in over a fifth of runs "
                f"({_name(worst, looks)}: in {share})."
            )
    if without > len(off):
        text += (
            f" {count_failing(without, len(rows))} in over a fifth of the runs "
            f"of at least one condition: {'its error is' if without == 1 else 'their errors are'} not compared."
        )
    if missing:
        verb = "was" if len(missing) == 1 else "were"
        text += f" {_join(missing)} {verb} not run in all conditions."
    return text.strip()


def _describe_best(
    ranked: Sequence[BoardRow],
    rows: Sequence[BoardRow],
    looks: Mapping[str, MethodLook],
    baseline: str,
    texts: tuple[str, str],
) -> str:
    """State the filter of the smallest error against the baseline, with metric and level as text."""
    where, level = texts
    best = ranked[0]
    base = next(row for row in rows if row.filter == baseline)
    twins = [row for row in ranked if row.words == IDENTICAL]
    names = _join([_name(row, looks) for row in (best, *twins)])
    head = f"{names} {'have' if twins else 'has'} the smallest {where}"
    head = f"Of the {len(ranked)} others, {head}" if 1 < len(ranked) < len(rows) else head
    if twins:
        head += " (identical results)"
    if baseline in (best.filter, *(row.filter for row in twins)):
        return f"{head}. {_describe_next(ranked, base, looks, level)}".rstrip()
    if math.isnan(best.ratio):
        state = "tracks not kept" if base.verdict == NOT_KEPT else "missing runs"
        return f"{head}. The baseline {_name(base, looks)} has no error because of {state}."
    size = f"{_format_size(best.ratio)} below {_name(base, looks)}"
    if not math.isfinite(best.ratio_low) or not math.isfinite(best.ratio_high):
        return f"{head}, {size}, without an interval from so few runs."
    ends = [100 * (1 - end) for end in (best.ratio_high, best.ratio_low)]
    interval = f"{level} interval {_format_ends(*ends)} %"
    cost = _describe_cost(best, base)
    if base.verdict == EQUAL:
        return f"{head}, {size} ({interval}){cost}: equal to it {base.words}."
    if base.verdict == OPEN:
        return (
            f"{head}, {size} ({interval}){cost}. "
            f"Jointly with all other pairs this is not decided: {_name(base, looks)} is {base.words} above it."
        )
    return f"{head}: {size} ({interval}){cost}."


def _describe_tracks(
    rows: Sequence[BoardRow],
    looks: Mapping[str, MethodLook],
    baseline: str,
    level: str,
    track_interval: TrackInterval | None,
) -> str:
    """State the difference of shares of runs that keep track where no errors are compared; else empty."""
    ranked = [row for row in rows if row.rank is not None]
    off = sorted((row for row in rows if row.verdict == NOT_KEPT), key=lambda row: -row.track)
    if not off or (len(ranked) > 1 and all(row.filter != baseline for row in off)):
        return ""
    first = ranked[0] if ranked else off[0]
    others = off if ranked else [row for row in off if row.track < first.track]
    if not others:
        return ""
    second = next((row for row in others if row.filter == baseline), others[0])
    size = format_digits(100 * (first.track - second.track), 2)
    text = (
        f"Track is kept by {_name(first, looks)} in {100 * first.track:.0f} % and by {_name(second, looks)} in "
        f"{100 * second.track:.0f} % of runs, difference {size} percentage points"
    )
    if track_interval is None:
        return f"{text}."
    ends = (100 * end for end in track_interval(first.filter, second.filter))
    return f"{text} ({level} interval {_format_ends(*ends)})."


def _describe_next(
    ranked: Sequence[BoardRow], base: BoardRow, looks: Mapping[str, MethodLook], level: str
) -> str:
    """State distance and cost of the first filter that is worse, or of the second, where the best is the baseline."""
    others = [row for row in ranked[1:] if row.words != IDENTICAL]
    if not others:
        return "No other filter has an error to compare." if len(ranked) == 1 else ""
    row = next((row for row in others if row.verdict == WORSE), others[0])
    subject = "The next" if row is others[0] else "The first that is worse"
    size = f"{subject}, {_name(row, looks)}, is {_format_size(row.ratio)} above it"
    ends = [100 * (end - 1) for end in (row.ratio_low, row.ratio_high)]
    if not all(map(math.isfinite, ends)):
        return f"{size}, without an interval from so few runs."
    return f"{size} ({level} interval {_format_ends(*ends)} %){_describe_cost(row, base)}."


def _describe_cost(row: BoardRow, base: BoardRow) -> str:
    """Compare the time per step with that of the baseline, with its interval if it was measured in rounds."""
    if not math.isnan(row.cost):
        ends = f"interval {row.cost_low:.2f} to {row.cost_high:.2f}"
        return f", at {row.cost:.2f} times its cost ({ends})"
    if not base.ms > 0:
        return ""
    factor = f"{row.ms / base.ms:.2g}"
    return ", at about the same cost" if factor == "1" else f", at about {factor} times its cost"


def _format_size(ratio: float) -> str:
    """Format the difference from 1 in percent."""
    return "less than 0.01 %" if abs(ratio - 1) < 1e-4 else f"{percent(math.log(ratio))} %"


def _describe_proposed(ranked: Sequence[BoardRow], looks: Mapping[str, MethodLook]) -> str:
    """State the best proposed method, unless it is the best filter."""
    proposed = [row for row in ranked if looks[row.filter].proposed]
    if not proposed or proposed[0] is ranked[0]:
        return ""
    row = proposed[0]
    state = {EQUAL: "equal to the best", OPEN: "not decided against the best"}
    return f"Best proposed method: {_name(row, looks)}, {state.get(row.verdict, 'worse')} ({row.words})."


def _describe_ties(ranked: Sequence[BoardRow]) -> str:
    """Count the filters that are equal to the best, and those that are not decided against it."""
    others = [row for row in ranked[1:] if row.words != IDENTICAL]
    counts = [
        (sum(row.verdict == EQUAL for row in others), "equal to the best within the margin"),
        (sum(row.verdict == OPEN for row in others), "not decided against the best"),
    ]
    if len(others) == 1:
        return "".join(f"The other filter is {state}." for n, state in counts if n)
    parts = [f"{n} {'is' if n == 1 else 'are'} {state}" for n, state in counts if n]
    return f"Of {count_words(len(others), 'other filter')}, {' and '.join(parts)}." if parts else ""
