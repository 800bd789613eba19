"""Runs that are not independent: copies of a run, and errors that correlate from run to run.

References:
    R. Bartels (1982), The rank version of von Neumann's ratio test for randomness.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import rankdata

from pfbench.stats.error_measures import Array

ALARM_LEVEL = 0.001  # of the test of all filters together: a study has many readers [ours]
_FEWEST = 10  # runs of a test


class RunAssessment(NamedTuple):
    """Runs of a study that are not independent.

    Attributes:
        copies: The earlier run by each copy.
        sentence: What is left out, and whether neighbouring runs are alike; empty for independent runs.
    """

    copies: dict[Any, Any]
    sentence: str


def assess_runs(table: pd.DataFrame, value: str, run: list[str]) -> RunAssessment:
    """Find copies of runs, and test the other runs for errors that are alike in neighbouring runs."""
    copies = find_copied_runs(table, value, run)
    dependence = describe_dependence(drop_runs(table, copies, run), value, run)
    return RunAssessment(copies, " ".join(filter(None, (describe_copies(copies), dependence))))


def find_copied_runs(table: pd.DataFrame, value: str, run: list[str]) -> dict[Any, Any]:
    """Find runs whose errors are equal, digit by digit, to those of an earlier run.

    A condition in which all runs of a filter have one error is left out: its data are not random.
    """
    wide = table.pivot_table(value, ["filter", "scenario", "regime"], run, dropna=False)
    copies: dict[Any, Any] = {}
    for _, rows in wide.groupby(level="filter", sort=False):
        values = rows.to_numpy()
        largest, least = (
            extreme(np.where(np.isfinite(values), values, fill), 1)
            for extreme, fill in ((np.max, -np.inf), (np.min, np.inf))
        )
        varying = largest > least
        first: dict[bytes, Any] = {}
        for k, name in enumerate(rows.columns):
            column = np.ascontiguousarray(values[varying, k])
            if column.size and np.isfinite(column).all():
                original = first.setdefault(column.tobytes(), name)
                if original != name:
                    copies.setdefault(name, original)
    return copies


def drop_runs(table: pd.DataFrame, runs: dict[Any, Any], run: list[str]) -> pd.DataFrame:
    """Remove the rows of some runs."""
    if not runs:
        return table
    index = pd.MultiIndex.from_frame(table[run]) if len(run) > 1 else pd.Index(table[run[0]])
    return table[~index.isin(list(runs))]


def describe_copies(copies: dict[Any, Any]) -> str:
    """Describe copies in one sentence, empty without any."""
    if not copies:
        return ""
    copy, original = next(iter(copies.items()))
    names = [" ".join(map(str, n)) if isinstance(n, tuple) else str(n) for n in (copy, original)]
    count = f"{len(copies)} runs have" if len(copies) > 1 else "1 run has"
    return (
        f"{count} the errors of another run (run {names[0]} is equal to run {names[1]}) and "
        f"{'are' if len(copies) > 1 else 'is'} left out: copies are not independent."
    )


def lag_p_values(values: Array) -> Array:
    """Test for errors that are alike in neighbouring runs, one-sided, by ranks.

    Returns p-values, [...]; 1 for fewer than 10 runs. Shapes: values [..., n].
    """
    n = values.shape[-1]
    if n < _FEWEST:
        return np.ones(values.shape[:-1])
    ranks = rankdata(values, axis=-1)
    centred = ranks - ranks.mean(axis=-1, keepdims=True)
    total = (centred**2).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        ratio = (np.diff(ranks, axis=-1) ** 2).sum(axis=-1) / total
    variance = 4 * (n - 2) * (5 * n**2 - 2 * n - 9) / (5 * n * (n + 1) * (n - 1) ** 2)
    return np.asarray(np.where(total > 0, ndtr((ratio - 2) / np.sqrt(variance)), 1.0))


def describe_dependence(table: pd.DataFrame, value: str, run: list[str]) -> str:
    """Describe errors that correlate from run to run, empty if none is shown."""
    # Ranks within a condition, since a run that some conditions lack has another mean error than the others.
    ranks = table.groupby(["filter", "scenario", "regime"], sort=False)[value].rank(pct=True)
    wide = table.assign(rank=ranks - 0.5).pivot_table("rank", "filter", run, dropna=False)
    p = {
        str(label): float(lag_p_values(series[np.isfinite(series)]))
        for label, series in zip(wide.index, wide.to_numpy(), strict=True)
    }
    alarms = [label for label, chance in p.items() if chance * len(p) < ALARM_LEVEL]
    if not alarms:
        return ""
    least = min(p[label] for label in alarms) * len(p)
    return (
        f"Errors of neighbouring runs are alike for {len(alarms)} of {len(p)} filters (p = {least:.1g}): the runs "
        "are not independent, and all intervals are too short."
    )


# --------------------------------------------------------------------------------------------------
# Rows of the independent runs of a study: copies of runs are left out of a table of all metrics.

RUN = ["seed", "run"]  # columns that name a run


def select_independent_runs(
    rows: pd.DataFrame, mains: Mapping[tuple[str, str, str], str]
) -> tuple[pd.DataFrame, str]:
    """Leave out copies of runs, as a report does.

    Returns the rows of the other runs, with a sentence on what is left out and whether neighbouring runs are alike; empty for
    independent runs.
    """
    keys = zip(rows["scenario"], rows["noise"], rows["model"], strict=True)
    main = pd.Series(list(keys), index=rows.index).map(mains)
    is_norm = (rows["metric"] == "rmse") & (rows["component"] == "norm")
    errors = rows[is_norm & (rows["group"] == main)]
    regime = errors["noise"].astype(str) + " / " + errors["model"].astype(str)
    table = errors.assign(filter=errors["label"], regime=regime)
    copies, sentence = assess_runs(table, "value", RUN)
    return drop_runs(rows, copies, RUN).reset_index(drop=True), sentence
