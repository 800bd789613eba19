"""Decisions within conditions that change with the rule for lost runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from pfbench.results.comparison.lost_run_rules import (
    LOST_RUN_RULES,
    LostRunRule,
    pair_errors,
    rmse_by_run,
)
from pfbench.results.comparison.pairwise_results import decide_winner
from pfbench.results.statistics.effect_sizes import log_ratio, rank_biserial
from pfbench.results.statistics.signed_rank import holm, wilcoxon_samples


@dataclass(frozen=True)
class LostRunSensitivity:
    """Decision that depends on the rule for lost runs.

    Attributes:
        cell: Condition, as scenario / noise / model.
        group: Group of the state.
        a: Label of the first filter.
        b: Label of the second filter.
        winners: Decision by each of `LOST_RUN_RULES`.
    """

    cell: str
    group: str
    a: str
    b: str
    winners: tuple[str, ...]


def lost_rule_sensitivity(table: pd.DataFrame, alpha: float = 0.05) -> list[LostRunSensitivity]:
    """List the comparisons whose winner changes with the rule for lost runs.

    Args:
        table: Rows of `load_frame`.
        alpha: Level after Holm's correction.

    Returns:
        One entry per comparison that changes.
    """
    rows = (table.metric == "rmse") & (table.component == "norm")
    if not np.isinf(table.value[rows]).any():
        return []
    cache: dict[bytes, tuple[float, float]] = {}  # pairs without a lost run are equal by each rule
    by_rule = [_winners(table, alpha, rule, cache) for rule in LOST_RUN_RULES]
    changed = []
    for (scenario, noise, model, group, a, b), worst in by_rule[0].items():
        key = (scenario, noise, model, group, a, b)
        winners = (worst, *(others.get(key, "no pair left") for others in by_rule[1:]))
        if len(set(winners)) > 1:
            condition = f"{scenario} / {noise} / {model}"
            changed.append(LostRunSensitivity(condition, group, a, b, winners))
    return changed


def _winners(
    table: pd.DataFrame, alpha: float, rule: LostRunRule, cache: dict[bytes, tuple[float, float]]
) -> dict[tuple[str, ...], str]:
    """Decide all pairs by a rule for lost runs."""
    winners: dict[tuple[str, ...], str] = {}
    for condition, wide in rmse_by_run(table, rule):
        pairs = list(pair_errors(wide))
        fresh = [errors for _, errors in pairs if errors.tobytes() not in cache]
        differences = [log_ratio(*errors.T) for errors in fresh]
        for errors, d, p in zip(fresh, differences, wilcoxon_samples(differences)[1], strict=True):
            cache[errors.tobytes()] = float(p), rank_biserial(d)
        tested = [cache[errors.tobytes()] for _, errors in pairs]
        for (labels, _), (_, effect), p in zip(
            pairs, tested, holm([p for p, _ in tested]), strict=True
        ):
            winners[(*condition, *labels)] = decide_winner(*labels, effect, float(p), alpha)
    return winners
