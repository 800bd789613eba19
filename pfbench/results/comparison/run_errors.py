"""Errors of the runs of each condition. A lost run has an infinite error, the largest rank."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
import pandas as pd

from pfbench.results.error_measures import Array

ConditionKey = tuple[str, str, str, str]
PairErrors = tuple[tuple[str, str], Array]


def rmse_by_run(table: pd.DataFrame) -> Iterator[tuple[ConditionKey, pd.DataFrame]]:
    """Yield the RMSE of each condition and group, one row per run and one column per filter.

    Args:
        table: Rows of `load_frame`.

    Yields:
        Scenario, noise, model and group, and errors indexed by seed and run.
    """
    rows = table[(table.metric == "rmse") & (table.component == "norm")]
    keys = ["scenario", "noise", "model", "group"]
    for (scenario, noise, model, group), group_rows in rows.groupby(keys, sort=False):
        wide = group_rows.pivot(index=["seed", "run"], columns="label", values="value").sort_index()
        condition = str(scenario), str(noise), str(model), str(group)
        yield condition, wide[group_rows.label.unique()]


def pair_errors(wide: pd.DataFrame) -> Iterator[PairErrors]:
    """Yield labels and errors [n, 2] of each pair with a common run."""
    values = wide.to_numpy(dtype=np.float64)  # slicing frames takes longer than the tests
    for (i, a), (j, b) in combinations(enumerate(map(str, wide.columns)), 2):
        errors = values[:, [i, j]]
        errors = errors[~np.isnan(errors).any(axis=1)]
        if len(errors):
            yield (a, b), errors
