"""Runs of a study as arrays, and the losses of two filters in a selection of its conditions.

A world is a family of scenarios. Its conditions are the regimes of its scenarios. Worlds have equal weight, so have
the scenarios of a world, and the regimes of a scenario. A run of several conditions is one unit: its loss is the
mean over these conditions, because runs with one number share random numbers.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pfbench.stats.comparison import Effect, Unit, compare_all, subtract_losses
from pfbench.stats.error_measures import Array, Flags

if TYPE_CHECKING:
    import pandas as pd

CONDITION = ["family", "scenario", "regime"]
LOG_SCORE = (
    "log_score"  # the only metric that is a logarithm, with larger values for better filters
)
LEAST_ERROR = 1e-300  # an error of exactly 0 has a finite loss
_ROUNDING = 1e-9  # of a sum of weights


class StudyRuns(NamedTuple):
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

    def take_first(self, number: int) -> StudyRuns:
        """Take the first runs."""
        values = {name: value[..., :number] for name, value in self.values.items()}
        return self._replace(
            values=values, keeps=self.keeps[..., :number], present=self.present[..., :number]
        )

    def select(self, mask: Flags) -> StudyRuns:
        """Select conditions.

        Shapes: mask [C].
        """
        values = {name: value[:, mask] for name, value in self.values.items()}
        return self._replace(
            conditions=self.conditions[mask],
            values=values,
            keeps=self.keeps[:, mask],
            present=self.present[:, mask],
        )


def arrange_runs(table: pd.DataFrame, filters: Sequence[str]) -> StudyRuns:
    """Arrange a table with one row per filter, condition and run as arrays.

    The axis of runs has the numbers of the runs, and of several seeds of a scenario one after the other.

    Args:
        table: Columns filter, family, scenario, regime, seed, run, keeps_track and those of the metrics.
        filters: Labels of the filters.

    Raises:
        ValueError: If a run is there twice.
    """
    import pandas as pd  # on use, so that a job starts without it

    conditions = table[CONDITION].drop_duplicates().sort_values(CONDITION).reset_index(drop=True)
    c = table.groupby(CONDITION, dropna=False, observed=True).ngroup().to_numpy()
    seed = table.groupby("scenario", observed=True)["seed"].rank(method="dense")
    n = table.assign(seed=seed).groupby(["seed", "run"]).ngroup().to_numpy()
    f = pd.Index(filters).get_indexer(pd.Index(table["filter"]))
    shape = (len(filters), len(conditions), int(n.max(initial=-1)) + 1)
    _check_unique(table, np.ravel_multi_index((f, c, n), shape))

    def arrange(name: str) -> Array:
        values = np.full(shape, np.nan)
        values[f, c, n] = table[name].to_numpy(dtype=np.float64)
        return values

    numbers = table.select_dtypes(["number", "bool"]).columns
    values = {str(name): arrange(str(name)) for name in numbers}
    keeps = values["keeps_track"]
    return StudyRuns(tuple(filters), conditions, values, keeps == 1, ~np.isnan(keeps))


def compute_losses(runs: StudyRuns, metric: str) -> Array:
    """Compute the losses of all runs, [F, C, N]: the logarithm of the error, infinite for a run that does not keep track.

    A run that a filter does not have, or that lacks a value of the metric, is NaN.

    Args:
        runs: Runs of a study.
        metric: Column of the error.
    """
    value = runs.values[metric]
    if metric == LOG_SCORE:
        losses = -value
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            losses = np.log(np.maximum(value, LEAST_ERROR))
    return np.where(runs.present & ~runs.keeps, np.inf, np.where(runs.present, losses, np.nan))


def weigh_conditions(conditions: pd.DataFrame) -> Array:
    """Return the weight of each condition, [C], with sum 1."""
    return _weigh(tuple(zip(conditions["family"], conditions["scenario"], strict=True)))


@lru_cache(maxsize=1024)
def _weigh(keys: tuple[tuple[str, str], ...]) -> Array:
    """Return the weights of conditions of some worlds and scenarios."""
    regimes = Counter(keys)
    scenarios = Counter(family for family, _ in regimes)
    counts = [len(scenarios) * scenarios[key[0]] * regimes[key] for key in keys]
    return 1 / np.array(counts, dtype=np.float64)


def compare_filters(
    runs: StudyRuns, losses: Array, pairs: Sequence[tuple[str, str]], unit: Unit = "run"
) -> list[Effect]:
    """Compare pairs of filters over the conditions that both have, by run or by world.

    Args:
        runs: Runs of a study.
        losses: Losses of `compute_losses`, [F, C, N].
        pairs: Labels of the first and the second filter of each pair.
        unit: What was drawn independently: a run or a world.
    """
    index = {label: k for k, label in enumerate(runs.filters)}
    keys = np.empty(len(runs.conditions), dtype=object)
    keys[:] = list(zip(runs.conditions["family"], runs.conditions["scenario"], strict=True))
    families = runs.conditions["family"].to_numpy()
    worlds = [families == name for name in dict.fromkeys(families)] if unit == "world" else []
    members = []
    for a, b in pairs:
        first, second = losses[index[a]], losses[index[b]]
        if unit == "world":
            sides = [_average_runs(keys[w], first[w], second[w]) for w in worlds]
            sides = [side for side in sides if len(side[0])]
            members.append(locate_groups((a, b), sides))
        else:
            averages = _average_runs(keys, first, second)
            members.append(((a, averages[0]), (b, averages[1])))
    return compare_all(members, unit)


def locate_groups(
    names: tuple[str, str], groups: Sequence[tuple[Array, Array]]
) -> tuple[tuple[str, Array], tuple[str, Array]]:
    """Return the log ratio of a pair in each group of runs as losses, and 0 as second losses: of worlds or drives.

    Args:
        names: Names of the two filters.
        groups: Losses of both in the runs of each group, [n].
    """
    a, b = names
    located = [
        Effect(a, b, "run", subtract_losses(*sides), np.nan, np.nan, np.nan).location  # no tests
        for sides in groups
    ]
    d = np.array(located, dtype=np.float64)
    return (a, np.where(d == -np.inf, 0.0, d)), (b, np.where(d == -np.inf, np.inf, 0.0))


def share_conditions(runs: StudyRuns, a: str, b: str) -> bool:
    """Return whether two filters have runs of the same number in a condition."""
    i, j = runs.filters.index(a), runs.filters.index(b)
    return bool((runs.present[i] & runs.present[j]).any())


def select_conditions(present: Flags) -> Flags:
    """Select the conditions that all filters have, [C]; those of the filters that have most if few do.

    The selection that keeps more results wins. If both keep equally many, no filter is left out. If neither has two
    filters, nothing is selected. Shapes: present [F, C].
    """
    filters, conditions = np.asarray(present.any(axis=1)), np.asarray(present.any(axis=0))
    shared = np.asarray(conditions & present[filters].all(axis=0))
    complete = np.asarray(filters & present[:, conditions].all(axis=1))
    keeps_filters = filters.sum() * shared.sum() if filters.sum() >= 2 else 0
    keeps_conditions = complete.sum() * conditions.sum() if complete.sum() >= 2 else 0
    if keeps_filters == keeps_conditions == 0:
        return np.zeros_like(conditions)
    return conditions if keeps_conditions > keeps_filters else shared


def natural_sort_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sorting key that puts 400 before 1600."""
    parts = re.split(r"(\d+)", text)
    return [(0, int(text), "") if text.isdigit() else (1, 0, text) for text in parts]


def _check_unique(table: pd.DataFrame, index: np.ndarray) -> None:
    """Check that each filter, condition and run has one row."""
    first = np.unique(index, return_index=True)[1]
    if len(first) < len(index):
        row = table.iloc[int(np.setdiff1d(np.arange(len(index)), first)[0])]
        names = ", ".join(f"{name}={row[name]}" for name in ("filter", *CONDITION, "run"))
        raise ValueError(
            f"runs must be unique per filter, scenario and regime, got {names} twice. Select one model and seed."
        )


def _average_runs(keys: np.ndarray, first: Array, second: Array) -> tuple[Array, Array]:
    """Average the losses [C, N] of each run over the conditions that both filters have, [n].

    Only runs of all these conditions count. A run is lost by the filter that loses it in more of the conditions; both
    lose it that lose it in as many. Shapes: keys [C], world and scenario of each condition.
    """
    common = ~(np.isnan(first) | np.isnan(second))
    used = common.any(axis=1)
    if not used.any():
        return np.zeros(0), np.zeros(0)
    everywhere = common[used].all(axis=0)
    if used.sum() == 1:  # its losses are the averages
        return first[used][0, everywhere], second[used][0, everywhere]
    weights = _weigh(tuple(keys[used]))
    both = np.stack([first, second])[:, used][:, :, everywhere]
    is_lost = np.isposinf(both)
    lost = np.einsum("c,scn->sn", weights, is_lost.astype(float))
    mean = np.einsum("c,scn->sn", weights, np.where(is_lost, 0.0, both))
    loses = (lost > 0) & (lost >= lost[::-1] - _ROUNDING)
    mean = np.where(loses, np.inf, mean)
    return mean[0], mean[1]
