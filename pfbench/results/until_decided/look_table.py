"""Table of the main error of all runs until a look, from the stored results of a study."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from pfbench.results.conditions import Condition, load_conditions
from pfbench.results.decisions.tidy_table import tidy_runs
from pfbench.results.frame import to_long_rows
from pfbench.results.state_groups import main_component_group


class LookTable(NamedTuple):
    """Results of a study until a look.

    Attributes:
        runs: Table for decisions, see `study_runs.to_study_runs`.
        pairs: Planned pairs that share a condition.
        parts: Number of result files.
        seconds: Time that the simulation and the filters used, s.
    """

    runs: pd.DataFrame
    pairs: list[tuple[str, str]]
    parts: int
    seconds: float


def read_look_table(
    study: str,
    results: Path,
    keys: Collection[str],
    list_pairs: Callable[[Collection[str]], list[tuple[str, str]]],
) -> LookTable:
    """Read the main error of the jobs of a look.

    Args:
        study: Name of the study.
        results: Folder of all studies.
        keys: Keys of all jobs until the look.
        list_pairs: Function that lists the planned pairs of labels.

    Returns:
        The table and its pairs.

    Raises:
        FileNotFoundError: if no result exists.
        ValueError: if results do not belong together.
    """
    conditions = load_conditions(study, results, keys=keys)
    rows = pd.concat([_main_errors(condition) for condition in conditions], ignore_index=True)
    labels = {job.label for condition in conditions for job in condition.jobs}
    labels_by_condition = [{job.label for job in condition.jobs} for condition in conditions]
    pairs = [
        pair
        for pair in list_pairs(labels)
        if any(set(pair) <= names for names in labels_by_condition)
    ]
    jobs = [job for condition in conditions for job in condition.jobs]
    seconds = sum(job.meta["seconds"]["world"] + job.meta["seconds"]["filter"] for job in jobs)
    parts = sum(len(job.parts) for job in jobs)
    return LookTable(tidy_runs(rows), pairs, parts, float(seconds))


def _main_errors(condition: Condition) -> pd.DataFrame:
    """Return the root mean square errors of the main group of a condition, one row per run."""
    tables = []
    for job in condition.jobs:
        result = job.load()
        rows = to_long_rows(condition, job, result, 0.0, {})
        group = main_component_group(result.meta["state"])
        is_main = (rows["metric"] == "rmse") & (rows["group"] == group.group)
        tables.append(rows[is_main & (rows["component"] == "norm")])
    # the main groups of the scenarios may have different names
    return pd.concat(tables, ignore_index=True).assign(group="main")
