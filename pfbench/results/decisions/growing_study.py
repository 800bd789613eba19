"""Decisions of a study that adds runs until every planned pair is decided.

All looks use the first runs of the study. The level of each comparison is divided equally, and the
intervals of all looks are intersected. The words are those of a study of fixed size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from pfbench.results.decisions.comparisons import (
    PairComparison,
    compare_metric,
    compare_track,
    paired_differences,
)
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.family_records import FamilyContext, describe
from pfbench.results.decisions.family_tests import FamilyTests
from pfbench.results.decisions.options import DecisionOptions, MetricRule
from pfbench.results.decisions.pair_effects import PairEffects, share_effects
from pfbench.results.decisions.planned_pairs import Pairs, add_pair_words, check_pairs
from pfbench.results.decisions.study_runs import StudyRuns, first_runs, select_pair, to_study_runs
from pfbench.results.decisions.words import INCONCLUSIVE_PAIR, NOT_TESTED, TRADE_OFF
from pfbench.results.error_measures import Array
from pfbench.results.statistics.sequential_looks import (
    LookPlan,
    repeated_interval,
    repeated_p_value,
)

FAMILY_LOOKS = "planned pairs at planned looks, track and error"
_UNDECIDED = (INCONCLUSIVE_PAIR, NOT_TESTED, TRADE_OFF)


def decide_at_looks(
    table: pd.DataFrame,
    pairs: Pairs,
    plan: LookPlan,
    rule: MetricRule | None = None,
    options: DecisionOptions | None = None,
) -> list[Decision]:
    """Decide planned pairs for question (a) with all looks that the runs allow.

    Args:
        table: Table as in `planned_pairs.decide_planned_pairs`, with all runs so far.
        pairs: Labels of the planned pairs.
        plan: Plan of the looks. Its `comparisons` is replaced by two per pair, and its `alpha` is
            used.
        rule: Rule of the main metric, None for the log ratio of errors.
        options: Options, None for the defaults.

    Returns:
        Two records per pair, track before error.

    Raises:
        ValueError: if the table or a pair is not valid, or the runs do not reach the first look.
    """
    rule, options = rule or MetricRule(), options or DecisionOptions()
    study = to_study_runs(table)
    check_pairs(pairs)
    plan = replace(plan, comparisons=2 * len(pairs))
    looks = [n for n in plan.runs if n <= study.value.shape[-1]]
    if not looks:
        raise ValueError(
            f"runs must be at least {plan.runs[0]}, got {study.value.shape[-1]}. Add runs."
        )
    decisions = []
    for a, b in pairs:
        track, error = _compare_at_looks(study, (a, b), looks, rule, options)
        context = FamilyContext(FAMILY_LOOKS, study.regimes, options, len(looks))
        decisions += [_decide(track, plan, context), _decide(error, plan, context)]
    return add_pair_words(decisions, options)


def is_complete(decisions: Sequence[Decision]) -> bool:
    """Return whether every pair is decided, so that no more runs are required."""
    return all(decision.pair_word not in _UNDECIDED for decision in decisions)


def decide_looks(effects: Sequence[PairEffects], plan: LookPlan) -> FamilyTests:
    """Test one comparison with the effects of all looks so far.

    Args:
        effects: Effects of question (a) at the looks so far, with leading axes [...].
        plan: Plan of the looks.

    Returns:
        Repeated intervals and decisions, [...]. An interval agrees with the decision as in
        `family_tests.decide_family`.
    """
    levels = plan.levels
    low, high = repeated_interval([e.same_worlds.estimate for e in effects], levels)
    p = np.stack([e.same_worlds.p for e in effects])
    is_below = np.nan_to_num(p, nan=1.0) <= np.reshape(levels[: len(p)], (-1, *[1] * (p.ndim - 1)))
    value = np.stack([e.same_worlds.value for e in effects])
    signs = np.where(is_below, np.sign(value), 0.0)
    first = np.take_along_axis(signs, np.argmax(signs != 0, axis=0)[None], axis=0)[0]
    low = np.where(first > 0, np.maximum(low, 0.0), np.where(first < 0, low, np.minimum(low, 0.0)))
    high = np.where(
        first < 0, np.minimum(high, 0.0), np.where(first > 0, high, np.maximum(high, 0.0))
    )
    low, high = np.minimum(low, high), np.maximum(low, high)
    size = np.full(np.shape(first), plan.comparisons)
    return FamilyTests(low, high, p[-1], first != 0, size)


def _compare_at_looks(
    study: StudyRuns,
    pair: tuple[str, str],
    looks: Sequence[int],
    rule: MetricRule,
    options: DecisionOptions,
) -> tuple[list[PairComparison], list[PairComparison]]:
    """Compare track and error of a pair at all looks; the scale of the last look is used."""
    runs = [select_pair(first_runs(study, n), *pair) for n in looks]
    track = [compare_track(selected, rule.group, options) for selected in runs]
    error = [compare_metric(selected, rule, options) for selected in runs]
    if error[-1].scale == "runs won":
        error = [_count_runs_won(comparison, rule, options) for comparison in error]
    return track, error


def _count_runs_won(
    comparison: PairComparison, rule: MetricRule, options: DecisionOptions
) -> PairComparison:
    """Replace the effect of a comparison by the difference of the shares of runs won."""
    if comparison.scale == "runs won":
        return comparison
    signs = np.sign(paired_differences(comparison.pair, rule))
    effects = share_effects(signs, comparison.pair.weights, options.shared_runs)
    return comparison._replace(scale="runs won", effects=effects)


def _decide(
    comparisons: Sequence[PairComparison], plan: LookPlan, context: FamilyContext
) -> Decision:
    """Describe the decision of one comparison after all looks so far."""
    effects = [comparison.effects for comparison in comparisons]
    single = decide_looks(effects, plan)
    p = [float(np.nan_to_num(e.same_worlds.p, nan=1.0)) for e in effects]
    corrected = min(1.0, repeated_p_value(p, plan) * plan.comparisons)
    tested: Array = np.array([corrected if np.isfinite(effects[-1].same_worlds.p) else np.nan])
    tests = FamilyTests(
        np.array([single.low]), np.array([single.high]), tested, np.array([single.is_decided]),
        np.asarray(plan.comparisons),
    )  # fmt: skip
    return describe(comparisons[-1], "a", tests, 0, context)
