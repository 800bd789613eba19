"""Levels of filters: the location of the log error of each filter, from which a board is made.

The level of a filter in a condition is the 20 % trimmed mean over runs of the logarithm of its error.
A run that does not keep track lies at the upper end. Levels are averaged over conditions. A
difference of levels is transitive, unlike a median of paired ratios: A against B and B against C give A
against C. The influence values of the runs are subtracted before they are squared, so that the
interval of a difference uses that filters share their runs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.report.board.entries import LOG_SCORE
from pfbench.stats.effects import ConditionEffects, EffectEstimate, log_levels
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.pair_effects import estimate_share_difference

_LARGEST_LOG = 700.0  # whose exponential is finite
_CONDITION = ["family", "scenario", "regime"]


class StudyArrays(NamedTuple):
    """Values of all filters F, conditions C and runs N of a study; NaN without a value.

    Attributes:
        filters: Labels, [F].
        conditions: Family, scenario and regime of each condition, C rows.
        values: Values by column of the table, [F, C, N].
        keeps: Runs that keep track, [F, C, N].
        present: Runs that exist, [F, C, N].
    """

    filters: tuple[str, ...]
    conditions: pd.DataFrame
    values: Mapping[str, Array]
    keeps: Flags
    present: Flags

    def select(self, mask: Flags) -> StudyArrays:
        """Select conditions.

        Shapes: mask [C].
        """
        values = {name: value[:, mask] for name, value in self.values.items()}
        return StudyArrays(
            self.filters,
            self.conditions[mask],
            values,
            self.keeps[:, mask],
            self.present[:, mask],
        )


class FilterLevels(NamedTuple):
    """Levels of all filters of a view.

    Attributes:
        level: Mean over conditions of the trimmed mean log error, [F]; infinite if lost runs
            reach the trimmed middle, NaN if a condition is missing.
        parts: Contribution of each run, [F, N].
        middle: Runs that the location of a condition uses at least, [F].
        runs: Runs of the condition that has the fewest, [F].
        off: Conditions in which lost runs reach the trimmed middle, [F, C].
    """

    level: Array
    parts: Array
    middle: Array
    runs: Array
    off: Flags

    def difference(self, i: int, j: int) -> EffectEstimate:
        """Estimate the difference of the levels of two filters."""
        middle = float(min(self.middle[i], self.middle[j]))
        with np.errstate(invalid="ignore"):  # both levels are infinite
            difference = self.level[i] - self.level[j]
        return self._estimate(difference, self.parts[i] - self.parts[j], middle)

    def single(self, i: int) -> EffectEstimate:
        """Estimate the level of one filter."""
        return self._estimate(self.level[i], self.parts[i], float(self.middle[i]))

    def _estimate(self, value: float, parts: Array, middle: float) -> EffectEstimate:
        factor = middle / (middle - 1) if middle > 1 else np.nan
        error = np.sqrt(factor * (parts**2).sum())
        return EffectEstimate(np.asarray(value), np.asarray(error), np.asarray(middle - 1.0))


Descriptions = Mapping[str, Mapping[str, Any]]


class Selection(NamedTuple):
    """Runs of a scope, and what is said of them whatever the metric.

    Attributes:
        world: Scenario, or "all".
        regime: Noise regime, or "all".
        in_scope: Whether a condition is in the scope, [C].
        mask: Whether all filters were run in it too, [C].
        runs: Runs of these conditions.
        groups: Unit and main group of these conditions.
        filters: Description of each filter.
        where: Words on the scope.
        small_print: Note below the view.
    """

    world: str
    regime: str
    in_scope: Flags
    mask: Flags
    runs: StudyArrays
    groups: pd.DataFrame
    filters: Descriptions
    where: str
    small_print: str


def arrange_runs(table: pd.DataFrame, filters: tuple[str, ...]) -> StudyArrays:
    """Arrange the runs of a study as arrays."""
    conditions = table[_CONDITION].drop_duplicates().sort_values(_CONDITION).reset_index(drop=True)
    c, n = (
        table.groupby(columns, dropna=False, observed=True).ngroup().to_numpy()
        for columns in (_CONDITION, ["seed", "run"])
    )
    f = pd.Index(filters).get_indexer(pd.Index(table["filter"]))
    shape = (len(filters), len(conditions), int(n.max(initial=-1)) + 1)

    def arrange(name: str) -> Array:
        values = np.full(shape, np.nan)
        values[f, c, n] = table[name].to_numpy(dtype=np.float64)
        return values

    numbers = table.select_dtypes(["number", "bool"]).columns
    values = {str(name): arrange(str(name)) for name in numbers}
    keeps = values["keeps_track"]
    return StudyArrays(filters, conditions, values, keeps == 1, ~np.isnan(keeps))


def compute_condition_levels(runs: StudyArrays, metric: str) -> ConditionEffects:
    """Compute the level of each filter in each condition."""
    value = runs.values[metric]
    if metric == LOG_SCORE:
        value = np.exp(np.minimum(-value, _LARGEST_LOG))
    return log_levels(value, runs.keeps, runs.present & ~(runs.keeps & np.isnan(value)))


def compare_track_shares(
    runs: StudyArrays, first: str, second: str, alpha: float = 0.05
) -> tuple[float, float]:
    """Compute the interval of the difference of the shares of runs that keep track."""
    i, j = (runs.filters.index(label) for label in (first, second))
    d = np.where(
        runs.present[i] & runs.present[j], runs.keeps[i].astype(float) - runs.keeps[j], np.nan
    )
    weights = np.full((1, len(d)), 1 / len(d))
    low, high = estimate_share_difference(d[None], weights).interval(alpha)
    return max(float(low), -1.0), min(float(high), 1.0)


def average_levels(levels: ConditionEffects, conditions: pd.DataFrame) -> FilterLevels:
    """Average the levels of conditions: worlds, their scenarios, and regimes have equal weight.

    Shapes: levels [F, C].
    """
    keys = list(zip(conditions["family"], conditions["scenario"], strict=True))
    regimes = Counter(keys)
    scenarios = Counter(family for family, _ in regimes)
    counts = (len(scenarios) * scenarios[key[0]] * regimes[key] for key in keys)
    weights = 1 / np.fromiter(counts, np.float64)
    count = levels.runs.min(axis=1)
    with np.errstate(invalid="ignore"):
        level = np.where(count > 0, (weights * levels.location).sum(axis=1), np.nan)
    parts = np.einsum("c,fcn->fn", weights, levels.parts)
    off = np.isposinf(levels.location)
    return FilterLevels(level, parts, levels.middle.min(axis=1), count, off)
