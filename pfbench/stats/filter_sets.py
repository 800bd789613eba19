"""Order of many filters: all pairs, the filters that none is better than, and intervals of ranks.

Pairs are decided by their own data, so that another filter enters only through the size of the
family. A planned pair keeps the word of its own family, so that a pair has one word in a study. No test of
mean ranks is used.

References:
    M. Mogstad, J. P. Romano, A. M. Shaikh and D. Wilhelm (2024), Inference for ranks.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import pandas as pd

from pfbench.stats.decision import BETTER, WORSE, Decision, DecisionOptions, MetricRule, Question
from pfbench.stats.pair_effects import TRACK, compare_metric
from pfbench.stats.planned_pairs import FamilyContext, record_family
from pfbench.stats.study_runs import select_pair, to_study_runs

FAMILY_ALL = "all pairs, error"


class FilterRanking(NamedTuple):
    """Order of filters for one question.

    Attributes:
        question: "a" for the worlds of the study, "b" for a new world.
        top_group: Filters that no filter was shown to be better than.
        ranks: First and last rank of each filter. All intervals hold together with probability
            1 - alpha, or 1 - 2 alpha if planned pairs keep their words.
        decisions: Records of all pairs.
    """

    question: Question
    top_group: tuple[str, ...]
    ranks: dict[str, tuple[int, int]]
    decisions: tuple[Decision, ...]


def order_filters(
    table: pd.DataFrame,
    rule: MetricRule | None = None,
    options: DecisionOptions | None = None,
    planned: Sequence[Decision] = (),
) -> tuple[FilterRanking, FilterRanking]:
    """Compare all pairs of filters for both questions.

    Returns orders for the questions (a) and (b).
    """
    rule, options = rule or MetricRule(), options or DecisionOptions()
    study = to_study_runs(table)
    fixed = {(d.question, frozenset((d.a, d.b))): d for d in planned if d.metric != TRACK}
    comparisons = [
        compare_metric(select_pair(study, a, b), rule, options)
        for a, b in combinations(study.filters, 2)
        if ("a", frozenset((a, b))) not in fixed
    ]
    context = FamilyContext(FAMILY_ALL, study.regimes, options)

    def rank(question: Question) -> FilterRanking:
        records = record_family(comparisons, question, context)
        records += [
            d
            for (name, pair), d in fixed.items()
            if name == question and pair <= set(study.filters)
        ]
        return rank_by_decisions(study.filters, records, question)

    return rank("a"), rank("b")


def rank_by_decisions(
    filters: Sequence[str], decisions: Sequence[Decision], question: Question
) -> FilterRanking:
    """Derive the top group and rank intervals from decisions on all pairs.

    Returns order of the filters.
    """
    losses, gains = (dict.fromkeys(filters, 0) for _ in range(2))
    for decision in decisions:
        if decision.word in (BETTER, WORSE):
            better, worse = (
                (decision.a, decision.b) if decision.word == BETTER else (decision.b, decision.a)
            )
            gains[better] += 1
            losses[worse] += 1
    top_group = tuple(label for label in filters if not losses[label])
    ranks = {label: (1 + losses[label], len(filters) - gains[label]) for label in filters}
    return FilterRanking(question, top_group, ranks, tuple(decisions))
