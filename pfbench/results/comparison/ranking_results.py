"""Results of a ranking of filters across the conditions of a study."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pfbench.results.comparison.condition_blocks import list_scenarios
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE
from pfbench.results.error_measures import Array
from pfbench.results.statistics import power
from pfbench.results.statistics.effect_sizes import LOG_TOLERANCE


@dataclass(frozen=True)
class RankingPair:
    """Comparison of filter a with filter b across conditions.

    Attributes:
        a: Label of the first filter.
        b: Label of the second filter.
        wins: Conditions in which the median error of a is smaller.
        losses: Conditions in which it is larger.
        rank_a: Mean rank of a.
        rank_b: Mean rank of b.
        p_nemenyi: Nemenyi's p-value, corrected over all pairs.
        p_conover: Conover's p-value, Holm over all pairs.
        p_wilcoxon: Wilcoxon's p-value, Holm over all pairs.
        family: Number of pairs.
        effect: Rank-biserial correlation over conditions, positive if a is better.
        ratio: Median ratio of median errors a / b; 0 or infinite if lost runs decide it.
        bayes_a: Posterior probability that a is better.
        bayes_equal: Posterior probability that both are within the margin.
        bayes_b: Posterior probability that b is better.
        better: Probability that a run of a has the smaller error, mean over conditions.
        better_low: Lower end of its interval over runs, of coverage 1 - alpha.
        better_high: Upper end of that interval.
        winner: Better filter, or "inconclusive".
    """

    a: str
    b: str
    wins: int
    losses: int
    rank_a: float
    rank_b: float
    p_nemenyi: float
    p_conover: float
    p_wilcoxon: float
    family: int
    effect: float
    ratio: float
    bayes_a: float
    bayes_equal: float
    bayes_b: float
    better: float
    better_low: float
    better_high: float
    winner: str


@dataclass(frozen=True)
class ScenarioRanking:
    """Omnibus test with scenarios as blocks, on the median rank over conditions of a scenario.

    Attributes:
        worlds: Number of scenarios.
        p: Friedman's p-value.
        p_f: p-value in the form of Iman and Davenport.
        best: Filters of the smallest mean rank; several if they tie.
    """

    worlds: int
    p: float
    p_f: float
    best: tuple[str, ...]


@dataclass(frozen=True)
class RankingResult:
    """Ranking of filters across the conditions of a study, for one group of the state.

    Attributes:
        group: Group of the state.
        metric: Metric compared.
        value: Value of a block.
        rule: Rule for lost runs.
        alpha: Level.
        margin: Relative difference of RMSE within which filters are equal.
        filters: Labels, [K].
        cells: Names of the conditions, [B].
        left_out: Conditions and filters left out, each with the reason.
        shared: Conditions that differ from another one in the model alone.
        refused: Reason if the test was not run, else empty.
        ranks: Mean rank of each filter, [K].
        chi2: Friedman's chi-square.
        p: p-value of chi2.
        f: F statistic of Iman and Davenport.
        p_f: p-value of f.
        critical: Nemenyi's critical difference.
        pairs: Comparisons of all pairs.
        by_world: Test with scenarios as blocks. None if each condition has its own scenario, or if
            scenarios are too few.
    """

    group: str
    metric: str
    value: str
    rule: str
    alpha: float
    margin: float
    filters: tuple[str, ...]
    cells: tuple[str, ...]
    left_out: tuple[str, ...]
    shared: int
    refused: str
    ranks: tuple[float, ...] = ()
    chi2: float = math.nan
    p: float = math.nan
    f: float = math.nan
    p_f: float = math.nan
    critical: float = math.nan
    pairs: tuple[RankingPair, ...] = ()
    by_world: ScenarioRanking | None = None

    @property
    def worlds(self) -> int:
        """Number of distinct scenarios."""
        return len(list_scenarios(self.cells))

    @property
    def best(self) -> tuple[str, ...]:
        """Filters of the smallest mean rank; several if they tie."""
        return best_ranked(self.filters, self.ranks)

    @property
    def least(self) -> int:
        """Conditions below which Wilcoxon's test with Holm's correction cannot reach alpha."""
        return power.min_pairs(self.alpha / max(1, len(self.pairs)))

    @property
    def unbeaten(self) -> list[str]:
        """Top group: filters that no other filter is shown to be better than."""
        decided = [p for p in self.pairs if p.winner != INCONCLUSIVE]
        worse = {p.b if p.winner == p.a else p.a for p in decided}
        return [label for label in self.filters if label not in worse]

    @property
    def shown(self) -> int:
        """Number of pairs with a decision."""
        return sum(p.winner != INCONCLUSIVE for p in self.pairs)


def best_ranked(filters: Sequence[str], rank: Sequence[float] | Array) -> tuple[str, ...]:
    """List the filters of the smallest mean rank, up to rounding.

    Args:
        filters: Labels, [K].
        rank: Mean ranks, [K].
    """
    pairs = zip(filters, rank, strict=False)
    return tuple(label for label, value in pairs if value <= min(rank) + LOG_TOLERANCE)
