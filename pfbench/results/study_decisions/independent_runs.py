"""Rows of the independent runs of a study: copies of runs are left out of a table of all metrics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import pandas as pd

from pfbench.results.statistics.run_dependence import assess_runs, drop_runs
from pfbench.results.study_decisions.main_metrics import ConditionName, select_main_metrics

RUN = ["seed", "run"]  # columns that name a run


class IndependentRows(NamedTuple):
    """Rows of all metrics without copies of runs.

    Attributes:
        rows: Rows of the runs that are not copies.
        sentence: What is left out, and whether neighbouring runs are alike; empty for independent runs.
    """

    rows: pd.DataFrame
    sentence: str


def select_independent_runs(
    rows: pd.DataFrame, mains: Mapping[ConditionName, str]
) -> IndependentRows:
    """Leave out copies of runs, as a report does.

    Args:
        rows: Rows of `to_long_rows`, of all conditions.
        mains: Main group by scenario, noise and model. Its error shows the copies.

    Returns:
        The rows of the other runs, with a sentence on what is left out.
    """
    main = select_main_metrics(rows, mains, "main")
    errors = main[main["metric"] == "rmse"]
    regime = errors["noise"].astype(str) + " / " + errors["model"].astype(str)
    table = errors.assign(filter=errors["label"], regime=regime)
    copies, sentence = assess_runs(table, "value", RUN)
    return IndependentRows(drop_runs(rows, copies, RUN).reset_index(drop=True), sentence)
