"""Metrics that decide on a pair: the main error of a study, and the second family.

References:
    T. Gneiting and A. E. Raftery (2007), Strictly proper scoring rules, prediction, and estimation.
    F. X. Diebold and R. S. Mariano (1995), Comparing predictive accuracy.
    P. Royston and M. K. B. Parmar (2013), Restricted mean survival time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.stats.decision import MetricRule
from pfbench.stats.error_measures import Flags
from pfbench.stats.study_runs import tidy_rows

MAIN_COMPONENT = "norm"  # of all rows of `select_main_metrics`
_COMPONENTS = {"crps": "mean", "log_score": ""}  # component of a metric, if it is not the norm
_OF_JOB = ("log_score",)  # metrics without a group
ConditionName = tuple[str, str, str]

# name in the table of runs: rule, whose name is that in sentences
RULES: Mapping[str, MetricRule] = {
    "rmse": MetricRule("error"),
    "crps": MetricRule("CRPS"),
    "energy": MetricRule("energy score"),
    "log_score": MetricRule("log score per step", "difference", higher_is_better=True),
    "max_error": MetricRule("largest error"),
    "time_to_converge": MetricRule(
        "time to converge", "mean difference", margin=0.05, unit="of the record"
    ),
    "overconfident": MetricRule("overconfident runs", "share", margin=0.05),
}
MAIN_METRICS = ("rmse", "crps", "energy", "log_score", "max_error")


def select_main_metrics(
    table: pd.DataFrame, mains: Mapping[ConditionName, str], name: str
) -> pd.DataFrame:
    """Select the rows of the main group of each condition, under one name and component.

    Returns rows of the norm, of the mean CRPS, and of the log score.
    """
    keys = zip(table["scenario"], table["noise"], table["model"], strict=True)
    main = pd.Series(list(keys), index=table.index).map(mains).fillna("")
    # metrics of the whole state group: "state" of the main group "state [m]"
    state = main.str.partition(" [")[0]
    is_main = (table["group"] == main) | (
        (table["group"] == state) & table["metric"].isin(("nees", "nees_ratio", "overconfident"))
    )
    is_main |= table["metric"].isin(_OF_JOB)
    component = table["metric"].map(_COMPONENTS).fillna(MAIN_COMPONENT)
    rows = table[is_main & (table["component"] == component)]
    return rows.assign(group=name, component=MAIN_COMPONENT)


def tidy_other_groups(
    table: pd.DataFrame, mains: Mapping[ConditionName, str]
) -> dict[str, pd.DataFrame]:
    """Arrange the root mean square errors of all groups but the main one for decisions.

    Returns table by name of the group, of the conditions in which it is not the main group.
    """
    keys = zip(table["scenario"], table["noise"], table["model"], strict=True)
    main = pd.Series(list(keys), index=table.index).map(mains)
    is_other = (table["metric"] == "rmse") & (table["component"] == MAIN_COMPONENT)
    rows = table[is_other & (table["group"] != main)]
    return {
        str(group): tidy_rows(of_group) for group, of_group in rows.groupby("group", sort=False)
    }


def main_rule(metric: str, group: str) -> MetricRule:
    """Return the rule of the main metric of a study."""
    check_main_metric(metric)
    rule = RULES[metric]
    return replace(rule, name=f"{group} {rule.name}", group=group)


def check_main_metric(metric: str) -> None:
    """Check the name of the main metric."""
    if metric not in MAIN_METRICS:
        raise ValueError(
            f"report.metric must be one of {', '.join(MAIN_METRICS)}, got {metric}. "
            "Choose rmse for estimates, or crps for posterior distributions."
        )


def tidy_main(rows: pd.DataFrame, metric: str, group: str) -> pd.DataFrame:
    """Arrange the main metric for decisions.

    Returns table with the columns of `study_runs.to_study_runs`.
    """
    check_main_metric(metric)
    conditions = ["scenario", "noise", "model", "label"]
    available = rows[rows["metric"] == metric]
    missing = set(map(tuple, rows[conditions].drop_duplicates().to_numpy())) - set(
        map(tuple, available[conditions].drop_duplicates().to_numpy())
    )
    if missing:
        raise ValueError(
            f"report.metric must be a metric of all results, got {metric} without values of "
            f"{' / '.join(min(missing))}. Choose report.metric=rmse, or run with score_steps above 0."
        )
    return tidy_secondary(rows, group)[metric]


def tidy_secondary(rows: pd.DataFrame, group: str) -> dict[str, pd.DataFrame]:
    """Arrange each metric with a rule for decisions.

    Returns table by name of the metric. A run that keeps track without a value is left out. For a
    share of runs, lost runs are left out, too.
    """
    tables = {}
    for metric, rule in RULES.items():
        selected = rows[(rows["metric"] == metric) & (rows["group"] == group)]
        is_missing = selected["value"].isna() & (selected["keeps_track"] | (rule.scale == "share"))
        if len(selected[~is_missing]):
            tables[metric] = tidy_rows(selected[~is_missing])
    return tables


# --------------------------------------------------------------------------------------------------
# Conditions in which filters can be ordered if a filter lacks some of them.

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

    Shapes: present [F, C].
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

    Returns the runs of at least two filters in the same conditions; empty if there are none.
    """
    labels, filters = pd.factorize(table["filter"])
    names, conditions = pd.factorize(pd.MultiIndex.from_frame(table[_CONDITION]))
    present = np.zeros((len(filters), len(conditions)), dtype=bool)
    present[labels, names] = True
    selected = select_conditions(present)
    return table[selected.filters[labels] & selected.conditions[names]]
