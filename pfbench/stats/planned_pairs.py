"""Decisions on planned pairs of filters: the public entry of a study.

The first family contains the share of runs that keep track and the error of each planned pair. The
questions (a) and (b) have separate families. All other metrics form the second family.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.stats.decision import (
    IDENTICAL,
    NO_SIZE,
    NOT_TESTED,
    Decision,
    DecisionOptions,
    MetricRule,
    Question,
    combine_words,
    pair_word,
)
from pfbench.stats.effects import (
    MIN_RUNS,
    EffectEstimate,
    fit_world_posterior,
    moderated_p_values,
    prediction_interval,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.pair_effects import (
    TRACK,
    PairComparison,
    QuestionEffect,
    between_sd,
    compare_metric,
    compare_track,
    run_sd,
)
from pfbench.stats.rank_tests import holm
from pfbench.stats.study_runs import StudyRuns, have_common_runs, select_pair, to_study_runs
from pfbench.stats.study_size import required_runs_per_condition, required_worlds

QUESTIONS: tuple[Question, Question] = ("a", "b")
FAMILY_1 = "planned pairs, track and error"
FAMILY_2 = "planned pairs, secondary metrics"
MODERATED_FILTERS, MODERATED_WORLDS = 8, 3  # from which moderated variances are shown
Pairs = Sequence[tuple[str, str]]


def decide_planned_pairs(
    table: pd.DataFrame,
    pairs: Pairs,
    rule: MetricRule | None = None,
    options: DecisionOptions | None = None,
) -> list[Decision]:
    """Decide which filter of each planned pair is better, for both questions.

    Args:
        table: Columns filter, scenario, family, regime, run, value and keeps_track. See
            `tidy_table.tidy_runs` for results of pfbench.
        pairs: Labels of the planned pairs.
        rule: Rule of the main metric, None for the log ratio of errors.
        options: Options, None for the defaults.

    Returns:
        Four records per pair: question (a) track and error of all pairs, then question (b).

    Raises:
        ValueError: if the table or a pair is not valid.
    """
    rule, options = rule or MetricRule(), options or DecisionOptions()
    study = to_study_runs(table)
    check_pairs(pairs)
    comparisons: list[PairComparison] = []
    for a, b in pairs:
        runs = select_pair(study, a, b)
        comparisons += [
            compare_track(runs, rule.group, options),
            compare_metric(runs, rule, options),
        ]
    context = FamilyContext(FAMILY_1, study.regimes, options)
    same_worlds, new = (
        add_pair_words(record_family(comparisons, question, context), options)
        for question in QUESTIONS
    )
    return [*same_worlds, *_add_moderated(new, study, rule, options)]


def decide_secondary_metrics(
    tables: Mapping[str, pd.DataFrame],
    pairs: Pairs,
    rules: Sequence[MetricRule],
    options: DecisionOptions | None = None,
) -> list[Decision]:
    """Decide the secondary metrics of planned pairs in one family per question.

    Returns records of question (a), then of question (b). A pair without a common run of a metric
    lacks its record.
    """
    options = options or DecisionOptions()
    check_pairs(pairs)
    comparisons, regimes = [], 0
    for rule in rules:
        study = to_study_runs(tables[rule.name])
        regimes = max(regimes, study.regimes)
        comparisons += [
            compare_metric(select_pair(study, a, b), rule, options)
            for a, b in pairs
            if have_common_runs(study, a, b)
        ]
    context = FamilyContext(FAMILY_2, regimes, options)
    return [
        decision
        for question in QUESTIONS
        for decision in record_family(comparisons, question, context)
    ]


def decision_frame(decisions: Sequence[Decision]) -> pd.DataFrame:
    """Return decisions as a table, one row per record."""
    return pd.DataFrame([decision.to_dict() for decision in decisions])


def check_pairs(pairs: Pairs) -> None:
    """Check that pairs exist and that no pair occurs twice, in any order."""
    names = [frozenset(pair) for pair in pairs]
    if not names or len(set(names)) < len(names):
        raise ValueError(
            f"pairs must be at least one pair and different from each other, got {list(pairs)}. "
            "Remove repetitions."
        )


def add_pair_words(decisions: Sequence[Decision], options: DecisionOptions) -> list[Decision]:
    """Combine the words of track and error of each pair.

    Returns records with the word of the pair.
    """
    combined: list[Decision] = []
    for track, error in zip(decisions[::2], decisions[1::2], strict=True):
        opposite = track.estimate * error.both_keep < 0
        is_material = (
            abs(track.estimate) > options.track_margin and abs(error.both_keep) > error.margin
        )
        word = combine_words(track.word, error.word, bool(opposite and is_material))
        if error.reason == ONE_WORLD:
            word = error.word
        combined += [replace(record, pair_word=word) for record in (track, error)]
    return combined


def _add_moderated(
    decisions: Sequence[Decision], study: StudyRuns, rule: MetricRule, options: DecisionOptions
) -> list[Decision]:
    """Add p-values with moderated variances to the errors of question (b)."""
    enough = len(study.filters) >= MODERATED_FILTERS and len(study.worlds) >= MODERATED_WORLDS
    effects = {
        (a, b): compare_metric(select_pair(study, a, b), rule, options)
        for a, b in (combinations(study.filters, 2) if enough else ())
        if have_common_runs(study, a, b)
    }
    names, means, sds = [], [], []
    for name, comparison in effects.items():
        location = comparison.effects.worlds.location
        sd = float(np.std(location, ddof=1)) if location.size == len(study.worlds) else 0.0
        if np.isfinite(location).all() and sd > 0 and comparison.scale == "log ratio":
            names.append(frozenset(name))
            means.append(float(location.mean()))
            sds.append(sd)
    if len(names) < MODERATED_FILTERS:
        return list(decisions)
    p = dict(
        zip(
            names,
            moderated_p_values(np.array(means), np.array(sds), len(study.worlds)),
            strict=True,
        )
    )
    raw = np.array(
        [p.get(frozenset((d.a, d.b)), np.nan) if d.metric != TRACK else np.nan for d in decisions]
    )
    return [
        replace(decision, p_moderated=float(value))
        for decision, value in zip(decisions, correct_p_values(raw), strict=True)
    ]


# --------------------------------------------------------------------------------------------------
# Records of decisions after the test of a family.

ONE_WORLD = "one world"
RUNS_WON = "share of runs won in place of the error"
NO_ERROR = "no run of either filter keeps track"
_FEW_WORLDS = range(2, 6)  # worlds with which the posterior is shown
_SHARES = ("share", "runs won")  # scales of a difference of shares, which is within 1
_LARGE_EFFECT = 2.0  # SD between worlds, for the statement on the worlds required


class FamilyContext(NamedTuple):
    """Context of the records of a family.

    Attributes:
        name: Name of the family.
        regimes: Number of regimes of the study.
        options: Options.
        looks: Number of looks at the data so far.
    """

    name: str
    regimes: int
    options: DecisionOptions
    looks: int = 1


def record_family(
    comparisons: Sequence[PairComparison], question: Question, context: FamilyContext
) -> list[Decision]:
    """Test a family for one question and describe its decisions.

    Returns one record per comparison, in order.
    """
    if not comparisons:
        return []
    members = [effect_of(comparison, question) for comparison in comparisons]
    tests = decide_family(stack_questions(members), context.options.alpha)
    return [
        describe(comparison, question, tests, k, context)
        for k, comparison in enumerate(comparisons)
    ]


def effect_of(comparison: PairComparison, question: Question) -> QuestionEffect:
    """Return the effect of a comparison for a question."""
    return comparison.effects.same_worlds if question == "a" else comparison.effects.new_world


def describe(
    comparison: PairComparison,
    question: Question,
    tests: FamilyTests,
    k: int,
    context: FamilyContext,
) -> Decision:
    """Describe one decision of a family.

    Returns Record.
    """
    pair, effects, options = comparison.pair, comparison.effects, context.options
    effect = effect_of(comparison, question)
    size = max(int(tests.size), 1)
    word, statement = _word(comparison, tests, k)
    low, high, *plain = _intervals(word, effect, tests, k, options.alpha)
    if word != NOT_TESTED and comparison.scale in _SHARES:
        low, high, *plain = (min(max(end, -1.0), 1.0) for end in (low, high, *plain))
    spread, location = float(run_sd(effects)), effects.worlds.location
    share_a, share_b = pair.shares
    return Decision(
        question=question, a=pair.a, b=pair.b, metric=comparison.metric, group=comparison.group,
        scale=comparison.scale, estimate=float(effect.value), low=low, high=high,
        level=1 - options.alpha / size, plain_low=plain[0], plain_high=plain[1],
        p=float(effect.p), p_corrected=float(tests.p_corrected[k]), family=context.name,
        family_size=int(tests.size), worlds=len(pair.worlds), regimes=context.regimes, runs=pair.runs,
        share_a=share_a, share_b=share_b, world_sd=float(between_sd(effects)), run_sd=spread,
        looks=context.looks, word=word, size=statement, pair_word=word,
        reason=_reason(comparison, question), margin=comparison.margin,
        runs_needed=required_runs_per_condition(
            comparison.margin / spread if spread > 0 else np.inf, size, options.alpha
        ),
        worlds_needed=required_worlds(_LARGE_EFFECT, size, options.alpha),
        worlds_better=int((location < 0).sum()), worlds_worse=int((location > 0).sum()),
        both_keep=comparison.both_keep,
        **(_new_world_values(comparison, size, options) if question == "b" else {}),
    )  # fmt: skip


def _word(comparison: PairComparison, tests: FamilyTests, k: int) -> tuple[str, str]:
    """Return the word and the statement on the margin."""
    if comparison.effects.identical:
        return (NOT_TESTED if _has_no_error(comparison) else IDENTICAL), NO_SIZE
    if not np.isfinite(tests.p_corrected[k]):
        return NOT_TESTED, NO_SIZE
    ends = float(tests.low[k]), float(tests.high[k]), bool(tests.is_decided[k])
    if comparison.scale == "runs won":  # a margin of values does not apply; 0 allows no equivalence
        return pair_word(*ends, margin=0.0)[0], NO_SIZE
    return pair_word(*ends, margin=comparison.margin)


def _intervals(
    word: str, effect: QuestionEffect, tests: FamilyTests, k: int, alpha: float
) -> tuple[float, float, float, float]:
    """Return the simultaneous interval and that of the comparison alone."""
    if word == IDENTICAL:
        return 0.0, 0.0, 0.0, 0.0
    if word == NOT_TESTED:
        return -np.inf, np.inf, -np.inf, np.inf
    plain = effect.estimate.interval(alpha)
    return float(tests.low[k]), float(tests.high[k]), float(plain[0]), float(plain[1])


def _has_no_error(comparison: PairComparison) -> bool:
    """Return whether neither filter keeps track in any run, so that all their runs are equally bad."""
    is_error = comparison.scale == "log ratio"
    is_equal = bool(np.all(comparison.effects.identical))
    return is_error and is_equal and max(comparison.pair.shares) == 0.0


def _reason(comparison: PairComparison, question: Question) -> str:
    """State why a decision is missing or has another scale."""
    effects = comparison.effects
    if _has_no_error(comparison):
        return NO_ERROR
    if effects.identical:
        return "all runs agree"
    if question == "a" and effects.too_few:
        return f"{comparison.pair.runs} runs per condition, {MIN_RUNS} are required"
    if question == "b" and len(comparison.pair.worlds) < 2:
        return ONE_WORLD
    if comparison.scale == "runs won":
        return RUNS_WON
    if question == "a" and effects.same_worlds.estimate.standard_error == 0:
        return "no variation over runs"
    return ""


def _new_world_values(
    comparison: PairComparison, size: int, options: DecisionOptions
) -> dict[str, float]:
    """Return the interval of one new world and the posterior interval."""
    worlds = comparison.effects.worlds
    ends = [float(end) for end in prediction_interval(worlds.location, options.alpha)]
    if comparison.scale in _SHARES and all(map(math.isfinite, ends)):
        ends = [max(ends[0], -1.0), min(ends[1], 1.0)]
    values = {"new_low": ends[0], "new_high": ends[1]}
    errors = worlds.standard_error
    is_regular = bool(np.isfinite(worlds.location).all() and (errors > 0).all())
    if (
        len(comparison.pair.worlds) in _FEW_WORLDS
        and comparison.scale == "log ratio"
        and is_regular
    ):
        posterior = fit_world_posterior(worlds.location, errors, options.prior_sd)
        low, high = posterior.interval(options.alpha / size)
        values |= {"posterior_low": float(low), "posterior_high": float(high)}
        values["prior_sd"] = options.prior_sd
    return values


# --------------------------------------------------------------------------------------------------
# Tests of a family of comparisons: Holm's correction and simultaneous intervals that agree with it.
#
# References:
#     S. Holm (1979), A simple sequentially rejective multiple test procedure.
#     O. Guilbaud (2008), Simultaneous confidence regions corresponding to Holm's step-down procedure.


class FamilyTests(NamedTuple):
    """Tests of a family, [..., M].

    Attributes:
        low: Lower ends of the simultaneous intervals.
        high: Upper ends.
        p_corrected: p-values with Holm's correction, NaN without a test.
        is_decided: Whether the interval excludes 0. An end of 0 is excluded, too: it is the bound
            of the interval that belongs to Holm's test.
        size: Number of tests of the family, [...].
    """

    low: Array
    high: Array
    p_corrected: Array
    is_decided: Flags
    size: Array


def stack_questions(members: list[QuestionEffect]) -> QuestionEffect:
    """Stack comparisons along a new last axis."""
    estimates = (np.stack(v, axis=-1) for v in zip(*(m.estimate for m in members), strict=True))
    value, p = (np.stack([m[k] for m in members], axis=-1) for k in (0, 2))
    return QuestionEffect(value, EffectEstimate(*estimates), p)


def correct_p_values(p: Array) -> Array:
    """Apply Holm's correction along the last axis; NaN is not part of the family."""
    rows = p.reshape(-1, p.shape[-1])
    corrected = np.full(rows.shape, np.nan)
    for row, result in zip(rows, corrected, strict=True):
        tested = np.isfinite(row)
        result[tested] = holm(row[tested])
    return corrected.reshape(p.shape)


def decide_family(members: QuestionEffect, alpha: float) -> FamilyTests:
    """Test a family of comparisons, [..., M].

    Intervals have level 1 - alpha / M. If Holm's test decides and the interval includes 0, its end
    becomes 0. An interval of a comparison that is not decided includes 0.

    Returns decisions and intervals.
    """
    size = np.isfinite(members.p).sum(axis=-1)
    low, high = members.estimate.interval(alpha / np.maximum(size, 1)[..., None])
    corrected = correct_p_values(members.p)
    decided = np.nan_to_num(corrected, nan=1.0) <= alpha
    is_negative, is_positive = decided & (members.value < 0), decided & (members.value > 0)
    low = np.where(
        is_positive, np.maximum(low, 0.0), np.where(is_negative, low, np.minimum(low, 0.0))
    )
    high = np.where(
        is_negative, np.minimum(high, 0.0), np.where(is_positive, high, np.maximum(high, 0.0))
    )
    return FamilyTests(low, high, corrected, is_negative | is_positive, size)
