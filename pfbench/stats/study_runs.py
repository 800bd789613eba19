"""Runs of a study as arrays: filters, worlds, conditions of a world, and runs.

A world is a family of scenarios. Its conditions are the regimes of its scenarios. Scenarios of a
family have equal weight, and so do regimes of a scenario.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.stats.error_measures import Array, Flags

COLUMNS = ("filter", "scenario", "family", "regime", "run", "value", "keeps_track")


class StudyRuns(NamedTuple):
    """Values of one metric of a study.

    Attributes:
        filters: Labels, [F].
        worlds: Names of the families, [W].
        regimes: Number of distinct regimes.
        scenario: Index of the scenario of each condition within its world, [W, C]; -1 if absent.
        value: Values, [F, W, C, N]; NaN for an absent run.
        keeps_track: Runs that keep track, [F, W, C, N].
        present: Runs that exist, [F, W, C, N].
    """

    filters: tuple[str, ...]
    worlds: tuple[str, ...]
    regimes: int
    scenario: np.ndarray
    value: Array
    keeps_track: Flags
    present: Flags


class PairRuns(NamedTuple):
    """Runs that two filters share.

    Attributes:
        a: Label of the first filter.
        b: Label of the second filter.
        worlds: Names of the worlds with a common run, [W].
        weights: Weights of the conditions, [W, C], with sum 1 for each world.
        value_a: Values of the first filter, [W, C, N]; NaN for an absent run.
        value_b: Values of the second filter, [W, C, N].
        keeps_a: Runs in which the first filter keeps track, [W, C, N].
        keeps_b: Runs in which the second filter keeps track, [W, C, N].
        present: Runs that both have, [W, C, N].
    """

    a: str
    b: str
    worlds: tuple[str, ...]
    weights: Array
    value_a: Array
    value_b: Array
    keeps_a: Flags
    keeps_b: Flags
    present: Flags

    @property
    def runs(self) -> int:
        """Number of runs of the condition that has the fewest."""
        return int(self.present.sum(axis=-1)[self.weights > 0].min())

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of runs in which the filters keep track; worlds have equal weight."""
        first, second = (float(self._mean_share(keeps)) for keeps in (self.keeps_a, self.keeps_b))
        return first, second

    def _mean_share(self, keeps: Flags) -> float:
        count = np.maximum(self.present.sum(axis=-1), 1)
        share = (keeps & self.present).sum(axis=-1) / count
        return float((self.weights * share).sum(axis=-1).mean())


def to_study_runs(table: pd.DataFrame) -> StudyRuns:
    """Arrange a table as arrays.

    Returns arrays of the study.
    """
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing or table.empty:
        raise ValueError(
            f"table must have the columns {', '.join(COLUMNS)} and at least one row, got "
            f"{', '.join(map(str, table.columns))} and {len(table)} rows. Add what is missing."
        )
    keys = ["filter", "scenario", "family", "regime", "run"]
    if table.duplicated(keys).any():
        row = table.loc[table.duplicated(keys), keys].iloc[0].to_dict()
        raise ValueError(
            f"runs must be unique per filter, scenario, family and regime, got {row} twice. "
            "Select one metric, group and seed."
        )
    filters = tuple(sorted(map(str, table["filter"].unique()), key=natural_sort_key))
    worlds = tuple(sorted(map(str, table["family"].unique()), key=natural_sort_key))
    index_of_run = {run: k for k, run in enumerate(sorted(table["run"].unique()))}
    index_of_condition, scenario = _index_conditions(table, worlds)
    index = (
        table["filter"].astype(str).map({name: k for k, name in enumerate(filters)}).to_numpy(),
        table["family"].astype(str).map({name: k for k, name in enumerate(worlds)}).to_numpy(),
        np.array([index_of_condition[key] for key in _condition_keys(table)]),
        table["run"].map(index_of_run).to_numpy(),
    )
    shape = (len(filters), *scenario.shape, len(index_of_run))
    value = np.full(shape, np.nan)
    keeps, present = np.zeros((2, *shape), dtype=bool)
    value[index] = table["value"].to_numpy(dtype=np.float64)
    keeps[index] = table["keeps_track"].to_numpy(dtype=bool)
    present[index] = True
    regimes = int(table["regime"].nunique())
    return StudyRuns(filters, worlds, regimes, scenario, value, keeps, present)


def select_pair(study: StudyRuns, a: str, b: str) -> PairRuns:
    """Select the runs that two filters share.

    Returns runs of both filters; worlds without a common run are left out.
    """
    unknown = [label for label in (a, b) if label not in study.filters]
    if unknown or a == b:
        raise ValueError(
            f"pairs must be two different filters with results, got {a} and {b}. Choose from "
            f"{', '.join(study.filters)}."
        )
    i, j = study.filters.index(a), study.filters.index(b)
    present = study.present[i] & study.present[j]
    weights = condition_weights(study.scenario, present.any(axis=-1))
    used = np.asarray(weights.any(axis=-1))
    if not used.any():
        raise ValueError(f"pairs must share a run, got {a} and {b} without one. Run both filters.")
    worlds = tuple(name for name, is_used in zip(study.worlds, used, strict=True) if is_used)
    columns = (
        study.value[i],
        study.value[j],
        study.keeps_track[i],
        study.keeps_track[j],
        present,
    )
    return PairRuns(a, b, worlds, weights[used], *(column[used] for column in columns))


def have_common_runs(study: StudyRuns, a: str, b: str) -> bool:
    """Return whether two filters share a run."""
    if a not in study.filters or b not in study.filters:
        return False
    i, j = study.filters.index(a), study.filters.index(b)
    return bool((study.present[i] & study.present[j]).any())


def first_runs(study: StudyRuns, runs: int) -> StudyRuns:
    """Select the first runs of a study, in the order of their names."""
    columns = {
        name: getattr(study, name)[..., :runs] for name in ("value", "keeps_track", "present")
    }
    return study._replace(**columns)


def _condition_keys(table: pd.DataFrame) -> list[tuple[str, str, str]]:
    names = ("family", "scenario", "regime")
    return list(zip(*(table[name].astype(str) for name in names), strict=True))


def _index_conditions(
    table: pd.DataFrame, worlds: tuple[str, ...]
) -> tuple[dict[tuple[str, str, str], int], np.ndarray]:
    """Return the index of each condition within its world, and the scenarios, [W, C]."""
    by_world: dict[str, list[tuple[str, str, str]]] = {name: [] for name in worlds}
    for key in sorted(set(_condition_keys(table))):
        by_world[key[0]].append(key)
    scenario = np.full((len(worlds), max(map(len, by_world.values()))), -1)
    index = {}
    for w, keys in enumerate(by_world.values()):
        names = sorted({key[1] for key in keys})
        for c, key in enumerate(keys):
            index[key] = c
            scenario[w, c] = names.index(key[1])
    return index, scenario


def condition_weights(scenario: np.ndarray, present: Flags) -> Array:
    """Compute weights [W, C]: equal for scenarios of a world, and for regimes of a scenario.

    Shapes: scenario [W, C], present [W, C].
    """
    weights = np.zeros(scenario.shape)
    for row, used, names in zip(weights, present, scenario, strict=True):
        scenarios = np.unique(names[used])
        for name in scenarios:
            of_scenario = used & (names == name)
            row[of_scenario] = 1 / (len(scenarios) * of_scenario.sum())
    return weights


# --------------------------------------------------------------------------------------------------
# Results of a study in the form that decisions read.


def tidy_runs(
    frame: pd.DataFrame,
    metric: str = "rmse",
    group: str = "position",
    component: str = "norm",
) -> pd.DataFrame:
    """Select one metric of the table of `load_frame` in the form of `to_study_runs`.

    Args:
        frame: Rows of `load_frame`.
        metric: Name of the metric.
        group: Group of the state; not used for metrics of a job.
        component: Component of the group; not used for metrics of a job.

    Returns:
        Table with the columns of `to_study_runs`.

    Raises:
        ValueError: if no row matches.
    """
    rows = frame[frame["metric"] == metric]
    if rows["group"].nunique() > 1:
        rows = rows[(rows["group"] == group) & (rows["component"] == component)]
    if rows.empty:
        raise ValueError(
            f"metric and group must have results, got {metric} and {group}. Choose from "
            f"{sorted(map(str, frame['metric'].unique()))} and {sorted(map(str, frame['group'].unique()))}."
        )
    return tidy_rows(rows)


def tidy_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Arrange the rows of one metric and component in the form of `to_study_runs`."""
    models = rows.groupby("scenario")["model"].transform("nunique")
    regime = rows["noise"].astype(str).where(models == 1, rows["noise"] + " / " + rows["model"])
    scenario = rows["scenario"].astype(str)
    return pd.DataFrame(
        {
            "filter": rows["label"].astype(str),
            "scenario": scenario,
            "family": rows["family"].astype(str),
            "regime": regime,
            "run": [f"{s:012d} {r:09d}" for s, r in zip(rows["seed"], rows["run"], strict=True)],
            "value": rows["value"].astype(np.float64),
            "keeps_track": rows["keeps_track"].astype(bool),
        }
    )


def natural_sort_key(text: str) -> list[tuple[int, int, str]]:
    """Return a sorting key that puts 400 before 1600."""
    parts = re.split(r"(\d+)", text)
    return [(0, int(text), "") if text.isdigit() else (1, 0, text) for text in parts]
