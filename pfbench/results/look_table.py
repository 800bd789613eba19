"""Table of the main metric of all runs until a look, from the stored results of a study."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from pfbench.results.conditions import load_conditions
from pfbench.results.frame import list_main_groups, to_long_rows
from pfbench.stats.main_metrics import select_main_metrics, tidy_main
from pfbench.stats.run_dependence import select_independent_runs

_MAIN = "main"  # the main groups of the scenarios may have different names


class LookMetric(NamedTuple):
    """Metric that decides at a look.

    Attributes:
        name: Main metric of the study, one of `MAIN_METRICS`.
        start_s: Time before which the metric leaves out the steps, s.
    """

    name: str = "rmse"
    start_s: float = 0.0


class LookTable(NamedTuple):
    """Results of a study until a look.

    Attributes:
        runs: Table for decisions, see `study_runs.to_study_runs`, without copies of runs.
        pairs: Planned pairs that share a condition.
        parts: Number of result files.
        seconds: Time that the simulation and the filters used, s.
        warning: Sentence on runs that are not independent; empty if none is shown.
    """

    runs: pd.DataFrame
    pairs: list[tuple[str, str]]
    parts: int
    seconds: float
    warning: str = ""


def read_look_table(
    study: str,
    results: Path,
    keys: Collection[str],
    list_pairs: Callable[[Collection[str]], list[tuple[str, str]]],
    metric: LookMetric | None = None,
) -> LookTable:
    """Read the main metric of the jobs of a look."""
    metric = metric or LookMetric()
    conditions = load_conditions(study, results, keys=keys)
    table = pd.concat(
        [
            to_long_rows(condition, job, job.load(), metric.start_s, {})
            for condition in conditions
            for job in condition.jobs
        ],
        ignore_index=True,
    )
    mains = list_main_groups(conditions)
    independent = select_independent_runs(table, mains)
    rows = select_main_metrics(independent.rows, mains, _MAIN)
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
    runs = tidy_main(rows, metric.name, _MAIN)
    return LookTable(runs, pairs, parts, float(seconds), independent.sentence)
