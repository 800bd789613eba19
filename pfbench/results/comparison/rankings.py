"""Rankings of filters across the conditions of a study: conditions are blocks [Demsar 2006].

The value of a block is the median over runs of log RMSE. Runs of one condition share scenario and
noise regime and are never blocks. Differences of logarithms are dimensionless, so
conditions of different scenarios are comparable.

An omnibus test comes first: Friedman's, corrected for ties, in the form of Iman and Davenport 1980.
Then each pair of filters is compared by Nemenyi's test, and by Conover's and Wilcoxon's tests with
Holm's correction. A filter is better if the omnibus test and Nemenyi's test both show it [ours], as
in a critical-difference diagram. The Bayesian signed-rank test gives the probability that a filter
is better, or equal within a margin [Benavoli et al. 2014].

Noise regimes of one scenario share its seeds, so conditions are more alike than independent blocks.
The omnibus test with scenarios as blocks is therefore computed too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd

from pfbench.results.comparison.condition_blocks import (
    RankingBlocks,
    list_scenarios,
    ranking_blocks,
    refuse_ranking,
)
from pfbench.results.comparison.lost_run_rules import WORST_RANK, LostRunRule
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE
from pfbench.results.comparison.ranking_results import (
    RankingPair,
    RankingResult,
    ScenarioRanking,
    best_ranked,
)
from pfbench.results.error_measures import Array
from pfbench.results.statistics.effect_sizes import (
    ProportionEstimate,
    probability_of_improvement,
    rank_biserial,
)
from pfbench.results.statistics.intervals import proportion_interval
from pfbench.results.statistics.rank_tests import (
    FriedmanResult,
    conover,
    friedman,
    log_difference,
    nemenyi,
    rank_within_blocks,
    wilcoxon_pairs,
)
from pfbench.results.statistics.signed_rank import bayesian_signed_rank

MIN_SCENARIOS = 3  # required by a test with scenarios as blocks [ours]
VALUE = "median over runs of log RMSE"


def rank_filters(
    table: pd.DataFrame,
    group: str,
    alpha: float = 0.05,
    margin: float = 0.05,
    rule: LostRunRule = WORST_RANK,
) -> RankingResult:
    """Compare all filters across the conditions of a study.

    Args:
        table: Rows of `load_frame`; those of metric "rmse" and component "norm" are used.
        group: Group of the state.
        alpha: Level.
        margin: Relative difference of RMSE within which filters are equal.
        rule: Rule for lost runs.

    Returns:
        The ranking, or the reason in `refused`.
    """
    blocks = ranking_blocks(table, group, rule)
    refused = refuse_ranking(blocks)
    test = None if refused else friedman(rank_within_blocks(blocks.values), alpha)
    return RankingResult(
        group=group,
        metric="rmse",
        value=VALUE,
        rule=rule.name,
        alpha=alpha,
        margin=margin,
        filters=blocks.filters,
        cells=blocks.cells,
        left_out=blocks.left_out,
        shared=blocks.shared,
        refused=refused,
        **({} if test is None else _describe(blocks, test, alpha, margin)),
    )


def winners_by_rule(
    table: pd.DataFrame, group: str, alpha: float, rule: LostRunRule
) -> dict[tuple[str, str], str] | str:
    """Decide each pair by another rule for lost runs; arguments as `rank_filters`.

    Args:
        table: Rows of `load_frame`.
        group: Group of the state.
        alpha: Level.
        rule: Rule for lost runs.

    Returns:
        Winner of each pair, or the reason why no test was run.
    """
    blocks = ranking_blocks(table, group, rule)
    if refused := refuse_ranking(blocks):
        return refused
    rank = rank_within_blocks(blocks.values)
    test, p, filters = friedman(rank, alpha), nemenyi(rank), blocks.filters
    return {
        (filters[i], filters[j]): _decide(blocks, test, float(p[i, j]), (i, j), alpha)
        for i, j in combinations(range(len(filters)), 2)
    }


def _describe(
    blocks: RankingBlocks, test: FriedmanResult, alpha: float, margin: float
) -> dict[str, Any]:
    """Collect the fields of a ranking that was tested."""
    return {
        "ranks": tuple(map(float, test.ranks)),
        "chi2": test.chi2,
        "p": test.p,
        "f": test.f,
        "p_f": test.p_f,
        "critical": test.critical,
        "pairs": tuple(_compare(blocks, test, alpha, margin)),
        "by_world": _rank_by_scenario(blocks),
    }


def _compare(
    blocks: RankingBlocks, test: FriedmanResult, alpha: float, margin: float
) -> list[RankingPair]:
    """Compare all pairs of filters across conditions."""
    rank = rank_within_blocks(blocks.values)
    by_nemenyi, by_conover = nemenyi(rank), conover(rank)
    by_wilcoxon = wilcoxon_pairs(blocks.values)
    pairs = []
    for (i, j), p_wilcoxon in by_wilcoxon.items():
        d = log_difference(blocks.values, i, j)
        bayes_a, bayes_equal, bayes_b = bayesian_signed_rank(d, float(np.log1p(margin)))
        estimates = [probability_of_improvement(e[:, i], e[:, j]) for e in blocks.runs]
        better, low, high = _mean_proportion(estimates, 1 - alpha)
        pairs.append(
            RankingPair(
                blocks.filters[i],
                blocks.filters[j],
                wins=int((d < 0).sum()),
                losses=int((d > 0).sum()),
                rank_a=float(test.ranks[i]),
                rank_b=float(test.ranks[j]),
                p_nemenyi=float(by_nemenyi[i, j]),
                p_conover=float(by_conover[i, j]),
                p_wilcoxon=p_wilcoxon,
                family=len(by_wilcoxon),
                effect=rank_biserial(d),
                ratio=_median_ratio(d, blocks.values[:, [i, j]]),
                bayes_a=bayes_a,
                bayes_equal=bayes_equal,
                bayes_b=bayes_b,
                better=better,
                better_low=low,
                better_high=high,
                winner=_decide(blocks, test, float(by_nemenyi[i, j]), (i, j), alpha),
            )
        )
    return pairs


def _median_ratio(d: Array, values: Array) -> float:
    """Invert the median log ratio [B]; beyond every finite difference it is 0 or infinite."""
    median = float(np.median(d))
    largest = np.abs(d[np.isfinite(values).all(axis=1)]).max(initial=0.0)
    if abs(median) <= largest * (1 + 1e-12):
        return math.exp(median)
    return math.inf if median > 0 else 0.0


def _rank_by_scenario(blocks: RankingBlocks) -> ScenarioRanking | None:
    """Repeat the omnibus test with scenarios as blocks."""
    names = list_scenarios(blocks.cells)
    if not MIN_SCENARIOS <= len(names) < len(blocks.cells):
        return None
    rank = rank_within_blocks(blocks.values)
    rows = [[name.split(" / ")[0] == scenario for name in blocks.cells] for scenario in names]
    # Ranks, since errors of different noise regimes differ too much in scale for a median.
    medians = np.array([np.median(rank[mask], axis=0) for mask in rows])
    test = friedman(rank_within_blocks(medians))
    return ScenarioRanking(len(names), test.p, test.p_f, best_ranked(blocks.filters, test.ranks))


def _decide(
    blocks: RankingBlocks, test: FriedmanResult, p: float, pair: tuple[int, int], alpha: float
) -> str:
    """Return the better-ranked filter if the omnibus test and Nemenyi's p are at most alpha."""
    if test.p_f > alpha or p > alpha:
        return INCONCLUSIVE
    i, j = pair
    return blocks.filters[i if test.ranks[i] < test.ranks[j] else j]


def _mean_proportion(
    estimates: Sequence[ProportionEstimate], level: float
) -> tuple[float, float, float]:
    """Average a probability over fixed conditions, with its interval over runs."""
    value = float(np.mean([e.value for e in estimates]))
    several = [e.variance for e in estimates if e.parts.size > 1]
    variance = sum(several) / len(estimates) ** 2
    runs = sum(e.parts.size for e in estimates) if several else 1
    interval = proportion_interval(value, variance, runs, level)
    return value, interval.low, interval.high
