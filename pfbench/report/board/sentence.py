"""The sentence of a view, and its small print."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence

from pfbench.report.board.view import EQUAL, MISSING, NOT_KEPT, OPEN, BoardRow
from pfbench.report.looks import MethodLook
from pfbench.results.decisions.sentence_formats import format_digits, percent
from pfbench.results.decisions.words import IDENTICAL, WORSE

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

    Args:
        rows: Rows ordered by level.
        looks: Looks by label.
        baseline: Label of the baseline.
        scope: Worlds and regimes in words, such as "in these 3 worlds".
        metric: Name of the metric in a sentence.
        level: Level of an interval, as text.
        track_interval: Interval of the difference of the shares of runs in which two filters keep track;
            None for sentences without it.
        has_limit: Whether all scenarios state a divergence threshold. Otherwise only lost runs are known.

    Returns:
        Sentences. Names of filters are enclosed in double square brackets.
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
    """Format a count with its noun.

    Args:
        number: Count.
        noun: Noun, singular.
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def count_failing(number: int, total: int) -> str:
    """Format the subject and verb of a sentence on the filters that do not keep track.

    Args:
        number: Number of these filters.
        total: Number of all filters.
    """
    verb = "does" if number == 1 else "do"
    return f"{number} of {count_words(total, 'filter')} {verb} not keep track"


def name_lost_runs(text: str) -> str:
    """Replace the words on tracks in a sentence on conditions without a divergence threshold.

    Args:
        text: Sentence of this module.
    """
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
