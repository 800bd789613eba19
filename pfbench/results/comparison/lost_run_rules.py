"""Errors of the runs of each condition, with a rule for lost runs.

By default a lost run takes the largest rank. The other rules show which decisions depend on it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results.error_measures import Array


class LostRunRule(NamedTuple):
    """Rule for lost runs in a comparison.

    Attributes:
        name: Description of the rule.
        apply: Function of the errors of one condition and group, one row per run and one column
            per filter, infinite where lost. NaN removes a run.
    """

    name: str
    apply: Callable[[pd.DataFrame], pd.DataFrame]


def _use_largest_error(wide: pd.DataFrame) -> pd.DataFrame:
    """Replace infinite errors by the largest finite one."""
    values = wide.to_numpy(dtype=np.float64)
    finite = values[np.isfinite(values)]
    return wide.replace(np.inf, finite.max()) if finite.size else wide


WORST_RANK = LostRunRule("worst rank", lambda wide: wide)
LEFT_OUT = LostRunRule("pairs with a lost run left out", lambda wide: wide.replace(np.inf, np.nan))
LARGEST_ERROR = LostRunRule("largest finite error of the condition", _use_largest_error)
LOST_RUN_RULES = (WORST_RANK, LEFT_OUT, LARGEST_ERROR)
ConditionKey = tuple[str, str, str, str]
PairErrors = tuple[tuple[str, str], Array]


def rmse_by_run(
    table: pd.DataFrame, rule: LostRunRule = WORST_RANK
) -> Iterator[tuple[ConditionKey, pd.DataFrame]]:
    """Yield the RMSE of each condition and group, one row per run and one column per filter.

    Args:
        table: Rows of `load_frame`.
        rule: Rule for lost runs; infinite errors without one.

    Yields:
        Scenario, noise, model and group, and errors indexed by seed and run.
    """
    rows = table[(table.metric == "rmse") & (table.component == "norm")]
    keys = ["scenario", "noise", "model", "group"]
    for (scenario, noise, model, group), group_rows in rows.groupby(keys, sort=False):
        wide = group_rows.pivot(index=["seed", "run"], columns="label", values="value").sort_index()
        condition = str(scenario), str(noise), str(model), str(group)
        yield condition, rule.apply(wide[group_rows.label.unique()])


def pair_errors(wide: pd.DataFrame) -> Iterator[PairErrors]:
    """Yield labels and errors [n, 2] of each pair with a common run."""
    values = wide.to_numpy(dtype=np.float64)  # slicing frames takes longer than the tests
    for (i, a), (j, b) in combinations(enumerate(map(str, wide.columns)), 2):
        errors = values[:, [i, j]]
        errors = errors[~np.isnan(errors).any(axis=1)]
        if len(errors):
            yield (a, b), errors
