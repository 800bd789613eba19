"""Consistency of each filter: mean NEES and NIS with bands, and Holm's correction over all of them.

The unit is a run: NEES is averaged over the time, regimes and worlds of a run, since these share random
numbers. The mean over runs is divided by its expectation. Its logarithm has a Student interval, whose
error follows from the spread over runs, so that no independence over time is assumed [ours]. Lost
runs are left out and counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from pfbench.stats.decision import NOT_TESTED, DecisionOptions, plain_value
from pfbench.stats.effects import (
    MIN_RUNS,
    EffectEstimate,
    combine_conditions,
    estimate_in_these_worlds,
    trimmed_effects,
)
from pfbench.stats.error_measures import Array
from pfbench.stats.pair_effects import QuestionEffect
from pfbench.stats.planned_pairs import FamilyTests, decide_family, stack_questions
from pfbench.stats.study_runs import StudyRuns, condition_weights, tidy_rows, to_study_runs

FAMILY_BANDS = "filters and groups, NEES and NIS"
OVERCONFIDENT: Final = "overconfident"
UNDERCONFIDENT: Final = "underconfident"
NO_DEVIATION: Final = "no deviation shown"
INNOVATION = "innovation"  # group of the NIS
_LARGEST = 1e30  # in place of an infinite NEES, of a filter without spread
_QUANTITIES = {"nees_ratio": "NEES", "nis": "NIS"}


@dataclass(frozen=True)
class ConsistencyBand:
    """Mean NEES or NIS of one filter and group over its expectation, in the worlds of a study.

    Attributes:
        label: Filter.
        quantity: "NEES" or "NIS".
        group: Group of the state, or "innovation".
        estimate: Mean over runs, regimes and worlds of the ratio to the expectation. 1 is consistent.
        low: Lower end of the simultaneous interval.
        high: Upper end.
        level: Level of that interval, 1 - alpha / family_size.
        p: p-value of the ratio 1, NaN without a test.
        p_corrected: p-value with Holm's correction.
        family: Name of the family.
        family_size: Number of tests of the family.
        worlds: Number of worlds.
        runs: Valid runs per condition, at least.
        lost: Lost runs of all conditions.
        word: overconfident, underconfident, no deviation shown, or not tested.
        reason: Reason of a missing test; empty otherwise.
    """

    label: str
    quantity: str
    group: str
    estimate: float
    low: float
    high: float
    level: float
    p: float
    p_corrected: float
    family: str
    family_size: int
    worlds: int
    runs: int
    lost: int
    word: str
    reason: str

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON can store: numbers that are not finite become text."""
        return {name: plain_value(value) for name, value in asdict(self).items()}


class _Member(NamedTuple):
    """Ratio of one filter and group before the test of the family."""

    label: str
    quantity: str
    group: str
    effect: QuestionEffect
    worlds: int
    runs: int
    lost: int
    reason: str


def decide_consistency(
    table: pd.DataFrame, options: DecisionOptions | None = None
) -> list[ConsistencyBand]:
    """Compare mean NEES and NIS of each filter and group with their expectation.

    Returns one record per filter, quantity and group, in one family.
    """
    options = options or DecisionOptions()
    members = list(_list_members(table, options.shared_runs))
    if not members:
        return []
    tests = decide_family(stack_questions([m.effect for m in members]), options.alpha)
    return [_describe(member, tests, k, options.alpha) for k, member in enumerate(members)]


def estimate_ratio(value: Array, weights: Array, shared_runs: bool = True) -> QuestionEffect:
    """Estimate the logarithm of a mean ratio, whose error follows from the spread over runs.

    Returns effect, whose value is 0 if the mean ratio is 1. The p-value is NaN with fewer than 10
    runs or without variation over runs. Shapes: value [..., W, C, N], weights [W, C].
    """
    worlds = combine_conditions(trimmed_effects(np.minimum(value, _LARGEST), 0.0), weights)
    mean = estimate_in_these_worlds(worlds, shared_runs)
    level = np.maximum(mean.value, 1 / _LARGEST)
    estimate = EffectEstimate(np.log(level), mean.standard_error / level, mean.df)
    runs = np.where(weights > 0, np.count_nonzero(~np.isnan(value), axis=-1), MIN_RUNS)
    is_tested = (runs >= MIN_RUNS).all(axis=(-2, -1)) & (mean.standard_error > 0)
    return QuestionEffect(estimate.value, estimate, np.where(is_tested, estimate.p, np.nan))


def _list_members(table: pd.DataFrame, shared_runs: bool) -> Iterator[_Member]:
    """Yield the members of the family: each filter, quantity and group with a valid run."""
    for metric, quantity in _QUANTITIES.items():
        rows = table[table["metric"] == metric]
        rows = rows.assign(group=INNOVATION) if metric == "nis" else rows
        for group, of_group in rows.groupby("group", sort=False):
            study = to_study_runs(tidy_rows(of_group))
            for k, label in enumerate(study.filters):
                if (study.present[k] & ~np.isnan(study.value[k])).any():
                    yield _make_member(study, k, (label, quantity, str(group)), shared_runs)


def _make_member(
    study: StudyRuns, k: int, names: tuple[str, str, str], shared_runs: bool
) -> _Member:
    """Estimate the mean ratio of one filter and count its runs."""
    is_valid = study.present[k] & ~np.isnan(study.value[k])
    weights = condition_weights(study.scenario, is_valid.any(axis=-1))
    used = weights.any(axis=-1)
    value = np.where(is_valid, study.value[k], np.nan)[used]
    effect = estimate_ratio(value, weights[used], shared_runs)
    runs = int(is_valid.sum(axis=-1)[weights > 0].min())
    lost = int((study.present[k] & ~is_valid).sum())
    reason = ""
    if np.isnan(effect.p):
        reason = "no variation over runs"
        if runs < MIN_RUNS:
            reason = f"{runs} valid runs per condition, {MIN_RUNS} are required"
    return _Member(*names, effect, int(used.sum()), runs, lost, reason)


def _describe(member: _Member, tests: FamilyTests, k: int, alpha: float) -> ConsistencyBand:
    """Describe one member after the test of the family."""
    size, word = int(tests.size), NOT_TESTED
    if not member.reason:
        word = NO_DEVIATION
        if tests.is_decided[k]:
            word = OVERCONFIDENT if member.effect.value > 0 else UNDERCONFIDENT
    ends = (0.0, np.inf) if member.reason else np.exp([tests.low[k], tests.high[k]])
    return ConsistencyBand(
        member.label, member.quantity, member.group, float(np.exp(member.effect.value)),
        float(ends[0]), float(ends[1]), 1 - alpha / max(size, 1),
        float(member.effect.p), float(tests.p_corrected[k]), FAMILY_BANDS, size,
        member.worlds, member.runs, member.lost, word, member.reason,
    )  # fmt: skip
