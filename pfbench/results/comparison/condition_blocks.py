"""Conditions in which all filters ran, and their median errors, for figures across conditions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.results.comparison.run_errors import rmse_by_run
from pfbench.results.conditions import natural_sort_key
from pfbench.results.error_measures import Array
from pfbench.results.statistics.effect_sizes import LOG_TOLERANCE

MIN_CONDITIONS, MIN_FILTERS = 5, 3  # preferred by figures across conditions [ours]


class RankingBlocks(NamedTuple):
    """Errors of several filters in several conditions.

    Attributes:
        group: Group of the state.
        filters: Labels, [K].
        cells: Names of the conditions, [B].
        values: Median over runs of log RMSE, [B, K]; infinite if half of the runs were lost.
        runs: RMSE [n, K] of each condition, of the runs that all filters have.
        left_out: Conditions and filters left out, each with the reason.
        shared: Conditions that differ from another one in the model alone.
    """

    group: str
    filters: tuple[str, ...]
    cells: tuple[str, ...]
    values: Array
    runs: tuple[Array, ...]
    left_out: tuple[str, ...]
    shared: int


def ranking_blocks(table: pd.DataFrame, group: str) -> RankingBlocks:
    """Select the conditions in which all filters ran on the same episodes.

    If not every filter ran in every condition, filters are added by the number of their conditions.
    The selection has the most values (conditions times filters) among those with three filters and
    five conditions, if any has them [ours].

    Args:
        table: Rows of `load_frame`.
        group: Group of the state.

    Returns:
        Values and runs of the selected conditions and filters.
    """
    by_condition = sorted(
        rmse_by_run(table[table.group == group]),
        key=lambda item: [natural_sort_key(text) for text in item[0]],
    )
    errors = {" / ".join(key[:3]): wide.dropna(axis=1, how="all") for key, wide in by_condition}
    present = {name: set(map(str, wide.columns)) for name, wide in errors.items()}
    filters, complete = _select_complete(present)
    left_out = _missing_filters(present, filters)
    names, runs = [], []
    for name, wide in errors.items():
        if name not in complete:
            missing = sorted(set(filters) - present[name], key=natural_sort_key)
            left_out.append(f"{name} (without {', '.join(missing)})")
            continue
        common = wide[list(filters)].dropna().to_numpy(dtype=np.float64)
        if len(common):
            names.append(name)
            runs.append(common)
        else:
            left_out.append(f"{name} (no run in common of all filters)")
    pairs = [name.rsplit(" / ", 1)[0] for name in names]
    with np.errstate(divide="ignore"):
        medians = [np.median(np.log(common), axis=0) for common in runs]
    values = np.array(medians).reshape(len(names), len(filters))
    shared = len(pairs) - len(set(pairs))
    return RankingBlocks(group, filters, tuple(names), values, tuple(runs), tuple(left_out), shared)


def performance_profile(blocks: RankingBlocks, factors: Array) -> Array:
    """Compute the share of runs whose error is within a factor of the best [Dolan, More 2002].

    A run of a condition is one problem that all filters solve. Conditions have equal weight, and a
    lost run is never within a factor.

    Args:
        blocks: Runs of the conditions.
        factors: Factors of the smallest error of a run, [F].

    Returns:
        Shares, [K, F].
    """
    shares = []
    for errors in blocks.runs:
        best = errors.min(axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(errors == best, 1.0, errors / best)
        ratio = np.where(np.isfinite(errors), ratio, np.inf)
        limit = np.asarray(factors) * (1 + LOG_TOLERANCE)
        shares.append((ratio[:, :, None] <= limit).mean(axis=0))
    return np.mean(shares, axis=0)


def _select_complete(present: Mapping[str, set[str]]) -> tuple[tuple[str, ...], set[str]]:
    """Select filters and the conditions that have them all; see `ranking_blocks`."""
    labels = sorted(set().union(*present.values()), key=natural_sort_key) if present else []
    labels.sort(key=lambda label: -sum(label in names for names in present.values()))
    choices = []
    for k in range(1, len(labels) + 1):
        complete = {name for name, names in present.items() if names.issuperset(labels[:k])}
        is_testable = k >= MIN_FILTERS and len(complete) >= MIN_CONDITIONS
        choices.append((is_testable, k * len(complete), k, complete))
    if not choices:
        return (), set()
    _, _, k, complete = max(choices, key=lambda choice: choice[:3])
    return tuple(sorted(labels[:k], key=natural_sort_key)), complete


def _missing_filters(present: Mapping[str, set[str]], filters: Sequence[str]) -> list[str]:
    """Describe the filters that are left out."""
    excluded = sorted(set().union(*present.values()) - set(filters), key=natural_sort_key)
    count = {label: sum(label in names for names in present.values()) for label in excluded}
    return [f"{label} (ran in {n} of {len(present)} conditions)" for label, n in count.items()]
