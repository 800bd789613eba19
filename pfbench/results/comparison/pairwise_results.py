"""Result of the comparison of two filters within a condition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INCONCLUSIVE = "inconclusive"


@dataclass(frozen=True)
class PairwiseTest:
    """Comparison of filter a with filter b on one group of one condition.

    Attributes:
        scenario: Scenario of the condition.
        noise: Noise regime of the condition.
        model: Model of the condition.
        group: Group of the state.
        metric: Metric compared; rmse is the RMSE of the norm of the group, per run.
        a: Label of the first filter.
        b: Label of the second filter.
        pairs: Runs that both filters have.
        lost_a: Lost runs of a among them.
        lost_b: Lost runs of b among them.
        statistic: Wilcoxon's T, the smaller of the two rank sums.
        p: Two-sided p-value of this pair alone.
        p_holm: p-value corrected over `family` pairs.
        family: Pairs in Holm's correction.
        effect: Rank-biserial correlation, -1 to 1; positive if a has the smaller error.
        ratio: Median over runs of RMSE(a) / RMSE(b); 0 or infinite if lost runs decide it.
        low: Lower end of the bootstrap interval of the ratio.
        high: Upper end of that interval.
        level: Coverage of that interval.
        interval: Method of that interval: "BCa", "percentile" or "none".
        winner: Better filter, or "inconclusive".
        effect_low: Lower end of the interval of the effect.
        effect_high: Upper end of that interval.
        better: Probability that a run of a has a smaller error than a run of b; ties count half.
        better_low: Lower end of the interval of that probability.
        better_high: Upper end of that interval.
        margin: Relative difference of RMSE within which filters are equivalent.
        p_equivalent: p-value of equivalence within the margin, Holm over `family`.
        equivalent: Whether equivalence is shown.
        target_effect: Relative difference of RMSE for which `needed` is computed.
        scatter: SD over runs of the log ratio, over runs that neither filter lost.
        needed: Runs required to show the difference `target_effect` with power 0.8.
        detectable: Smallest relative difference that the available pairs show with power 0.8.
        p_page: p-value corrected over all `page` comparisons of a report; NaN without one.
        page: Comparisons of the report.
    """

    scenario: str
    noise: str
    model: str
    group: str
    metric: str
    a: str
    b: str
    pairs: int
    lost_a: int
    lost_b: int
    statistic: float
    p: float
    p_holm: float
    family: int
    effect: float
    ratio: float
    low: float
    high: float
    level: float
    interval: str
    winner: str
    effect_low: float = np.nan
    effect_high: float = np.nan
    better: float = np.nan
    better_low: float = np.nan
    better_high: float = np.nan
    margin: float = np.nan
    p_equivalent: float = np.nan
    equivalent: bool = False
    target_effect: float = np.nan
    scatter: float = np.nan
    needed: float = np.nan
    detectable: float = np.nan
    p_page: float = np.nan
    page: int = 0


def decide_winner(a: str, b: str, effect: float, p: float, alpha: float) -> str:
    """Return the better filter, or "inconclusive".

    Args:
        a: Label of the first filter.
        b: Label of the second filter.
        effect: Effect size, positive if a is better.
        p: Corrected p-value.
        alpha: Level.
    """
    if not p <= alpha or effect == 0:
        return INCONCLUSIVE
    return a if effect > 0 else b
