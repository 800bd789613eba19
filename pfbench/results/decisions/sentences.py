"""Sentences of a report, generated from records of decisions.

A sentence has the magnitude first, then the interval, then the sample. Words of order occur only
with "in these worlds" or "in a new world".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pfbench.results.decisions.comparisons import TRACK
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.family_records import NO_ERROR, ONE_WORLD, RUNS_WON
from pfbench.results.decisions.filter_sets import FilterRanking
from pfbench.results.decisions.sentence_formats import (
    format_count,
    format_digits,
    format_effect,
    format_level,
    format_margin,
    format_percent,
    format_range,
    format_world_count,
    format_worlds,
)
from pfbench.results.decisions.words import (
    BETTER,
    EQUIVALENT,
    IDENTICAL,
    NOT_TESTED,
    TRADE_OFF,
    WORSE,
)
from pfbench.results.statistics.power import min_pairs

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

    Args:
        decisions: Records of `decide_planned_pairs`.

    Returns:
        Two sentences.
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

    Args:
        same_worlds: Order for question (a).
        new: Order for question (b).
        label: Filter.

    Returns:
        Two sentences.
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
    """Describe the difference of the shares of runs that the first and the second filter win.

    Args:
        error: Record of the error, on the scale of runs won.
    """
    return format_effect(error, -error.estimate, -error.high, -error.low)


def describe_shares(track: Decision) -> str:
    """Describe the shares of runs in which two filters keep track, and their difference.

    Args:
        track: Record of the share of runs that keep track.
    """
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
