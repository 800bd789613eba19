"""Levels of filters: the location of the log error of each filter, from which a board is made.

The level of a filter in a condition is the 20 % trimmed mean over runs of the logarithm of its error.
A run that loses the track lies at the upper end. Levels are averaged over conditions. A
difference of levels is transitive, unlike a median of paired ratios: A against B and B against C give A
against C. The influence values of the runs are subtracted before they are squared, so that the
interval of a difference uses that filters share their runs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results.error_measures import Array, Flags
from pfbench.results.statistics.paired_effects import trimmed_effects
from pfbench.results.statistics.world_effects import EffectEstimate


class RunArrays(NamedTuple):
    """Values of one view.

    Attributes:
        filters: Labels, [F].
        weights: Weights of the conditions with sum 1, [C].
        value: Errors, [F, C, N]; NaN without a value.
        keeps: Runs that keep track, [F, C, N].
        present: Runs that exist, [F, C, N].
    """

    filters: tuple[str, ...]
    weights: Array
    value: Array
    keeps: Flags
    present: Flags


class FilterLevels(NamedTuple):
    """Levels of all filters of a view.

    Attributes:
        level: Mean over conditions of the trimmed mean log error, [F]; infinite if lost runs
            reach the trimmed middle, NaN if a condition is missing.
        parts: Contribution of each run, [F, N].
        middle: Runs that the location of a condition uses at least, [F].
        runs: Runs of the condition that has the fewest, [F].
    """

    level: Array
    parts: Array
    middle: Array
    runs: Array

    def difference(self, i: int, j: int) -> EffectEstimate:
        """Estimate the difference of the levels of two filters.

        Args:
            i: Index of the first filter.
            j: Index of the second filter.
        """
        middle = float(min(self.middle[i], self.middle[j]))
        return self._estimate(self.level[i] - self.level[j], self.parts[i] - self.parts[j], middle)

    def single(self, i: int) -> EffectEstimate:
        """Estimate the level of one filter.

        Args:
            i: Index of the filter.
        """
        return self._estimate(self.level[i], self.parts[i], float(self.middle[i]))

    def _estimate(self, value: float, parts: Array, middle: float) -> EffectEstimate:
        factor = middle / (middle - 1) if middle > 1 else np.nan
        error = np.sqrt(factor * (parts**2).sum())
        return EffectEstimate(np.asarray(value), np.asarray(error), np.asarray(middle - 1.0))


def arrange_runs(table: pd.DataFrame, metric: str, filters: tuple[str, ...]) -> RunArrays:
    """Arrange the runs of a view as arrays.

    Args:
        table: Rows of `build_run_table` of the view.
        metric: Column of the error.
        filters: Labels of all filters of the study.
    """
    names = ["family", "scenario", "regime"]
    conditions = table[names].drop_duplicates().sort_values(names).reset_index(drop=True)
    families = conditions["family"].nunique()
    scenarios = conditions.groupby("family")["scenario"].transform("nunique")
    regimes = conditions.groupby(["family", "scenario"])["regime"].transform("size")
    weights = (1 / (families * scenarios * regimes)).to_numpy(dtype=np.float64)
    index = pd.MultiIndex.from_frame(conditions)
    c = index.get_indexer(pd.MultiIndex.from_frame(table[names]))
    run_names = table[["seed", "run"]].drop_duplicates().sort_values(["seed", "run"])
    runs = pd.MultiIndex.from_frame(run_names)
    n = runs.get_indexer(pd.MultiIndex.from_frame(table[["seed", "run"]]))
    f = pd.Index(filters).get_indexer(pd.Index(table["filter"]))
    shape = (len(filters), len(conditions), len(runs))
    value, keeps, present = np.full(shape, np.nan), np.zeros(shape, bool), np.zeros(shape, bool)
    value[f, c, n] = table[metric].to_numpy(dtype=np.float64)
    keeps[f, c, n] = table["keeps_track"].to_numpy(dtype=bool)
    present[f, c, n] = True
    return RunArrays(filters, weights, value, keeps, present)


def compute_levels(runs: RunArrays) -> FilterLevels:
    """Compute the levels of all filters of a view.

    Args:
        runs: Values of the view.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log_error = np.where(runs.keeps, np.log(runs.value), np.inf)
    log_error = np.where(runs.present & ~(runs.keeps & np.isnan(runs.value)), log_error, np.nan)
    effects = trimmed_effects(log_error)
    count = effects.runs.min(axis=1)
    with np.errstate(invalid="ignore"):
        level = np.where(count > 0, (runs.weights * effects.location).sum(axis=1), np.nan)
    parts = np.einsum("c,fcn->fn", runs.weights, effects.parts)
    return FilterLevels(level, parts, effects.middle.min(axis=1), count)
