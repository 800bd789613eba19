"""Words of a decision. Every word is a function of one interval and of one margin.

An effect is negative if the first filter is better. An interval whose decided end is 0 excludes 0.
"""

from __future__ import annotations

from typing import Final

BETTER: Final = "better"
WORSE: Final = "worse"
EQUIVALENT: Final = "equivalent"
INCONCLUSIVE_PAIR: Final = "inconclusive"
IDENTICAL: Final = "identical"
TRADE_OFF: Final = "trade-off"
NOT_TESTED: Final = "not tested"

MORE: Final = "by more than the margin"
LESS: Final = "by less than the margin"
OPEN_SIZE: Final = "size inconclusive"
NOT_BETTER: Final = "not better by the margin"
NOT_WORSE: Final = "not worse by the margin"
NO_SIZE: Final = ""

HOLDS: Final = "holds"
FAILS: Final = "fails"
DIRECTION_HOLDS: Final = "direction holds, size inconclusive"


def pair_word(low: float, high: float, is_decided: bool, margin: float) -> tuple[str, str]:
    """Return the decision on a pair and its size.

    Args:
        low: Lower end of the simultaneous interval.
        high: Upper end.
        is_decided: Whether the interval excludes 0.
        margin: Margin of equivalence, positive, in the unit of the interval.

    Returns:
        better, worse, equivalent or inconclusive, and the statement about the margin.
    """
    if is_decided and high <= 0:
        return BETTER, _size(-high, -low, margin)
    if is_decided and low >= 0:
        return WORSE, _size(low, high, margin)
    if -margin < low and high < margin:
        return EQUIVALENT, LESS
    if -margin < low:
        return INCONCLUSIVE_PAIR, NOT_BETTER
    if high < margin:
        return INCONCLUSIVE_PAIR, NOT_WORSE
    return INCONCLUSIVE_PAIR, NO_SIZE


def claim_word(
    low: float, high: float, is_decided: bool, margin: float, states_size: bool = True
) -> str:
    """Return the decision on the claim that the first filter is better.

    Args:
        low: Lower end of the simultaneous interval.
        high: Upper end.
        is_decided: Whether the interval excludes 0.
        margin: Margin that the claim states, or that of equivalence.
        states_size: Whether the claim states the margin, or a direction alone.

    Returns:
        holds, fails, "direction holds, size inconclusive", or inconclusive.
    """
    is_better = is_decided and high <= 0
    if is_better and (high < -margin or not states_size):
        return HOLDS
    if is_better and low <= -margin:
        return DIRECTION_HOLDS
    return FAILS if low > -margin else INCONCLUSIVE_PAIR


def combine_words(track: str, error: str, is_trade_off: bool) -> str:
    """Return the decision on a pair from its decisions on track and error.

    Args:
        track: Word of the shares that keep track.
        error: Word of the error.
        is_trade_off: Whether both point to different filters by more than their margins.

    Returns:
        One word of the pair.
    """
    decided = {word for word in (track, error) if word in (BETTER, WORSE)}
    if is_trade_off or len(decided) == 2:
        return TRADE_OFF
    if decided:
        return decided.pop()
    if error == NOT_TESTED:
        return NOT_TESTED
    if {track, error} <= {EQUIVALENT, IDENTICAL}:
        return error
    return INCONCLUSIVE_PAIR


def _size(least: float, most: float, margin: float) -> str:
    """Compare the size of a decided effect with the margin."""
    if least > margin:
        return MORE
    return LESS if most < margin else OPEN_SIZE
