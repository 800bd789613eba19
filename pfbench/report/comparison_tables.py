"""Tables of comparisons: pairs, effect sizes, ranks, baselines and lost-run rules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from pfbench.report.baselines import BaselineComparison
from pfbench.report.table_formats import format_number
from pfbench.results.comparison.lost_run_rules import LOST_RUN_RULES
from pfbench.results.comparison.lost_run_sensitivity import LostRunSensitivity
from pfbench.results.comparison.pairwise_results import PairwiseTest
from pfbench.results.comparison.ranking_results import RankingResult


def decision_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the table of decisions, a row per pair of filters."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "pairs": v.pairs,
                "lost runs a": v.lost_a,
                "lost runs b": v.lost_b,
                "RMSE change a vs b [%]": 100 * (v.ratio - 1),
                "lower [%]": 100 * (v.low - 1),
                "upper [%]": 100 * (v.high - 1),
                "interval method": v.interval,
                "rank-biserial correlation": v.effect,
                "T": v.statistic,
                "p": v.p,
                f"adjusted p (Holm, {v.family} tests)": v.p_holm,
                "decision": _format_decision(v),
            }
            for v in verdicts
        ]
    )


def effect_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the table of effect sizes, equivalence and required runs, a row per pair."""
    return pd.DataFrame(
        [
            {
                "a": v.a,
                "b": v.b,
                "rank-biserial correlation": v.effect,
                "correlation lower": v.effect_low,
                "correlation upper": v.effect_high,
                "P(error a < error b)": v.better,
                "P lower": v.better_low,
                "P upper": v.better_high,
                f"adjusted equivalence p (±{100 * v.margin:g} %, {v.family} tests)": v.p_equivalent,
                "equivalent": v.equivalent,
                "SD of log RMSE ratio [%]": 100 * v.scatter,
                f"runs required for ±{100 * v.target_effect:g} % (power 0.8)": _format_count(
                    v.needed
                ),
                "smallest detectable change [%]": 100 * v.detectable,
            }
            for v in verdicts
        ]
    )


def all_comparisons_table(verdicts: Sequence[PairwiseTest]) -> pd.DataFrame:
    """Build the short table of all comparisons of the report."""
    return pd.DataFrame(
        [
            {
                "condition": f"{v.scenario} / {v.noise} / {v.model}",
                "group": v.group,
                "a": v.a,
                "b": v.b,
                "RMSE change a vs b [%]": 100 * (v.ratio - 1),
                "P(error a < error b)": v.better,
                "adjusted p (Holm, condition)": v.p_holm,
                f"adjusted p (Holm, {v.page} tests)": v.p_page,
                "decision": _format_decision(v),
            }
            for v in verdicts
        ]
    )


def rank_table(rankings: Sequence[RankingResult]) -> pd.DataFrame:
    """Build the table of mean ranks over conditions, a column per group."""
    tested = [ranking for ranking in rankings if not ranking.refused]
    labels = list(dict.fromkeys(label for ranking in tested for label in ranking.filters))
    by_group = {
        f"rank, {ranking.group}": dict(zip(ranking.filters, ranking.ranks, strict=True))
        for ranking in tested
    }
    return pd.DataFrame(
        [
            {"filter": label, **{k: ranks.get(label, np.nan) for k, ranks in by_group.items()}}
            for label in labels
        ]
    )


def ranking_pair_table(ranking: RankingResult) -> pd.DataFrame:
    """Build the table of pairs across conditions for a group."""
    return pd.DataFrame(
        [
            {
                "a": p.a,
                "b": p.b,
                "conditions won (a, b)": f"{p.wins}, {p.losses}",
                "RMSE change a vs b [%]": 100 * (p.ratio - 1),
                "rank-biserial correlation": p.effect,
                f"adjusted p (Nemenyi, {p.family} tests)": p.p_nemenyi,
                f"adjusted p (Conover, Holm, {p.family} tests)": p.p_conover,
                f"adjusted p (Wilcoxon, Holm, {p.family} tests)": p.p_wilcoxon,
                "P(a better), Bayesian signed rank": p.bayes_a,
                f"P(equivalent within ±{100 * ranking.margin:g} %)": p.bayes_equal,
                "P(b better)": p.bayes_b,
                "P(error a < error b)": p.better,
                "P lower": p.better_low,
                "P upper": p.better_high,
                "decision": f"{p.winner} better" if p.winner in (p.a, p.b) else "inconclusive",
            }
            for p in ranking.pairs
        ]
    )


def baseline_table(pairs: Sequence[BaselineComparison]) -> pd.DataFrame:
    """Build the table of proposed methods against baselines, a row per pair."""
    return pd.DataFrame(
        [
            {
                "method": pair.method,
                "baseline": pair.baseline,
                "conditions": len(pair.cells),
                "better": pair.better,
                "worse": pair.worse,
                "inconclusive": len(pair.cells) - pair.better - pair.worse,
                "RMSE change vs baseline [%]": 100 * (pair.ratio - 1),
                "rank-biserial correlation": pair.effect,
                "p": pair.p,
                f"adjusted p (Holm, {pair.family} tests)": pair.p_holm,
                "decision across conditions": pair.decided,
            }
            for pair in pairs
        ]
    )


def lost_rule_table(sensitivities: Sequence[LostRunSensitivity]) -> pd.DataFrame:
    """Build the table of decisions that depend on the lost-run rule."""
    rules = [rule.name for rule in LOST_RUN_RULES]
    return pd.DataFrame(
        [
            {
                "condition": s.cell,
                "group": s.group,
                "a": s.a,
                "b": s.b,
                **dict(zip(rules, s.winners, strict=True)),
            }
            for s in sensitivities
        ]
    )


def _format_decision(v: PairwiseTest) -> str:
    """Format the decision of a comparison."""
    if v.winner in (v.a, v.b):
        return f"{v.winner} better"
    return "equivalent" if v.equivalent else "inconclusive"


def _format_count(value: float) -> str:
    """Format a count that may be infinite or NaN."""
    return f"{value:.0f}" if np.isfinite(value) else format_number(float(value))
