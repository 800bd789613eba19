"""Records of decisions after the test of a family."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pfbench.results.decisions.comparisons import PairComparison
from pfbench.results.decisions.decision import Decision, Question
from pfbench.results.decisions.family_tests import FamilyTests, decide_family, stack_questions
from pfbench.results.decisions.options import DecisionOptions
from pfbench.results.decisions.pair_effects import QuestionEffect, between_sd, run_sd
from pfbench.results.decisions.words import IDENTICAL, NO_SIZE, NOT_TESTED, pair_word
from pfbench.results.statistics.paired_effects import MIN_RUNS
from pfbench.results.statistics.study_size import required_runs_per_condition, required_worlds
from pfbench.results.statistics.world_effects import prediction_interval
from pfbench.results.statistics.world_spread import fit_world_posterior

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

    Args:
        comparisons: Members of the family.
        question: "a" or "b".
        context: Context of the records.

    Returns:
        One record per comparison, in order.
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
    """Return the effect of a comparison for a question.

    Args:
        comparison: PairComparison.
        question: "a" or "b".
    """
    return comparison.effects.same_worlds if question == "a" else comparison.effects.new_world


def describe(
    comparison: PairComparison,
    question: Question,
    tests: FamilyTests,
    k: int,
    context: FamilyContext,
) -> Decision:
    """Describe one decision of a family.

    Args:
        comparison: PairComparison.
        question: "a" or "b".
        tests: Tests of the family.
        k: Index of the comparison in the family.
        context: Context of the records.

    Returns:
        Record.
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
