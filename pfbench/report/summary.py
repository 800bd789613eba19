"""Summary of a study: the main group of each condition, and the status of the runs.

The main group of a condition is the position or, without a position, the first group of the state.
If scenarios differ in it, the main groups are compared under one name. Their ratios need no unit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import pandas as pd

from pfbench.results import store
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.conditions import natural_sort_key
from pfbench.results.status import StatusCounts, count_statuses
from pfbench.results.study_decisions.main_metrics import select_main_metrics

MAIN = "main group"
CellName = tuple[str, str, str]


@dataclass(frozen=True)
class StudySummary:
    """Summary of a study.

    Attributes:
        filters: Number of filters.
        cells: Number of conditions.
        worlds: Number of worlds: families of scenarios.
        regimes: Number of noise regimes.
        runs: Number of runs of all filters.
        incomplete: Conditions with missing filters, and the number of these filters.
        group: Compared group, with the groups by scenario if they differ.
        often: Filters and the number of conditions in which they are in the top group, most first.
        compared: Number of conditions with comparisons.
        lost: Filters, lost runs and all runs, most lost first, without filters that lost no run.
        diverged: Filters, diverged runs and all runs.
        overconfident: Filters, severely overconfident runs and all runs.
        collapsed: Filters, collapsed runs and all runs.
        undefined: Number of jobs whose scenario defines no divergence.
    """

    filters: int
    cells: int
    worlds: int
    regimes: int
    runs: int
    incomplete: tuple[tuple[str, int], ...]
    group: str
    often: tuple[tuple[str, int], ...]
    compared: int
    lost: tuple[tuple[str, int, int], ...]
    diverged: tuple[tuple[str, int, int], ...]
    overconfident: tuple[tuple[str, int, int], ...]
    collapsed: tuple[tuple[str, int, int], ...]
    undefined: int

    @property
    def foremost(self) -> tuple[tuple[str, int], ...]:
        """The first six of `often`, and all that tie with the sixth."""
        least = self.often[:6][-1][1] if self.often else 0
        return tuple(item for item in self.often if item[1] >= least)


def select_main_rows(
    table: pd.DataFrame, tests: Sequence[PairwiseTest], mains: Mapping[CellName, str]
) -> tuple[pd.DataFrame, list[PairwiseTest], str]:
    """Select the rows and pairwise tests of the main groups, under a common name.

    Args:
        table: Rows of `load_frame`.
        tests: All pairwise tests.
        mains: Main group by condition.
    """
    names = {group for group in mains.values() if group}
    name = names.pop() if len(names) == 1 else MAIN
    rows = select_main_metrics(table, mains, name)
    main_tests = [
        replace(v, group=name)
        for v in tests
        if v.group == mains.get((v.scenario, v.noise, v.model))
    ]
    return rows, main_tests, name


def summarise_study(
    tests: Sequence[PairwiseTest],
    table: pd.DataFrame,
    mains: Mapping[CellName, str],
    status_counts: Sequence[tuple[str, StatusCounts]],
) -> StudySummary:
    """Build the summary of a study.

    Args:
        tests: Pairwise tests of the main groups.
        table: Rows of the main groups.
        mains: Main group by condition.
        status_counts: Filter and number of runs by status of each job.
    """
    labels = {
        " / ".join(map(str, cell)): set(rows.label)
        for cell, rows in table.groupby(["scenario", "noise", "model"])
    }
    everyone = set().union(*labels.values()) if labels else set()
    by_name = sorted(labels.items(), key=lambda item: natural_sort_key(item[0]))
    lacking = [(cell, len(everyone - filters)) for cell, filters in by_name]
    often, compared = _count_top_groups(tests)
    runs: Counter[str] = Counter()
    lost: Counter[str] = Counter()
    diverged: Counter[str] = Counter()
    severe: Counter[str] = Counter()
    collapsed: Counter[str] = Counter()
    for label, n in status_counts:
        runs[label] += n.runs
        lost[label] += n.lost
        diverged[label] += n.diverged or 0
        severe[label] += n.severely_overconfident
        collapsed[label] += n.collapsed
    return StudySummary(
        filters=len(everyone),
        cells=len(labels),
        worlds=table["family"].nunique(),
        regimes=len({noise for _, noise, _ in mains}),
        runs=runs.total(),
        incomplete=tuple(item for item in lacking if item[1]),
        group=_format_group(str(table["group"].iloc[0]) if len(table) else "", mains),
        often=often,
        compared=compared,
        lost=_order_by_share(lost, runs),
        diverged=_order_by_share(diverged, runs),
        overconfident=_order_by_share(severe, runs),
        collapsed=_order_by_share(collapsed, runs),
        undefined=sum(n.diverged is None for _, n in status_counts),
    )


def list_top_group(tests: Sequence[PairwiseTest]) -> list[str]:
    """List the filters that no other filter is better than, in the order of the comparisons."""
    labels = dict.fromkeys(label for v in tests for label in (v.a, v.b))
    worse = {v.b if v.winner == v.a else v.a for v in tests if v.winner != INCONCLUSIVE}
    return [label for label in labels if label not in worse]


def _count_top_groups(tests: Sequence[PairwiseTest]) -> tuple[tuple[tuple[str, int], ...], int]:
    """Count the conditions in which each filter is in the top group, and all conditions."""
    cells: dict[CellName, list[PairwiseTest]] = {}
    for v in tests:
        cells.setdefault((v.scenario, v.noise, v.model), []).append(v)
    count: Counter[str] = Counter()
    for condition_tests in cells.values():
        count.update(list_top_group(condition_tests))
    return tuple(
        sorted(count.items(), key=lambda item: (-item[1], natural_sort_key(item[0])))
    ), len(cells)


def _order_by_share(
    count: Mapping[str, int], runs: Mapping[str, int]
) -> tuple[tuple[str, int, int], ...]:
    rows = [(label, n, runs[label]) for label, n in count.items() if n]
    return tuple(sorted(rows, key=lambda row: (-row[1] / row[2], natural_sort_key(row[0]))))


def _format_group(group: str, mains: Mapping[CellName, str]) -> str:
    """Format the main group, or the main groups by scenario, the most frequent first."""
    if group != MAIN:
        return group
    count = Counter(mains.values())
    (most, _), *others = count.most_common()
    texts = []
    for name, _ in others:
        worlds = sorted(
            {cell[0] for cell, group in mains.items() if group == name}, key=natural_sort_key
        )
        texts += [f"{name} in {', '.join(worlds)}"] if name else []
    return f"{most}, and {', '.join(texts)}"


def status_lists(results: Mapping[str, store.JobResult]) -> dict[str, Any]:
    """Count the runs of each filter by status.

    Args:
        results: Results of a condition by label.

    Returns:
        Template variables: all counts, and for each kind the filters with such runs.
    """
    counts = [
        (label, count_statuses(result.data, result.meta)) for label, result in results.items()
    ]

    def of_kind(kind: str) -> list[tuple[str, int, int]]:
        return [(label, getattr(n, kind), n.runs) for label, n in counts if getattr(n, kind)]

    kinds = {name: of_kind(name) for name in ("lost", "diverged", "collapsed")}
    return {
        "status_counts": counts,
        "undefined": all(n.diverged is None for _, n in counts),
        "overconfident": of_kind("severely_overconfident"),
        **kinds,
    }
