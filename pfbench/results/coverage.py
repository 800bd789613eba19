"""Coverage of the central 90 % intervals of filters, decided once per condition.

Components and steps of a run are dependent, so runs are the sample: intervals use the variation
between runs [ours].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from pfbench.results.statistics.intervals import proportion_interval

LEVEL = 90  # percent
UNDER_COVERAGE, OVER_COVERAGE = "under-coverage", "over-coverage"
CONSISTENT = f"consistent with {LEVEL} %"


@dataclass(frozen=True)
class CoverageResult:
    """Coverage of the central 90 % interval of one filter, for one group of one condition.

    Attributes:
        scenario: Scenario of the condition.
        noise: Noise regime of the condition.
        model: Model of the condition.
        group: Group of the state.
        label: Filter.
        share: Coverage over components and scored steps, mean over valid runs.
        low: Lower end of its interval over runs, corrected for `family` intervals (Bonferroni).
        high: Upper end of that interval.
        runs: Number of runs included.
        family: Number of groups and filters of the condition.
        decision: "under-coverage", "over-coverage" or "consistent with 90 %".
    """

    scenario: str
    noise: str
    model: str
    group: str
    label: str
    share: float
    low: float
    high: float
    runs: int
    family: int
    decision: str


def compute_coverage(runs: pd.DataFrame, alpha: float = 0.05) -> list[CoverageResult]:
    """Compute the coverage of each group and filter of a condition that was scored.

    Args:
        runs: Rows of the condition from `load_frame`.
        alpha: Probability outside all intervals together.

    Returns:
        One result per group and filter.
    """
    rows = runs[(runs.metric == f"coverage_{LEVEL}") & runs.value.notna()]
    keys = ["scenario", "noise", "model", "group", "label"]
    parts = list(rows.groupby(keys, sort=False).value)
    return [
        _judge(tuple(map(str, key)), values.to_numpy(dtype=np.float64), alpha, len(parts))
        for key, values in parts
    ]


def format_coverage(results: Sequence[CoverageResult], group: str) -> str:
    """Describe the coverage of one group in a sentence; empty without scores.

    Args:
        results: Coverage of all groups and filters.
        group: Group of the state.
    """
    rows = [row for row in results if row.group == group]
    parts = []
    for decision in (UNDER_COVERAGE, OVER_COVERAGE):
        names = [
            f"{row.label} ({100 * row.share:.0f} %)" for row in rows if row.decision == decision
        ]
        if names:
            parts.append(f"{decision} for {', '.join(names)}")
    rest = [row.label for row in rows if row.decision == CONSISTENT]
    if rest:
        parts.append(f"{CONSISTENT} for {', '.join(rest)}")
    return f"Coverage of the central {LEVEL} % interval: {', '.join(parts)}." if parts else ""


def _judge(key: tuple[str, ...], values: np.ndarray, alpha: float, family: int) -> CoverageResult:
    """Decide the coverage of one filter from its runs."""
    runs, share = len(values), float(values.mean())
    variance = float(values.var(ddof=1)) / runs if runs > 1 else np.nan
    if 0 < share < 1 and not variance > 0:
        # One run, or equal runs: at most the variance of single trials.
        variance = share * (1 - share) / runs
    interval = proportion_interval(share, variance, runs, 1 - alpha / family)
    level = LEVEL / 100
    decision = UNDER_COVERAGE if interval.high < level else CONSISTENT
    decision = OVER_COVERAGE if interval.low > level else decision
    scenario, noise, model, group, label = key
    return CoverageResult(
        scenario=scenario,
        noise=noise,
        model=model,
        group=group,
        label=label,
        share=share,
        low=interval.low,
        high=interval.high,
        runs=runs,
        family=family,
        decision=decision,
    )
