"""Conditions in which filters can be ordered if a filter lacks some of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results.error_measures import Flags

_CONDITION = ["scenario", "regime"]


class CommonConditions(NamedTuple):
    """Filters and conditions such that each filter has results in each condition.

    Attributes:
        filters: Selected filters, [F].
        conditions: Selected conditions, [C].
    """

    filters: Flags
    conditions: Flags


def select_conditions(present: Flags) -> CommonConditions:
    """Select the conditions that all filters have, or the filters that have all conditions.

    The selection that keeps more results wins. If both keep equally many, no filter is left out.
    If neither has two filters, nothing is selected.

    Args:
        present: Whether a filter has results in a condition, [F, C]. Filters without any result
            and conditions without any are left out.
    """
    filters, conditions = np.asarray(present.any(axis=1)), np.asarray(present.any(axis=0))
    shared = np.asarray(conditions & present[filters].all(axis=0))
    complete = np.asarray(filters & present[:, conditions].all(axis=1))
    keeps_filters = filters.sum() * shared.sum() if filters.sum() >= 2 else 0
    keeps_conditions = complete.sum() * conditions.sum() if complete.sum() >= 2 else 0
    if keeps_filters == keeps_conditions == 0:
        return CommonConditions(np.zeros_like(filters), np.zeros_like(conditions))
    if keeps_conditions > keeps_filters:
        return CommonConditions(complete, conditions)
    return CommonConditions(filters, shared)


def select_common_runs(table: pd.DataFrame) -> pd.DataFrame:
    """Select the runs of `select_conditions`, from which an order of filters is taken.

    Args:
        table: Table of `to_study_runs`.

    Returns:
        The runs of at least two filters in the same conditions; empty if there are none.
    """
    labels, filters = pd.factorize(table["filter"])
    names, conditions = pd.factorize(pd.MultiIndex.from_frame(table[_CONDITION]))
    present = np.zeros((len(filters), len(conditions)), dtype=bool)
    present[labels, names] = True
    selected = select_conditions(present)
    return table[selected.filters[labels] & selected.conditions[names]]
