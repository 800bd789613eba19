"""Sentences of a report, generated from records of decisions.

A sentence has the magnitude first, then the interval, then the sample. Words of order occur only
with "in these worlds" or "in a new world".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from pfbench.stats.decision import (
    BETTER,
    EQUIVALENT,
    IDENTICAL,
    NOT_TESTED,
    TRADE_OFF,
    WORSE,
    Decision,
)
from pfbench.stats.filter_sets import FilterRanking
from pfbench.stats.pair_effects import TRACK
from pfbench.stats.planned_pairs import NO_ERROR, ONE_WORLD, RUNS_WON
from pfbench.stats.study_size import min_pairs

_ENOUGH_WORLDS = 6  # from which a decision on a new world is usual


def describe_pair(track: Decision, error: Decision) -> str:
    """Describe the decision on a pair for one question.

    Args:
        track: Record of the share of runs that keep track.
        error: Record of the main metric, of the same pair and question.

    Returns:
        One to three sentences.

    Raises:
        ValueError: if the records are of different pairs or questions.
    """
    if (track.a, track.b, track.question) != (error.a, error.b, error.question):
        raise ValueError(
            f"records must be of one pair and question, got {track.a}, {track.b}, {track.question} "
            f"and {error.a}, {error.b}, {error.question}. Select both from one result."
        )
    if error.question == "b":
        return _describe_new_world(error)
    if error.word == NOT_TESTED:
        return _describe_too_few(error)
    if error.pair_word == TRADE_OFF:
        return _describe_trade_off(error)
    text = _describe_here(error)
    return f"{text} {_describe_track(track)}"


def describe_total(decisions: Sequence[Decision]) -> str:
    """Describe how many pairs are decided, and the error control.

    Returns two sentences.
    """
    errors = [d for d in decisions if d.metric != TRACK]
    pairs = len({(d.a, d.b) for d in errors})
    same_worlds, new = (
        sum(d.question == question and d.pair_word in (BETTER, WORSE) for d in errors)
        for question in ("a", "b")
    )
    size = max(errors[0].family_size, 1)
    percent = format_percent((1 - errors[0].level) * size)
    return (
        f"{format_count(pairs, 'planned pair')}: {same_worlds} decided in these worlds, {new} in a new world. "
        f"Error control: {percent} % for all pairs together, separately for each question."
    )


def describe_ranking(same_worlds: FilterRanking, new: FilterRanking, label: str) -> str:
    """Describe the top group and the rank of one filter.

    Returns two sentences.
    """
    (first, last), (first_new, last_new) = same_worlds.ranks[label], new.ranks[label]
    return (
        f"Shown worse than no other in these worlds: {', '.join(same_worlds.top_group)}. "
        f"Rank of {label} in these worlds: {first} to {last} of {len(same_worlds.ranks)}; in a new world: "
        f"{first_new} to {last_new}."
    )


def _describe_here(error: Decision) -> str:
    """Describe question (a) when it is tested."""
    head = f"In {format_worlds(error)}, "
    sample = f"{format_level(error)} simultaneous interval; {format_count(error.runs, 'paired run')} per condition"
    if error.word == IDENTICAL:
        return f"{head}{error.a} and {error.b} give identical results."
    if error.reason == RUNS_WON:
        state = "decided" if error.word in (BETTER, WORSE) else "not decided"
        return (
            f"{head}{error.a} and {error.b} are compared by the share of runs won, since tracks are not kept: {state}, "
            f"{describe_runs_won(error)}; {sample}."
        )
    effect = format_effect(error, error.estimate, error.low, error.high)
    if error.word in (BETTER, WORSE):
        return (
            f"{head}the {error.metric} of {error.a} is {effect.replace('(', f'than that of {error.b} (', 1)[:-1]}, "
            f"{sample}; {format_world_count(error)})."
        )
    if error.word == EQUIVALENT:
        return f"{head}{error.a} and {error.b} are equivalent to within {format_margin(error)}: {effect}, {sample}."
    return (
        f"{head}{error.a} and {error.b} are not decided: {effect}, {sample}. About "
        f"{format_digits(error.runs_needed)} runs per condition would decide a difference of {format_margin(error)}."
    )


def describe_runs_won(error: Decision) -> str:
    """Describe the difference of the shares of runs that the first and the second filter win."""
    return format_effect(error, -error.estimate, -error.high, -error.low)


def describe_shares(track: Decision) -> str:
    """Describe the shares of runs in which two filters keep track, and their difference."""
    shares = f"{format_percent(track.share_a)} and {format_percent(track.share_b)} % of runs"
    if track.word == IDENTICAL or not (math.isfinite(track.low) and math.isfinite(track.high)):
        return shares
    return f"{shares}, {format_effect(track, -track.estimate, -track.high, -track.low)}"


def _describe_track(track: Decision) -> str:
    """Describe which filter keeps track more often."""
    shares = describe_shares(track)
    if track.word == BETTER:
        return f"{track.a} keeps track more often: {shares}."
    if track.word == WORSE:
        return f"{track.a} keeps track less often: {shares}."
    if track.word in (EQUIVALENT, IDENTICAL):
        return f"Both keep track about as often: {shares}."
    return f"Which one keeps track more often is not decided: {shares}."


def _describe_trade_off(error: Decision) -> str:
    off_a, off_b = (format_percent(1 - share) for share in (error.share_a, error.share_b))
    size = format_digits(100 * abs(math.expm1(error.both_keep)))
    direction = "smaller" if error.both_keep < 0 else "larger"
    both = (
        f"{size} % {direction} than that of {error.b}"
        if error.scale in ("log ratio", "runs won")
        else f"different by {error.both_keep:.3g}"
    )
    return (
        f"Trade-off in {format_worlds(error)}: {error.a} is lost or diverges in {off_a} %, {error.b} in {off_b} % of "
        f"runs. Where both keep track, the {error.metric} of {error.a} is {both}. The choice depends on the "
        "cost of a run that is lost or diverges."
    )


def _describe_too_few(error: Decision) -> str:
    if not error.reason:
        return f"{error.a} and {error.b} are not tested."
    if error.reason == NO_ERROR:
        return f"{error.a} and {error.b} are not compared: {error.reason}."
    least = 2.0 ** (1 - error.runs)
    ask = f"{error.a} and {error.b} are not tested: {error.reason}. The estimates are shown only."
    if error.runs and error.runs < min_pairs(0.05):
        ask += f" The least p-value of a rank test of {format_count(error.runs, 'run')} is {least:.3g}."
    return ask


def _describe_new_world(error: Decision) -> str:
    """Describe question (b)."""
    if error.reason == ONE_WORLD:
        return "One world: this study supports no statement about another world."
    if error.word in (IDENTICAL, NOT_TESTED):
        reason = error.reason or "no test exists"
        return f"In a new world of this kind, {error.a} and {error.b} are not compared: {reason}."
    effect = format_effect(error, error.estimate, error.low, error.high)
    if error.scale == "runs won":
        effect = describe_runs_won(error)
        state = f"{error.word} than" if error.word in (BETTER, WORSE) else "not decided against"
        return (
            f"In a new world of this kind, {error.a} is {state} {error.b} by the share of runs won, since tracks are not kept: "
            f"{effect}, {format_count(error.worlds, 'world')}."
        )
    if error.word in (BETTER, WORSE):
        prediction = format_range(error, error.new_low, error.new_high)
        return (
            f"In a new world of this kind, {error.a} is {error.word} than {error.b} on average: "
            f"{effect[:-1]}; {format_count(error.worlds, 'world')}). One new world: {prediction}."
        )
    text = (
        f"In a new world of this kind, the order of {error.a} and {error.b} is not decided: {effect}, "
        f"{format_level(error)} simultaneous interval, {format_count(error.worlds, 'world')}."
    )
    if math.isfinite(error.posterior_low):
        ends = format_range(error, error.posterior_low, error.posterior_high)
        text += f" With the prior that the SD between worlds is about {error.prior_sd:g}: {ends}."
    if error.worlds < _ENOUGH_WORLDS:
        text += f" {format_digits(error.worlds_needed)} worlds would decide an effect of twice the SD between worlds."
    return text


# --------------------------------------------------------------------------------------------------
# Numbers and intervals of decisions as text, with units.

_TENFOLD, _MILLION = math.log(10.0), math.log(1e6)


def format_effect(decision: Decision, value: float, low: float, high: float) -> str:
    """Format an effect as "26 % smaller (18 to 33 %)"."""
    if decision.scale == "log ratio":
        return _format_change(value, low, high)
    if decision.scale == "difference":
        return f"difference {value:.3g} ({low:.3g} to {high:.3g})"
    ends = [100 * v for v in (low, high)]
    return f"difference {format_digits(100 * value)} percentage points ({format_digits(ends[0])} to {format_digits(ends[1])})"


def _format_change(value: float, low: float, high: float) -> str:
    """Format a log ratio in percent, and as a ratio where percent are beyond tenfold."""
    direction = "smaller" if value < 0 else "larger"
    size = f"{format_digits(100 * abs(math.expm1(min(value, _TENFOLD))))} %"
    if value > _TENFOLD:
        size = f"{_format_ratio(value)} times"
    if max(abs(low), abs(high)) > _TENFOLD:
        return f"{size} {direction} (ratio {_format_ratio(low)} to {_format_ratio(high)})"
    sign = -1.0 if value < 0 else 1.0
    ends = sorted(100 * sign * math.expm1(v) for v in (low, high))
    return f"{size} {direction} ({format_digits(ends[0])} to {format_digits(ends[1])} %)"


def _format_ratio(log_ratio: float) -> str:
    """Format a ratio. A ratio of more than a million is "any number"."""
    if log_ratio > _MILLION:
        return "any number"
    return format_digits(math.exp(log_ratio)) if log_ratio > -_MILLION else "0"


def format_range(error: Decision, low: float, high: float) -> str:
    """Format two ends as "45 % smaller to 2 % larger"."""
    if error.scale != "log ratio":
        return f"{low:.3g} to {high:.3g}"
    words = [
        f"{format_digits(100 * abs(math.expm1(v)))} % {'smaller' if v < 0 else 'larger'}"
        if abs(v) <= _TENFOLD
        else f"{_format_ratio(v)} times as large"
        if abs(v) <= _MILLION
        else ("any amount smaller" if v < 0 else "any amount larger")
        for v in (low, high)
    ]
    return f"{words[0]} to {words[1]}"


def format_worlds(error: Decision) -> str:
    """Format the worlds of the study."""
    return "this world" if error.worlds == 1 else f"these {error.worlds} worlds"


def format_world_count(error: Decision) -> str:
    """Format the number of worlds with the sign of the estimate."""
    count = error.worlds_better if error.estimate < 0 else error.worlds_worse
    return f"{'smaller' if error.estimate < 0 else 'larger'} in {count} of {format_count(error.worlds, 'world')}"


def format_margin(error: Decision) -> str:
    """Format the margin of equivalence."""
    if error.scale == "log ratio":
        return f"{format_digits(100 * math.expm1(error.margin))} %"
    return f"{error.margin:.3g}"


def format_level(error: Decision) -> str:
    """Format the joint level of the intervals of a family."""
    return f"{format_percent(1 - (1 - error.level) * max(error.family_size, 1))} %"


def format_count(number: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def format_percent(share: float) -> str:
    """Format a share in percent, without the sign."""
    return f"{100 * share:.3g}"


def format_digits(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, without an exponent below 1e6."""
    if not math.isfinite(value):
        return (
            "no number of" if math.isnan(value) else ("any amount" if value > 0 else "-any amount")
        )
    if abs(value) >= 1e6:
        return f"{value:.{digits - 1}e}"
    return np.format_float_positional(
        value + 0.0, precision=digits, unique=False, fractional=False, trim="-"
    )


def percent(log_ratio: float) -> str:
    """Format a log ratio as a change in percent with two digits, without its sign."""
    value = abs(100 * math.expm1(min(log_ratio, 20.0)))
    digits = 0 if value >= 10 else 1 if value >= 1 else 2
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"
