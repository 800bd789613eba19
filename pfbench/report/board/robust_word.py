"""The word "robust": what a filter must show against a tuned control before a sentence may say it.

On a model whose process noise is too large, a constant factor on R improves a filter in every
regime. A robust filter must therefore be better than the EKF with tuned factors in outliers, and
not worse than 1.05 times its error in nominal noise. Both must be shown, so the p-value of a filter
is the larger of two one-sided ones, and Holm's correction is over the filters [ours].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import stdtr

from pfbench.report.board.levels import (
    FilterLevels,
    StudyArrays,
    arrange_runs,
    average_levels,
    compute_condition_levels,
)
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import parse_label
from pfbench.results.looks import MethodLook, find_looks
from pfbench.results.paper_block import REFERENCES, list_tuned_worlds
from pfbench.stats.effects import MIN_RUNS, ConditionEffects, EffectEstimate
from pfbench.stats.error_measures import Flags
from pfbench.stats.rank_tests import holm

CONTROL = REFERENCES[0]  # EKF with tuned constant factors on R and Q
OUTLIER_REGIME, NOMINAL_REGIME = "outliers", "nominal"
NOMINAL_LIMIT = 1.05  # largest ratio of errors to the control in nominal noise


class RobustnessEvidence(NamedTuple):
    """Log error of a filter minus that of the control, in two regimes.

    Attributes:
        outliers: Difference in outliers.
        nominal: Difference in nominal noise.
    """

    outliers: EffectEstimate
    nominal: EffectEstimate


def describe_robustness(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], options: ReportOptions
) -> str:
    """Describe which filters of a study are robust, or what the study lacks for the word.

    The scenarios that have both regimes are compared, with equal weight, by the levels of the board.

    Returns sentences, empty for a study without outliers.
    """
    noise, scenario = table["regime"].str.partition(" + ")[0], table["scenario"]
    regimes = (OUTLIER_REGIME, NOMINAL_REGIME)
    common = set.intersection(*(set(scenario[noise == name]) for name in regimes))
    if OUTLIER_REGIME not in set(noise):
        return ""
    lacking = [] if CONTROL in looks else [f"the control {find_looks([CONTROL])[CONTROL].name}"]
    lacking += [] if common else ["nominal noise in the worlds with outliers"]
    if lacking:
        return f"No filter can be called robust: the study lacks {' and '.join(lacking)}."
    evidence = compare_with_control(table[scenario.isin(common)], tuple(looks), options.metric)
    if evidence is None:
        return f"No filter can be called robust: the control {looks[CONTROL].name} has fewer than {MIN_RUNS} runs in a condition."  # fmt: skip
    names = {label: looks[label].name for label in evidence}
    text = describe_robust_filters(names, find_robust_filters(evidence, options.alpha))
    tuning = looks[CONTROL].tuning
    stated = list_tuned_worlds(tuning)
    is_foreign = stated and not any(parse_label(key)[0] in stated for key in common)
    return f"{text} The control was tuned in another world, {tuning}." if is_foreign else text


def compare_with_control(
    table: pd.DataFrame, filters: tuple[str, ...], metric: str = "rmse", control: str = CONTROL
) -> dict[str, RobustnessEvidence] | None:
    """Compare the errors of filters with those of a control, in outliers and in nominal noise.

    Args:
        table: Table of `build_run_table`, of scenarios that have both regimes.
        filters: Labels of all filters, the control included.
        metric: Column of the error.
        control: Label of the control.

    Returns:
        Differences by label of the filters with enough runs; None if the control has not enough.
    """
    runs = arrange_runs(table, filters)
    noise = runs.conditions["regime"].str.partition(" + ")[0]
    levels = compute_condition_levels(runs, metric)
    outliers, nominal = (
        _average(runs, levels, (noise == name).to_numpy())
        for name in (OUTLIER_REGIME, NOMINAL_REGIME)
    )
    present, k = np.minimum(outliers.runs, nominal.runs), filters.index(control)
    if present[k] < MIN_RUNS:
        return None
    return {
        label: RobustnessEvidence(outliers.difference(i, k), nominal.difference(i, k))
        for i, label in enumerate(filters)
        if i != k and present[i] >= MIN_RUNS
    }


def _average(runs: StudyArrays, levels: ConditionEffects, mask: Flags) -> FilterLevels:
    """Average the levels of the selected conditions."""
    selected = ConditionEffects(*(array[:, mask] for array in levels))
    return average_levels(selected, runs.conditions[mask])


def find_robust_filters(
    evidence: Mapping[str, RobustnessEvidence], alpha: float = 0.05
) -> tuple[str, ...]:
    """Return the filters that a sentence may call robust.

    Args:
        evidence: Differences to the control by label, for all filters of the study but the control.
        alpha: Probability that any filter is called robust wrongly.

    Returns:
        Labels in the given order.
    """
    p = [
        max(_p_below(pair.outliers, 0.0), _p_below(pair.nominal, math.log(NOMINAL_LIMIT)))
        for pair in evidence.values()
    ]
    adjusted = holm(p) if p else np.zeros(0)
    return tuple(name for name, value in zip(evidence, adjusted, strict=True) if value <= alpha)


def describe_robust_filters(names: Mapping[str, str], robust: tuple[str, ...]) -> str:
    """Describe which filters are robust.

    Returns a sentence, empty without a comparison.
    """
    if not names:
        return ""
    rule = (
        "better than the EKF with tuned noise covariances in outliers, and at most "
        f"{NOMINAL_LIMIT} times its error in nominal noise"
    )
    if not robust:
        return f"No filter is shown to be robust: {rule}."
    listed = [f"[[{names[label]}]]" for label in robust]
    text = " and ".join(filter(None, [", ".join(listed[:-1]), listed[-1]]))
    return f"Robust: {text} ({rule})."


def _p_below(effect: EffectEstimate, limit: float) -> float:
    """Compute the one-sided p-value of an effect that is not below a limit; 1 without an estimate."""
    value, error, df = (float(a) for a in effect)
    if not (math.isfinite(value) and math.isfinite(error) and df > 0):
        return 1.0
    if error == 0.0:  # identical in all runs
        return 0.0 if value < limit else 1.0
    return float(stdtr(df, (value - limit) / error))
