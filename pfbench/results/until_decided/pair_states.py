"""State of each planned pair after a look: a word, and the interval that is valid at all looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results.decisions.comparisons import paired_differences
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.growing_study import decide_at_looks, is_complete
from pfbench.results.decisions.options import DecisionOptions, MetricRule
from pfbench.results.decisions.planned_pairs import Pairs, check_pairs
from pfbench.results.decisions.sentence_formats import format_range
from pfbench.results.decisions.study_runs import PairRuns, select_pair, to_study_runs
from pfbench.results.decisions.words import BETTER, INCONCLUSIVE_PAIR, WORSE, pair_word
from pfbench.results.error_measures import Array
from pfbench.results.statistics.e_values import confidence_sequence, sign_log_e_value
from pfbench.results.statistics.sequential_looks import LookPlan
from pfbench.results.until_decided.look_schedule import LookSchedule


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

    Args:
        pair: Runs of both filters.
        rule: Rule of the metric, None for the log ratio of errors.

    Returns:
        Averages of the runs that all conditions have, [n], in the order of the runs.
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
