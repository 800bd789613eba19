"""Which filter is better, decided once: one `Verdict` per pair, rendered by tables, figures and text.

Filters of a cell saw the same worlds, so they are compared run by run (same seed and run) on the logarithm of the ratio
of their RMSE: Wilcoxon's signed-rank test with the ranks of zero differences split evenly [Demsar 2006], Holm's
correction over all pairs shown for one group of one cell [Holm 1979], the matched-pairs rank-biserial correlation
[Kerby 2014] as the size of the effect and a BCa bootstrap interval [Efron 1987] of the median ratio.

A lost run is worse than any that was not: it takes the largest rank. Two lost runs are a tie, and so are two runs whose
RMSE agree to the precision of what is stored [ours].
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pfbench.metrics import Array

NO_DIFFERENCE = "no difference shown"
_RESAMPLES = 9999
# Errors are stored in single precision: smaller differences of a logarithm are rounding. Filters that agree to the last
# digit (EKF and UKF of a linear model) would otherwise be ranked by how they round, and be found different.
_SAME = 1e-6


@dataclass(frozen=True)
class Verdict:
    """Filter a against filter b on one group of one cell.

    Attributes:
        scenario, noise, model: the cell.
        group, metric: what was compared; rmse is that of the norm of the group, per run.
        a, b: labels.
        pairs: runs that both have.
        lost_a, lost_b: lost runs among them.
        statistic: Wilcoxon's T, the smaller of the two rank sums.
        p: two-sided, of this pair alone.
        p_holm: corrected over `family` pairs.
        family: pairs over which Holm's correction went.
        effect: rank-biserial correlation, -1 to 1; positive when a has the smaller error, 1 when it always has.
        ratio: median over runs of RMSE(a) / RMSE(b); below 1 when a has the smaller error; 0 or infinite when lost runs
            decide it.
        low, high: bootstrap interval of the ratio.
        level: its coverage.
        interval: how it was made, "BCa", or "percentile" where BCa does not exist.
        winner: a, b or "no difference shown".
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


class Interval(NamedTuple):
    """An interval of the median and the method that made it."""

    low: float
    high: float
    method: str


def verdicts(table: pd.DataFrame, alpha: float = 0.05) -> list[Verdict]:
    """All pairs of filters of each cell and group.

    Args:
        table: from `frame`; rows of metric "rmse" and component "norm" are used.
        alpha: level after Holm's correction.

    Returns:
        In the order of the table. Pairs without a common run are left out.
    """
    rows = table[(table.metric == "rmse") & (table.component == "norm")]
    found: list[Verdict] = []
    for (scenario, noise, model, group), part in rows.groupby(["scenario", "noise", "model", "group"], sort=False):
        wide = part.pivot(index=["seed", "run"], columns="label", values="value").sort_index()[part.label.unique()]
        family = list(_pairs(wide, (str(scenario), str(noise), str(model), str(group)), alpha))
        found += corrected(family, alpha)
    return found


def corrected(family: Sequence[Verdict], alpha: float) -> list[Verdict]:
    """The verdicts of one family with Holm's correction and the winner it leaves."""
    if not family:
        return []
    p_holm = multipletests([v.p for v in family], method="holm")[1]
    return [
        replace(v, p_holm=float(p), family=len(family), winner=_winner(v, float(p), alpha))
        for v, p in zip(family, p_holm, strict=True)
    ]


def log_ratio(a: Array, b: Array) -> Array:
    """log(a / b) per run, made finite: where one of the two was lost, beyond all others; where both were, 0.

    Differences below the precision of what is stored are 0 too.

    Args:
        a, b: losses [n], non-negative, infinite where lost.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a) - np.log(b)
    d = np.where((a == b) | (np.abs(d) <= _SAME), 0.0, d)
    return np.where(np.isfinite(d), d, np.sign(d) * _beyond(d))


def wilcoxon(d: Array) -> tuple[float, float]:
    """Wilcoxon's T and two-sided p of paired differences [n]; all zero gives p = 1."""
    if not d.any():
        return d.size * (d.size + 1) / 4, 1.0
    statistic, p = stats.wilcoxon(d, zero_method="zsplit")
    return float(statistic), float(p)


def rank_biserial(d: Array) -> float:
    """Share of the rank sum with d < 0 less the share with d > 0: positive when a, of d = log(a / b), is smaller."""
    rank = stats.rankdata(np.abs(d))
    return float((rank[d < 0].sum() - rank[d > 0].sum()) / rank.sum())


def median_interval(d: Array, level: float, seed: int) -> Interval:
    """Bootstrap interval of the median of d [n], BCa where it exists, else percentile."""
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # A constant sample has no BCa; the NaN it returns is caught below and the method used is named.
            warnings.simplefilter("ignore")
            found = stats.bootstrap(
                (d,),
                np.median,
                n_resamples=_RESAMPLES,
                batch=1000,
                confidence_level=level,
                method=method,
                rng=np.random.default_rng(seed),
            ).confidence_interval
        if np.isfinite([found.low, found.high]).all():
            break
    return Interval(float(found.low), float(found.high), method)


def _pairs(wide: pd.DataFrame, cell: tuple[str, str, str, str], alpha: float) -> Iterator[Verdict]:
    for a, b in combinations(map(str, wide.columns), 2):
        both = wide[[a, b]].dropna().to_numpy(dtype=np.float64)
        if len(both):
            yield _compare(cell, (a, b), both, alpha)


def _compare(cell: tuple[str, str, str, str], labels: tuple[str, str], losses: Array, alpha: float) -> Verdict:
    a, b = losses.T
    d = log_ratio(a, b)
    statistic, p = wilcoxon(d)
    seed = int(hashlib.sha256("\n".join((*cell, *labels)).encode()).hexdigest()[:16], 16)
    # An interval needs two runs; of one run the median itself is all there is.
    interval = median_interval(d, 1 - alpha, seed) if d.size > 1 else Interval(-np.inf, np.inf, "none")
    finite = np.isfinite(a) & np.isfinite(b) & (a > 0) & (b > 0)
    largest = np.abs(d[finite]).max(initial=0.0)
    middle, low, high = (_ratio(value, largest) for value in (float(np.median(d)), interval.low, interval.high))
    return Verdict(
        *cell,
        metric="rmse",
        a=labels[0],
        b=labels[1],
        pairs=len(losses),
        lost_a=int(np.isinf(a).sum()),
        lost_b=int(np.isinf(b).sum()),
        statistic=statistic,
        p=p,
        p_holm=p,
        family=1,
        effect=rank_biserial(d),
        ratio=middle,
        low=low,
        high=high,
        level=1 - alpha,
        interval=interval.method,
        winner=NO_DIFFERENCE,
    )


def _winner(v: Verdict, p: float, alpha: float) -> str:
    if not p <= alpha or v.effect == 0:
        return NO_DIFFERENCE
    return v.a if v.effect > 0 else v.b


def _beyond(d: Array) -> float:
    # More than three times the largest, so that half-way between it and any finite difference is still beyond them all.
    return 4 * float(np.abs(d[np.isfinite(d)]).max(initial=0.0)) + 1


def _ratio(log: float, largest: float) -> float:
    """Back from the logarithm; what lies beyond every finite difference stands for lost runs."""
    if abs(log) > largest * (1 + 1e-12):
        return np.inf if log > 0 else 0.0
    return float(np.exp(log))
