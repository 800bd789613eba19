"""Summary of a large study: the main group of each condition, and proposed methods against baselines.

The main group of a condition is the position or, without a position, the first group of the state. If scenarios differ in it, the
main groups are ranked together, because ranks have no unit. A proposed method is compared with the baselines of its paper:
Wilcoxon's test with conditions as blocks and Holm's correction over these pairs alone. The papers define the pairs, not the
results [ours]. Conditions of a scenario share geometry and random numbers and are dependent blocks.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pfbench.results.comparison.condition_blocks import RankingBlocks, list_scenarios
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.ranking_results import RankingResult
from pfbench.results.conditions import natural_sort_key
from pfbench.results.error_measures import Array
from pfbench.results.statistics import power
from pfbench.results.statistics.effect_sizes import log_ratio, rank_biserial
from pfbench.results.statistics.signed_rank import holm, wilcoxon_signed_rank
from pfbench.results.status import StatusCounts

MAIN = "main group"
BASELINES: Mapping[str, tuple[str, ...]] = {
    "mcmc_rpf": ("sir", "rpf"),  # Yan et al. 2016
    "qmc_polymerised": ("sir", "gpf", "qmc_gpf"),  # Pu and Qin
    "fm_mssrckf": ("mssrckf",),  # COFM-AMSSRCPF 2024, as the next two
    "cofm_mssrckf": ("mssrckf", "fm_mssrckf"),
    "cofm_amssrcpf": ("cpf", "fmcpf"),
    "dmc_reconstructed": ("sir", "ukf"),  # The DMC particle filter
    "cpso_escape": ("sir", "pso_pf", "cpso_pf"),  # Tian et al.
}
CELLS = 5  # conditions of a comparison across conditions at least
CellName = tuple[str, str, str]


@dataclass(frozen=True)
class BaselineComparison:
    """Comparison of a proposed method with a baseline of its paper, across conditions.

    Attributes:
        method: Label of the method.
        baseline: Label of the baseline.
        cells: Names of the conditions that have both, `scenario / noise / model`.
        ratios: Ratio of the median errors by condition, below 1 if the method is better, 0 or infinite if lost runs decide.
        shown: Decision within each cell: the method, the baseline or "inconclusive".
        ratio: Median of the ratios.
        effect: Rank-biserial correlation over conditions, positive if the method is better.
        p: p-value of Wilcoxon's test.
        p_holm: p-value with Holm's correction.
        family: Number of pairs of the correction.
        winner: method, baseline or "inconclusive".
        least: Number of conditions that the test requires at least.
    """

    method: str
    baseline: str
    cells: tuple[str, ...]
    ratios: tuple[float, ...]
    shown: tuple[str, ...]
    ratio: float
    effect: float
    p: float
    p_holm: float
    family: int
    winner: str
    least: int = 0

    @property
    def possible(self) -> bool:
        """Whether the number of conditions suffices for a significant result."""
        return len(self.cells) >= self.least

    @property
    def decided(self) -> str:
        """The decision, or the reason why the test cannot decide."""
        return (
            self.winner
            if self.possible
            else f"inconclusive: {len(self.cells)} conditions are too few"
        )

    @property
    def worlds(self) -> int:
        """Number of scenarios of the conditions."""
        return len(list_scenarios(self.cells))

    @property
    def better(self) -> int:
        """Number of conditions in which the method is better."""
        return self.shown.count(self.method)

    @property
    def worse(self) -> int:
        """Number of conditions in which the method is worse."""
        return self.shown.count(self.baseline)


@dataclass(frozen=True)
class StudySummary:
    """Summary of a study.

    Attributes:
        filters: Number of filters.
        cells: Number of conditions.
        worlds: Number of scenarios.
        regimes: Number of noise regimes.
        runs: Number of runs of all filters.
        incomplete: Conditions with missing filters, and the number of these filters.
        group: Compared group, with the groups by scenario if they differ.
        ranked: Filters and mean ranks, best first; empty without a test across conditions.
        apart: Number of pairs with a significant difference across conditions.
        pairs: Number of pairs across conditions.
        unbeaten: Top group across conditions.
        often: Filters and the number of conditions in which they are in the top group, most first.
        compared: Number of conditions with comparisons.
        lost: Filters, lost runs and all runs, most lost first, without filters that lost no run.
        diverged: Filters, diverged runs and all runs.
        overconfident: Filters, severely overconfident runs and all runs.
        planned: Comparisons of proposed methods with baselines.
    """

    filters: int
    cells: int
    worlds: int
    regimes: int
    runs: int
    incomplete: tuple[tuple[str, int], ...]
    group: str
    ranked: tuple[tuple[str, float], ...]
    apart: int
    pairs: int
    unbeaten: tuple[str, ...]
    often: tuple[tuple[str, int], ...]
    compared: int
    lost: tuple[tuple[str, int, int], ...]
    diverged: tuple[tuple[str, int, int], ...]
    overconfident: tuple[tuple[str, int, int], ...]
    planned: tuple[BaselineComparison, ...]

    @property
    def foremost(self) -> tuple[tuple[str, int], ...]:
        """The first six of `often`, and all that tie with the sixth."""
        least = self.often[:6][-1][1] if self.often else 0
        return tuple(item for item in self.often if item[1] >= least)


def select_main_group(groups: Sequence[str]) -> str:
    """Return the position, or the first group with truth, or an empty name."""
    return "position" if "position" in groups else groups[0] if groups else ""


def merge(
    table: pd.DataFrame, decided: Sequence[PairwiseTest], mains: Mapping[CellName, str]
) -> tuple[pd.DataFrame, list[PairwiseTest], str]:
    """Select the rows and pairwise tests of the main groups, under a common name.

    Args:
        table: Rows of `frame`.
        decided: All pairwise tests.
        mains: Main group by condition.
    """
    names = {group for group in mains.values() if group}
    name = names.pop() if len(names) == 1 else MAIN
    own = pd.Series(
        list(zip(table.scenario, table.noise, table.model, strict=True)), index=table.index
    ).map(mains)
    rows = table[
        (table.group == own) & (table.metric == "rmse") & (table.component == "norm")
    ].assign(group=name)
    kept = [
        replace(v, group=name)
        for v in decided
        if v.group == mains.get((v.scenario, v.noise, v.model))
    ]
    return rows, kept, name


def compare_with_baselines(
    source: RankingBlocks, decided: Sequence[PairwiseTest], alpha: float
) -> list[BaselineComparison]:
    """Compare all pairs of `BASELINES` with results in at least five conditions.

    Args:
        source: Blocks of the main groups.
        decided: Pairwise tests of the main groups.
        alpha: Level after Holm's correction.
    """
    winners = {
        (f"{v.scenario} / {v.noise} / {v.model}", frozenset((v.a, v.b))): v.winner for v in decided
    }
    found = []
    for method, baselines in BASELINES.items():
        for baseline in baselines:
            if (
                method in source.filters
                and baseline in source.filters
                and len(source.cells) >= CELLS
            ):
                a, b = (
                    np.exp(source.values[:, source.filters.index(label)])
                    for label in (method, baseline)
                )
                shown = tuple(
                    winners.get((cell, frozenset((method, baseline))), INCONCLUSIVE)
                    for cell in source.cells
                )
                found.append(_compared(method, baseline, source.cells, a, b, shown))
    corrected = holm([one.p for one in found])
    return [
        _decided(one, float(p), len(found), alpha) for one, p in zip(found, corrected, strict=True)
    ]


def summarise_study(
    ranking: RankingResult,
    decided: Sequence[PairwiseTest],
    pairs: Sequence[BaselineComparison],
    table: pd.DataFrame,
    mains: Mapping[CellName, str],
    status_counts: Sequence[tuple[str, StatusCounts]],
) -> StudySummary:
    """Build the summary of a study.

    Args:
        one: Ranking of the main groups.
        decided: Pairwise tests of the main groups.
        pairs: Result of `planned`.
        table: Rows of the main groups.
        mains: Main group by condition.
        fates: Filter and number of runs by status of each job.
    """
    labels = {
        " / ".join(map(str, cell)): set(own.label)
        for cell, own in table.groupby(["scenario", "noise", "model"])
    }
    everyone = set().union(*labels.values()) if labels else set()
    by_name = sorted(labels.items(), key=lambda item: natural_sort_key(item[0]))
    lacking = [(cell, len(everyone - own)) for cell, own in by_name]
    often, compared = _unbeaten(decided)
    made: Counter[str] = Counter()
    gone: Counter[str] = Counter()
    off: Counter[str] = Counter()
    severe: Counter[str] = Counter()
    for label, n in status_counts:
        made[label] += n.runs
        gone[label] += n.lost
        off[label] += n.diverged or 0
        severe[label] += n.severely_overconfident
    return StudySummary(
        filters=len(everyone), cells=len(labels), worlds=len({name for name, _, _ in mains}),
        regimes=len({noise for _, noise, _ in mains}), runs=made.total(),
        incomplete=tuple(item for item in lacking if item[1]), group=_named(ranking.group, mains),
        ranked=tuple(sorted(zip(ranking.filters, ranking.ranks, strict=False), key=lambda item: (item[1], natural_sort_key(item[0])))),
        apart=ranking.shown, pairs=len(ranking.pairs), unbeaten=tuple(ranking.unbeaten) if ranking.pairs else (), often=often,
        compared=compared, lost=_most(gone, made), diverged=_most(off, made), overconfident=_most(severe, made),
        planned=tuple(pairs),
    )  # fmt: skip


def list_top_group(decided: Sequence[PairwiseTest]) -> list[str]:
    """List the filters that no other filter is better than, in the order of the comparisons."""
    labels = dict.fromkeys(label for v in decided for label in (v.a, v.b))
    worse = {v.b if v.winner == v.a else v.a for v in decided if v.winner != INCONCLUSIVE}
    return [label for label in labels if label not in worse]


def _compared(
    method: str, baseline: str, cells: tuple[str, ...], a: Array, b: Array, shown: tuple[str, ...]
) -> BaselineComparison:
    d = log_ratio(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(np.isinf(a) & np.isinf(b), 1.0, a / b)
    return BaselineComparison(
        method, baseline, cells, tuple(map(float, ratios)), shown, float(np.median(ratios)), rank_biserial(d),
        wilcoxon_signed_rank(d).p, math.nan, 0, INCONCLUSIVE,
    )  # fmt: skip


def _decided(one: BaselineComparison, p: float, family: int, alpha: float) -> BaselineComparison:
    better = one.method if one.effect > 0 else one.baseline
    winner = better if p <= alpha and one.effect else INCONCLUSIVE
    return replace(
        one, p_holm=p, family=family, winner=winner, least=power.min_pairs(alpha / family)
    )


def _unbeaten(decided: Sequence[PairwiseTest]) -> tuple[tuple[tuple[str, int], ...], int]:
    """Count the conditions in which each filter is in the top group, and all conditions."""
    cells: dict[CellName, list[PairwiseTest]] = {}
    for v in decided:
        cells.setdefault((v.scenario, v.noise, v.model), []).append(v)
    count: Counter[str] = Counter()
    for own in cells.values():
        count.update(list_top_group(own))
    return tuple(
        sorted(count.items(), key=lambda item: (-item[1], natural_sort_key(item[0])))
    ), len(cells)


def _most(count: Mapping[str, int], made: Mapping[str, int]) -> tuple[tuple[str, int, int], ...]:
    rows = [(label, n, made[label]) for label, n in count.items() if n]
    return tuple(sorted(rows, key=lambda row: (-row[1] / row[2], natural_sort_key(row[0]))))


def _named(group: str, mains: Mapping[CellName, str]) -> str:
    """Format the main group, or the main groups by scenario, the most frequent first."""
    if group != MAIN:
        return group
    count = Counter(mains.values())
    (most, _), *others = count.most_common()
    texts = []
    for name, _ in others:
        worlds = sorted(
            {cell[0] for cell, own in mains.items() if own == name}, key=natural_sort_key
        )
        texts += [f"{name} in {', '.join(worlds)}"] if name else []
    return f"{most}, and {', '.join(texts)}"
