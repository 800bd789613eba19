"""Tables of comparisons: pairs, and effect sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from pfbench.report.table_formats import format_number
from pfbench.results.comparison.pairwise_results import PairwiseTest


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


def _format_decision(v: PairwiseTest) -> str:
    """Format the decision of a comparison."""
    if v.winner in (v.a, v.b):
        return f"{v.winner} better"
    return "equivalent" if v.equivalent else "inconclusive"


def _format_count(value: float) -> str:
    """Format a count that may be infinite or NaN."""
    return f"{value:.0f}" if np.isfinite(value) else format_number(float(value))
