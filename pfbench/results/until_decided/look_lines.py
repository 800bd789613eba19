"""Lines after each look of a study that adds runs: what is decided and what is open."""

from __future__ import annotations

from collections.abc import Sequence

from pfbench.results.until_decided.look_schedule import LookSchedule
from pfbench.results.until_decided.pair_states import PairState

_LISTED = 6  # pairs in a line


def format_look(
    number: int,
    schedule: LookSchedule,
    states: Sequence[PairState],
    earlier: Sequence[PairState] = (),
    warning: str = "",
) -> str:
    """Format what is decided and what is open after a look.

    Args:
        number: Number of the look, from 1.
        schedule: Looks of the study.
        states: State of each pair.
        earlier: States at the look before.
        warning: Sentence on runs that are not independent; empty without one.

    Returns:
        One line.
    """
    unresolved = [state for state in states if state.is_open]
    decided = {(state.a, state.b) for state in earlier if not state.is_open}
    new = [s for s in states if not s.is_open and (s.a, s.b) not in decided]
    runs, count = schedule.runs[number - 1], len(states) - len(unresolved)
    parts = [f"look {number}, {runs} runs: {count} of {len(states)} pairs decided"]
    parts += [f"new: {_list_states(new)}"] if new else []
    parts += [f"open: {_list_states(unresolved)}"] if unresolved else []
    return ". ".join(filter(None, ("; ".join(parts), warning)))


def describe_end(number: int, schedule: LookSchedule, states: Sequence[PairState]) -> str:
    """Return why a study ends with a look, empty if more runs follow.

    Args:
        number: Number of the look, from 1.
        schedule: Looks of the study.
        states: State of each pair.
    """
    runs, count = schedule.runs[number - 1], sum(state.is_open for state in states)
    if not count:
        return f"all {len(states)} pairs are decided after {runs} runs."
    if number == len(schedule.runs):
        return f"{count} of {len(states)} pairs are open after max_runs={runs}."
    return ""


def _list_states(states: Sequence[PairState]) -> str:
    """List up to six pairs."""
    more = f" and {len(states) - _LISTED} more" if len(states) > _LISTED else ""
    return f"{', '.join(map(str, states[:_LISTED]))}{more}"
