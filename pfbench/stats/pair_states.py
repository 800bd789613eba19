"""A study that adds runs: schedule of the looks, state of each pair, and the lines after each look."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from pfbench.files.atomic_write import DIGEST, has_valid_digest, hash_content, write_atomically
from pfbench.stats.decision import (
    BETTER,
    INCONCLUSIVE_PAIR,
    WORSE,
    Decision,
    DecisionOptions,
    MetricRule,
    pair_word,
)
from pfbench.stats.error_measures import Array
from pfbench.stats.pair_effects import paired_differences
from pfbench.stats.planned_pairs import Pairs, check_pairs
from pfbench.stats.rank_tests import confidence_sequence, sign_log_e_value
from pfbench.stats.sentences import format_range
from pfbench.stats.sequential_looks import LookPlan, decide_at_looks, is_complete
from pfbench.stats.study_runs import PairRuns, select_pair, to_study_runs

# --------------------------------------------------------------------------------------------------
# State of each planned pair after a look: a word, and the interval that is valid at all looks.


class PairState(NamedTuple):
    """State of one pair after a look.

    Attributes:
        a: Label of the first filter.
        b: Label of the second filter.
        word: Word of the pair, as in a study of fixed size.
        is_open: Whether the pair requires more runs.
        interval: Interval of the error of a against b, as text.
    """

    a: str
    b: str
    word: str
    is_open: bool
    interval: str

    def __str__(self) -> str:
        relation = f"{self.word} than" if self.word in (BETTER, WORSE) else "/"
        ending = "" if self.is_open or self.word in (BETTER, WORSE) else f" {self.word}"
        return f"{self.a} {relation} {self.b}{ending} ({self.interval})"


def decide_pairs(
    table: pd.DataFrame,
    pairs: Pairs,
    schedule: LookSchedule,
    options: DecisionOptions | None = None,
    rule: MetricRule | None = None,
) -> list[PairState]:
    """Decide planned pairs with all looks that the runs allow.

    Args:
        table: Table as in `planned_pairs.decide_planned_pairs`, with all runs so far.
        pairs: Labels of the planned pairs.
        schedule: Looks of the study.
        options: Options, None for the defaults.
        rule: Rule of the main metric, None for the log ratio of errors.

    Returns:
        One state per pair.

    Raises:
        ValueError: if the table or a pair is not valid, or the runs do not reach the first look.
    """
    options, rule = options or DecisionOptions(), rule or MetricRule()
    if schedule.mode == "e_values":
        return _decide_at_any_time(table, pairs, schedule, options, rule)
    plan = LookPlan(runs=schedule.runs, alpha=options.alpha)
    decisions = decide_at_looks(table, pairs, plan, rule, options)
    return [_to_state(error) for error in decisions[1::2]]


def average_over_conditions(pair: PairRuns, rule: MetricRule | None = None) -> Array:
    """Average the log ratios or differences of each run over the conditions of a pair.

    A run of all conditions is one unit, because its conditions share random numbers. Infinite
    values decide by the sum of the weights of their signs.

    Returns averages of the runs that all conditions have, [n], in the order of the runs.
    """
    d = paired_differences(pair, rule or MetricRule())
    used = pair.weights > 0
    d, weights = d[used], pair.weights[used]
    d = d[:, pair.present[used].all(axis=0)]
    infinite = np.where(np.isinf(d), np.sign(d), 0.0)
    side = np.round(weights @ infinite, 12)
    finite = weights @ np.where(np.isfinite(d), d, 0.0) / weights.sum()
    average: Array = np.where(side == 0, finite, np.copysign(np.inf, side))
    return average


def _to_state(error: Decision) -> PairState:
    """Return the state of a pair from the record of its error."""
    return PairState(
        error.a,
        error.b,
        error.pair_word,
        not is_complete([error]),
        _format_ends(error.low, error.high, MetricRule())
        if error.scale == "log ratio"
        else f"{error.scale} {format_range(error, error.low, error.high)}",
    )


def _decide_at_any_time(
    table: pd.DataFrame,
    pairs: Pairs,
    schedule: LookSchedule,
    options: DecisionOptions,
    rule: MetricRule,
) -> list[PairState]:
    """Decide the median of the runs of each pair by e-values, with Bonferroni's correction."""
    study = to_study_runs(table)
    check_pairs(pairs)
    level = options.alpha / len(pairs)
    states = []
    for a, b in pairs:
        d = average_over_conditions(select_pair(study, a, b), rule)
        looks = [n for n in schedule.runs if n <= d.size] or [d.size]
        low, high, is_decided = _intersect_looks([d[:n] for n in looks], level)
        margin = options.log_margin if rule.margin is None else rule.margin
        word, _ = pair_word(low, high, is_decided, margin)
        text = _format_ends(low, high, rule)
        states.append(PairState(a, b, word, word == INCONCLUSIVE_PAIR, text))
    return states


def _intersect_looks(samples: Sequence[Array], level: float) -> tuple[float, float, bool]:
    """Return the interval of all looks, and whether the e-value of some look excludes 0."""
    low, high, sign = -math.inf, math.inf, 0.0
    for d in samples:
        ends = [float(end) for end in confidence_sequence(d, level)]
        joint = max(low, ends[0]), min(high, ends[1])
        low, high = joint if joint[0] <= joint[1] else (ends[0], ends[1])
        if not sign and sign_log_e_value(d) >= math.log(1 / level):
            sign = float(np.sign((d > 0).sum() - (d < 0).sum()))
    if sign < 0:
        return min(low, 0.0), min(high, 0.0), True
    return (max(low, 0.0), max(high, 0.0), True) if sign else (min(low, 0.0), max(high, 0.0), False)


def _format_ends(low: float, high: float, rule: MetricRule) -> str:
    """Format the ends of an interval: a ratio, or a difference that is negative if a is better."""
    if rule.scale == "log ratio":
        return f"ratio {math.exp(low):.3g} to {math.exp(high):.3g}"
    return f"{rule.scale} {low:.3g} to {high:.3g}"


# --------------------------------------------------------------------------------------------------
# Runs at each look of a study that adds runs, and the record that keeps its plan.
#
# A plan is fixed before the first look: levels of the looks that follow from another plan would not
# hold the error.

LookMode = Literal["looks", "e_values"]
MODES = ("looks", "e_values")
FIRST_LOOK = 20
RECORD = "looks.json"  # in the folder of the results


@dataclass(frozen=True)
class LookSchedule:
    """Runs per condition at the looks of a study.

    Attributes:
        mode: "looks" doubles the runs from look to look, with planned levels. "e_values" looks
            every 20 runs and holds at any number of runs.
        max_runs: Runs per condition at most.

    Raises:
        ValueError: if the mode is unknown or the runs do not reach the first look.
    """

    mode: LookMode = "looks"
    max_runs: int = 320

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(
                f"until_decided.mode must be looks or e_values, got {self.mode}. Use looks."
            )
        if type(self.max_runs) is not int or self.max_runs < FIRST_LOOK:
            raise ValueError(
                f"until_decided.max_runs must be a whole number of at least {FIRST_LOOK}, got "
                f"{self.max_runs}. Use 320."
            )

    @property
    def runs(self) -> tuple[int, ...]:
        """Runs per condition at each look."""
        looks, following = [], FIRST_LOOK
        while following < self.max_runs:
            looks.append(following)
            following += following if self.mode == "looks" else FIRST_LOOK
        return (*looks, self.max_runs)

    def parts(self, number: int) -> list[tuple[int, int]]:
        """Return the first run and the number of runs of all parts until a look.

        Args:
            number: Number of the look, from 1.
        """
        ends = self.runs[:number]
        return [(first, end - first) for first, end in zip((0, *ends), ends, strict=False)]


class LookRecord:
    """Plan and looks of a study in one file.

    Attributes:
        path: File.
        request: Plan of the study.
        looks: Lines of the looks so far.
        state: Reason why the study has finished, or empty.
    """

    def __init__(self, path: Path, request: Mapping[str, Any]) -> None:
        self.path = path
        self.request: dict[str, Any] = json.loads(json.dumps(request))
        self.looks: list[str] = []
        self.state = ""
        if not path.exists():
            return
        stored = _read_record(path)
        for key, value in self.request.items():
            if stored["request"].get(key) != value:
                raise ValueError(
                    f"{key} must be {_shorten(stored['request'].get(key))}, as at the first look of "
                    f"this study, got {_shorten(value)}. Use another study=NAME, or delete the "
                    f"folder {path.parent}."
                )
        self.looks, self.state = list(stored["looks"]), str(stored["state"])

    def write(self, looks: Sequence[str], state: str = "") -> None:
        """Write the looks so far."""
        self.looks, self.state = list(looks), state
        content = {"request": self.request, "looks": self.looks, "state": state}
        text = json.dumps({**content, DIGEST: hash_content(content)}, indent=1)
        write_atomically(self.path, lambda file: file.write(text.encode()))


def _read_record(path: Path) -> dict[str, Any]:
    """Read a record and check its digest."""
    try:
        stored = json.loads(path.read_text())
    except ValueError:
        stored = None
    if not isinstance(stored, dict) or not has_valid_digest(stored):
        raise ValueError(
            f"{path} must be the record of a study, got a damaged file. Delete it: the results are "
            "kept, and all looks are repeated from them."
        )
    return stored


def _shorten(value: Any) -> str:
    """Format a value in at most 60 characters."""
    text = f"{value}"
    return text if len(text) <= 60 else f"{text[:57]}..."


# --------------------------------------------------------------------------------------------------
# Lines after each look of a study that adds runs: what is decided and what is open.

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
