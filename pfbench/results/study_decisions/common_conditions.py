"""Runs from which an order of filters can be taken if a filter lacks a condition."""

from __future__ import annotations

from typing import NamedTuple

import pandas as pd

from pfbench.results.conditions import natural_sort_key

_CONDITION = ["scenario", "regime"]


class CommonRuns(NamedTuple):
    """Runs of several filters in the same conditions.

    Attributes:
        table: Table of `to_study_runs`; empty if no two filters share a condition.
        text: Sentence on what is left out; empty if nothing is.
    """

    table: pd.DataFrame
    text: str


def select_common_runs(table: pd.DataFrame) -> CommonRuns:
    """Select the runs from which an order of filters is taken.

    The order uses the conditions that all filters have, or the filters that have all conditions:
    whichever keeps more results. If both keep equally many, no filter is left out.

    Args:
        table: Table of `to_study_runs`.

    Returns:
        The runs of at least two filters in the same conditions.
    """
    results = table[["filter", *_CONDITION]].drop_duplicates()
    filters = sorted(map(str, results["filter"].unique()), key=natural_sort_key)
    per_condition = results.groupby(_CONDITION, sort=False)["filter"].size()
    per_filter = results.groupby("filter")["filter"].size()
    count = len(per_condition)
    shared = per_condition[per_condition == len(filters)].index
    complete = [name for name in filters if per_filter[name] == count]
    if len(filters) < 2 or (len(complete) < 2 and not len(shared)):
        return CommonRuns(table.iloc[:0], "")
    if len(complete) == len(filters):
        return CommonRuns(table, "")
    if len(complete) >= 2 and len(complete) * count > len(filters) * len(shared):
        missing = [name for name in filters if name not in complete]
        text = (
            f"Order of the {len(complete)} filters that have all {count} conditions. "
            f"Without {', '.join(missing)}."
        )
        return CommonRuns(table[table["filter"].astype(str).isin(complete)], text)
    keys = pd.MultiIndex.from_frame(table[_CONDITION])
    noun = "condition" if len(shared) == 1 else "conditions"
    text = (
        f"Order over {len(shared)} of {count} {noun}: those that all {len(filters)} filters have."
    )
    return CommonRuns(table[keys.isin(shared)], text)
