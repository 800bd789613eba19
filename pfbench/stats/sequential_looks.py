"""Planned looks at a growing study: levels, intervals valid at all looks, and decisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Literal

import numpy as np
import pandas as pd
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from pfbench.stats.decision import (
    INCONCLUSIVE_PAIR,
    NOT_TESTED,
    TRADE_OFF,
    Decision,
    DecisionOptions,
    MetricRule,
)
from pfbench.stats.effects import EffectEstimate
from pfbench.stats.error_measures import Array
from pfbench.stats.pair_effects import (
    PairComparison,
    PairEffects,
    compare_metric,
    compare_track,
    paired_differences,
    share_effects,
)
from pfbench.stats.planned_pairs import (
    FamilyContext,
    FamilyTests,
    Pairs,
    add_pair_words,
    check_pairs,
    describe,
)
from pfbench.stats.study_runs import StudyRuns, first_runs, select_pair, to_study_runs

# --------------------------------------------------------------------------------------------------
# Planned looks at a growing number of runs: levels of the looks and intervals valid at all of them.
#
# The error is spent over looks as a function of the share of runs. Intervals of all looks are
# intersected, and their coverage holds at the look at which a study stops.
#
# References:
#     P. Armitage, C. K. McPherson and B. C. Rowe (1969), Repeated significance tests on accumulating data.
#     K. K. G. Lan and D. L. DeMets (1983), Discrete sequential boundaries for clinical trials.
#     C. Jennison and B. W. Turnbull (1989), Interim analyses: the repeated confidence interval approach.

Spending = Literal["pocock", "obrien_fleming"]
_NODES = 121
LEAST_P = 1e-8
_BISECTIONS = 20
_LARGEST = 37.0  # standard score beyond which a normal tail is zero in double precision


@dataclass(frozen=True)
class LookPlan:
    """Plan of the looks of a study that adds runs until every pair is decided.

    Attributes:
        runs: Runs per condition at each look, increasing.
        alpha: Error of all planned pairs together.
        comparisons: Number of comparisons that share the error. Each has an equal part.
        spending: Error spent by a share of the runs: "pocock" or "obrien_fleming".
    """

    runs: tuple[int, ...] = (20, 40, 80, 160, 320)
    alpha: float = 0.05
    comparisons: int = 1
    spending: Spending = "pocock"

    def __post_init__(self) -> None:
        if not self.runs or min(self.runs) < 1 or list(self.runs) != sorted(set(self.runs)):
            raise ValueError(
                f"runs must be positive and increasing, got {self.runs}. Use (20, 40, 80)."
            )
        if not 0 < self.alpha < 1 or self.comparisons < 1:
            raise ValueError(
                f"alpha and comparisons must be within 0 to 1 and at least 1, got {self.alpha} and "
                f"{self.comparisons}. Use 0.05 and the number of planned comparisons."
            )

    @property
    def levels(self) -> tuple[float, ...]:
        """Two-sided levels of the looks of each comparison."""
        times = tuple(n / self.runs[-1] for n in self.runs)
        scores = boundary_scores(times, self.alpha / self.comparisons, self.spending)
        return tuple(2 * float(ndtr(-z)) for z in scores)


def spent_error(time: float, alpha: float, spending: Spending) -> float:
    """Return the error that may be spent until a share of the runs."""
    if spending == "pocock":
        return float(alpha * np.log1p(np.expm1(1.0) * time))
    return float(4 * ndtr(ndtri(alpha / 4) / np.sqrt(time)))


@lru_cache(maxsize=512)
def boundary_scores(
    times: tuple[float, ...], alpha: float, spending: Spending
) -> tuple[float, ...]:
    """Compute the standard scores at which a look shows a difference, two-sided.

    The distribution of the sum of runs that have not yet decided is integrated from look to look
    with Gauss-Legendre points.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    scores: list[float] = []
    x, mass, before, spent = np.zeros(1), np.ones(1), 0.0, 0.0
    for time in times:
        target = spent_error(time, alpha, spending) - spent
        sd, root = np.sqrt(time - before), np.sqrt(time)
        excess = partial(_excess, x, mass, root, sd, target)
        z = float(brentq(excess, 0.0, _LARGEST, xtol=1e-10)) if target > 0 else _LARGEST
        scores.append(z)
        following = z * root * nodes
        kernel = np.exp(-0.5 * ((following[:, None] - x) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        mass = z * root * node_weights * (kernel @ mass)
        x, before, spent = following, time, spent + max(target, 0.0)
    return tuple(scores)


def repeated_interval(
    estimates: Sequence[EffectEstimate], levels: Sequence[float]
) -> tuple[Array, Array]:
    """Intersect the intervals of all looks so far.

    Returns lower and upper end. If the intervals of two looks do not overlap, the last one remains.
    """
    ends = [estimate.interval(level) for estimate, level in zip(estimates, levels, strict=False)]
    low = np.max([end[0] for end in ends], axis=0)
    high = np.min([end[1] for end in ends], axis=0)
    overlap = low <= high
    return np.where(overlap, low, ends[-1][0]), np.where(overlap, high, ends[-1][1])


def repeated_p_value(p: Sequence[float], plan: LookPlan) -> float:
    """Compute the least error of the plan at which some look so far shows a difference."""
    times = tuple(n / plan.runs[-1] for n in plan.runs)

    def is_shown(alpha: float) -> bool:
        scores = boundary_scores(times, alpha, plan.spending)
        return any(v <= 2 * ndtr(-z) for v, z in zip(p, scores, strict=False))

    low, high = np.log(LEAST_P), np.log(1.0 - 1e-9)
    if not is_shown(float(np.exp(high))):
        return 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if is_shown(float(np.exp(middle))) else (middle, high)
    return float(np.exp(high))


def _excess(x: Array, mass: Array, root: float, sd: float, target: float, score: float) -> float:
    """Return the probability that the next sum exceeds a score, minus the target."""
    limit = score * root
    return float(mass @ (ndtr((x - limit) / sd) + ndtr((-x - limit) / sd))) - target


# --------------------------------------------------------------------------------------------------
# Decisions of a study that adds runs until every planned pair is decided.
#
# All looks use the first runs of the study. The level of each comparison is divided equally, and the
# intervals of all looks are intersected. The words are those of a study of fixed size.

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

    Returns two records per pair, track before error.
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

    Returns repeated intervals and decisions, [...]. An interval agrees with the decision as in
    `family_tests.decide_family`. Shapes: effects [...].
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
