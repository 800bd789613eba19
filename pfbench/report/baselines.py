"""Proposed methods against the baselines of their papers, across conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pfbench.results.comparison.condition_blocks import RankingBlocks, list_scenarios
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.error_measures import Array
from pfbench.results.statistics import power
from pfbench.results.statistics.effect_sizes import log_ratio, rank_biserial
from pfbench.results.statistics.signed_rank import holm, wilcoxon_signed_rank

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


@dataclass(frozen=True)
class BaselineComparison:
    """Comparison of a proposed method with a baseline of its paper, across conditions.

    Attributes:
        method: Label of the method.
        baseline: Label of the baseline.
        cells: Names of the conditions that have both, `scenario / noise / model`.
        ratios: Ratio of the median errors by condition, below 1 if the method is better, 0 or infinite if lost runs decide.
        decisions: Decision within each cell: the method, the baseline or "inconclusive".
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
    decisions: tuple[str, ...]
    ratio: float
    effect: float
    p: float
    p_holm: float
    family: int
    winner: str
    least: int = 0

    @property
    def possible(self) -> bool:
        """Possibility of a significant result with this number of conditions."""
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
        return self.decisions.count(self.method)

    @property
    def worse(self) -> int:
        """Number of conditions in which the method is worse."""
        return self.decisions.count(self.baseline)


def compare_with_baselines(
    source: RankingBlocks, tests: Sequence[PairwiseTest], alpha: float
) -> list[BaselineComparison]:
    """Compare all pairs of `BASELINES` with results in at least five conditions.

    Args:
        source: Blocks of the main groups.
        tests: Pairwise tests of the main groups.
        alpha: Level after Holm's correction.
    """
    winners = {
        (f"{v.scenario} / {v.noise} / {v.model}", frozenset((v.a, v.b))): v.winner for v in tests
    }
    comparisons = []
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
                winners_by_condition = tuple(
                    winners.get((cell, frozenset((method, baseline))), INCONCLUSIVE)
                    for cell in source.cells
                )
                comparisons.append(
                    _compare_pair(method, baseline, source.cells, a, b, winners_by_condition)
                )
    corrected = holm([pair.p for pair in comparisons])
    return [
        _decide_pair(pair, float(p), len(comparisons), alpha)
        for pair, p in zip(comparisons, corrected, strict=True)
    ]


def _compare_pair(
    method: str, baseline: str, cells: tuple[str, ...], a: Array, b: Array, winners: tuple[str, ...]
) -> BaselineComparison:
    d = log_ratio(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(np.isinf(a) & np.isinf(b), 1.0, a / b)
    return BaselineComparison(
        method, baseline, cells, tuple(map(float, ratios)), winners, float(np.median(ratios)), rank_biserial(d),
        wilcoxon_signed_rank(d).p, math.nan, 0, INCONCLUSIVE,
    )  # fmt: skip


def _decide_pair(
    pair: BaselineComparison, p: float, family: int, alpha: float
) -> BaselineComparison:
    better = pair.method if pair.effect > 0 else pair.baseline
    winner = better if p <= alpha and pair.effect else INCONCLUSIVE
    return replace(
        pair, p_holm=p, family=family, winner=winner, least=power.min_pairs(alpha / family)
    )
