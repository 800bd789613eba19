"""Which filter is better, decided once: one `Verdict` per pair, rendered by tables, figures and text.

Filters of a cell saw the same worlds, so they are compared run by run (same seed and run) on the logarithm of the ratio
of their RMSE: Wilcoxon's signed-rank test with the ranks of zero differences split evenly [Demsar 2006], Holm's
correction over all pairs shown for one group of one cell [Holm 1979], the matched-pairs rank-biserial correlation
[Kerby 2014] and the probability of improvement [Vargha, Delaney 2000] as sizes of the effect, a BCa bootstrap interval
[Efron 1987] of the median ratio, and two one-sided tests of equivalence (`power.equivalence`).

A lost run is worse than any that was not: it takes the largest rank. Two lost runs are a tie, and so are two runs whose
RMSE agree to the precision of what is stored [ours]. `sensitivity` decides anew by other rules for lost runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import ndtr, ndtri, stdtrit

from pfbench.metrics import Array
from pfbench.report import power

NO_DIFFERENCE = "no difference shown"
_RESAMPLES = 9999
# Errors are stored in single precision: smaller differences of a logarithm are rounding. Filters that agree to the last
# digit (EKF and UKF of a linear model) would otherwise be ranked by how they round, and be found different.
SAME = 1e-6


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
        effect_low, effect_high: interval of the effect, of coverage `level`.
        better: probability of improvement, that a run of a has a smaller error than a run of b, ties counted half.
        better_low, better_high: its interval, of coverage `level`.
        margin: share by which RMSE may differ between filters that count as equivalent, 0.05 is five per cent.
        p_equivalent: of the claim that the median ratio is within 1 / (1 + margin) to 1 + margin, Holm over `family`.
        equivalent: is it shown?
        wanted: share by which RMSE differs in the effect that `needed` is about.
        scatter: standard deviation over runs of the logarithm of the ratio, of runs that neither filter lost.
        needed: runs to find the wanted effect with power 0.8 at the level of the first step of Holm's correction.
        detectable: the smallest share by which RMSE differs that the pairs at hand find so.
        p_page: corrected over all `page` comparisons of a report; NaN and 0 where there is none.
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
    wanted: float = np.nan
    scatter: float = np.nan
    needed: float = np.nan
    detectable: float = np.nan
    p_page: float = np.nan
    page: int = 0


class Interval(NamedTuple):
    """An interval of the median and the method that made it."""

    low: float
    high: float
    method: str


class Share(NamedTuple):
    """A probability estimated from n runs.

    Attributes:
        value: 0 to 1.
        parts: what each run says of it [n], so that its mean is the value and its variance over n that of the value.
    """

    value: float
    parts: Array


class LostRule(NamedTuple):
    """What stands for a lost run.

    Attributes:
        name: in words.
        apply: from errors of one cell and group, one row per run, one column per filter, infinite where lost; NaN leaves out.
    """

    name: str
    apply: Callable[[pd.DataFrame], pd.DataFrame]


@dataclass(frozen=True)
class Sensitivity:
    """A decision that hangs on the rule for lost runs.

    Attributes:
        cell, group, a, b: the comparison.
        winners: by each of `LOST_RULES`.
    """

    cell: str
    group: str
    a: str
    b: str
    winners: tuple[str, ...]


def _largest(wide: pd.DataFrame) -> pd.DataFrame:
    values = wide.to_numpy(dtype=np.float64)
    finite = values[np.isfinite(values)]
    return wide.replace(np.inf, finite.max()) if finite.size else wide


WORST = LostRule("worst rank", lambda wide: wide)
LEFT_OUT = LostRule("pairs with a lost run left out", lambda wide: wide.replace(np.inf, np.nan))
LARGEST = LostRule("largest finite error of the cell", _largest)
LOST_RULES = (WORST, LEFT_OUT, LARGEST)
CellKey = tuple[str, str, str, str]


def verdicts(
    table: pd.DataFrame, alpha: float = 0.05, margin: float = 0.05, wanted: float = 0.1
) -> list[Verdict]:
    """All pairs of filters of each cell and group.

    Args:
        table: from `frame`; rows of metric "rmse" and component "norm" are used, in any order.
        alpha: level after Holm's correction.
        margin: see `Verdict`.
        wanted: see `Verdict`.

    Returns:
        In the order of the table, or of cells and labels where its rows are mixed. Pairs without a common run are left out.
    """
    found: list[Verdict] = []
    for cell, wide in losses(table):
        family = [_compare(cell, pair, both, alpha, margin, wanted) for pair, both in _pairs(wide)]
        found += corrected(family, alpha)
    return found


def losses(table: pd.DataFrame, rule: LostRule = WORST) -> Iterator[tuple[CellKey, pd.DataFrame]]:
    """RMSE of each cell and group: one row per run (seed and number), one column per filter; infinite where lost."""
    rows = table[(table.metric == "rmse") & (table.component == "norm")]
    for (scenario, noise, model, group), part in rows.groupby(["scenario", "noise", "model", "group"], sort=False):
        wide = part.pivot(index=["seed", "run"], columns="label", values="value").sort_index()[part.label.unique()]
        yield (str(scenario), str(noise), str(model), str(group)), rule.apply(wide)


def corrected(family: Sequence[Verdict], alpha: float) -> list[Verdict]:
    """The verdicts of one family with Holm's correction, the winner it leaves, and the equivalence it leaves."""
    if not family:
        return []
    p_holm, p_same = holm([v.p for v in family]), [v.p_equivalent for v in family]
    # What was not tested for equivalence has no p, and none has where one has not: a family is tested as a whole.
    equal = holm(p_same) if np.isfinite(p_same).all() else np.full(len(family), np.nan)
    runs = [_power(v, alpha / len(family)) for v in family]
    return [
        replace(
            v, p_holm=float(p), family=len(family), winner=_winner(v, float(p), alpha),
            p_equivalent=float(same), equivalent=bool(same <= alpha), needed=n, detectable=share,
        )
        for v, p, same, (n, share) in zip(family, p_holm, equal, runs, strict=True)
    ]  # fmt: skip


def over_page(decided: Sequence[Verdict]) -> list[Verdict]:
    """The same verdicts with Holm's correction over all of them in `p_page`; winners stay those of their own families."""
    if not decided:
        return []
    return [replace(v, p_page=float(p), page=len(decided)) for v, p in zip(decided, holm([v.p for v in decided]), strict=True)]


def sensitivity(table: pd.DataFrame, alpha: float = 0.05) -> list[Sensitivity]:
    """The comparisons whose winner another rule for lost runs would change; arguments as `verdicts`."""
    if not np.isinf(table.value[(table.metric == "rmse") & (table.component == "norm")]).any():
        return []
    known: dict[bytes, tuple[float, float]] = {}  # pairs without a lost run are the same by every rule
    by_rule = [_winners(table, alpha, rule, known) for rule in LOST_RULES]
    found = []
    for (scenario, noise, model, group, a, b), worst in by_rule[0].items():
        key = (scenario, noise, model, group, a, b)
        winners = (worst, *(others.get(key, "no pair left") for others in by_rule[1:]))
        if len(set(winners)) > 1:
            found.append(Sensitivity(f"{scenario} / {noise} / {model}", group, a, b, winners))
    return found


def holm(p: Sequence[float] | Array) -> Array:
    """Holm's correction. That of statsmodels collects garbage at each call, which takes longer than all else here."""
    each = np.asarray(p, dtype=np.float64)
    order = np.argsort(each, kind="stable")
    found = np.empty(each.size)
    found[order] = np.minimum(np.maximum.accumulate(each[order] * np.arange(each.size, 0, -1)), 1.0)
    return found


def log_ratio(a: Array, b: Array) -> Array:
    """log(a / b) per run, made finite: where one of the two was lost, beyond all others; where both were, 0.

    Differences below the precision of what is stored are 0 too.

    Args:
        a, b: losses [n], non-negative, infinite where lost.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a) - np.log(b)
    d = np.where((a == b) | (np.abs(d) <= SAME), 0.0, d)
    return np.where(np.isfinite(d), d, np.sign(d) * _beyond(d))


def wilcoxon(d: Array) -> tuple[float, float]:
    """Wilcoxon's T and two-sided p of paired differences [n]; all zero gives p = 1."""
    return power.signed_rank(d)


def rank_biserial(d: Array) -> float:
    """Share of the rank sum with d < 0 less the share with d > 0: positive when a, of d = log(a / b), is smaller."""
    rank, _ = power.ranks_of(np.abs(d))
    return float((rank[d < 0].sum() - rank[d > 0].sum()) / rank.sum())


def improvement(a: Array, b: Array) -> Share:
    """Probability that a run of a has a smaller loss than a run of b, any of all pairs of runs, ties counted half.

    Args:
        a, b: losses of the same runs [n], infinite where lost.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.log(a)[:, None] - np.log(b)
    won = (1 - np.where(np.isnan(d) | (np.abs(d) <= SAME), 0.0, np.sign(d))) / 2
    value = float(won.mean())
    return Share(value, won.mean(1) + won.mean(0) - value)


def effect_share(d: Array) -> Share:
    """The rank-biserial correlation as the probability (1 + r) / 2 that a mean of two differences is below zero."""
    value = (1 + rank_biserial(d)) / 2
    return Share(value, 1 - np.sign(d[:, None] + d).mean(1) - value)


def share_interval(share: float, variance: float, runs: int, level: float) -> Interval:
    """Interval of a probability: normal on the logarithm of its odds; of 0 or 1 the exact one of as many trials.

    Args:
        share: 0 to 1.
        variance: of the share.
        runs: it rests on.
        level: coverage.
    """
    if runs < 2:
        return Interval(0.0, 1.0, "none")
    if not 0 < share < 1:
        edge = float(((1 - level) / 2) ** (1 / runs))
        return Interval(edge, 1.0, "exact") if share >= 1 else Interval(0.0, 1 - edge, "exact")
    middle = np.log(share / (1 - share))
    reach = -stdtrit(runs - 1, (1 - level) / 2) * np.sqrt(variance) / (share * (1 - share))
    low, high = 1 / (1 + np.exp(-(middle + np.clip(np.array([-reach, reach]), -500, 500))))
    return Interval(float(low), float(high), "odds")


def median_interval(d: Array, level: float, seed: int = 0) -> Interval:
    """Bootstrap interval of the median of d [n], BCa [Efron 1987] where it exists, else percentile."""
    ordered = np.sort(d)
    drawn = _medians(ordered, seed)
    median = np.median(d)
    alpha = (1 - level) / 2
    z = np.array([ndtri(alpha), -ndtri(alpha)])
    with np.errstate(all="ignore"):  # a constant sample has no BCa; the method that was used is named
        share = (np.count_nonzero(drawn < median) + np.count_nonzero(drawn <= median)) / (2 * drawn.size)
        moved = ndtri(share) + z
        levels = ndtr(ndtri(share) + moved / (1 - _acceleration(ordered) * moved))
    method = "BCa" if np.isfinite(levels).all() else "percentile"
    low, high = np.quantile(drawn, levels if method == "BCa" else [alpha, 1 - alpha])
    return Interval(float(low), float(high), method)


def _acceleration(ordered: Array) -> float:
    """Of the median of sorted numbers [n], from the medians without each of them; NaN where these are all the same."""
    n = ordered.size
    h = n // 2
    if n % 2:
        sides = [(ordered[h] + ordered[h + 1]) / 2, (ordered[h - 1] + ordered[h]) / 2, (ordered[h - 1] + ordered[h + 1]) / 2]
        left = np.repeat(sides, [h, h, 1])
    else:
        left = np.repeat([ordered[h], ordered[h - 1]], [h, h])
    u = (left.mean() - left) * (n - 1) / n
    return float((u**3).sum() / (u**2).sum() ** 1.5 / 6)


def _medians(ordered: Array, seed: int) -> Array:
    """Medians of samples drawn from sorted numbers [n] with replacement."""
    low, high = _middle(ordered.size, seed)
    return np.asarray((ordered[low] + ordered[high]) / 2)


@cache
def _middle(n: int, seed: int) -> tuple[Array, Array]:
    """Which of n sorted numbers are in the middle of samples drawn with replacement, by the law of the middle of n uniform ones.

    It is the bootstrap without its n draws, and the same for all samples of a size: both took most of the time of a report.
    """
    rng = np.random.default_rng([n, seed])
    m = (n + 1) // 2
    first = rng.beta(m, n - m + 1, _RESAMPLES)
    # Of an even number, the next of the n - m that lie above the first.
    second = first if n % 2 else 1 - (1 - first) * rng.random(_RESAMPLES) ** (1 / (n - m))
    low, high = ((n * u).astype(int).clip(max=n - 1) for u in (first, second))
    return low, high


def _winners(
    table: pd.DataFrame, alpha: float, rule: LostRule, known: dict[bytes, tuple[float, float]]
) -> dict[tuple[str, ...], str]:
    found: dict[tuple[str, ...], str] = {}
    for cell, wide in losses(table, rule):
        family = [(pair, _tested(both, known)) for pair, both in _pairs(wide)]
        for (pair, (_, effect)), p in zip(family, holm([p for _, (p, _) in family]), strict=True):
            found[(*cell, *pair)] = _decided(*pair, effect, float(p), alpha)
    return found


def _tested(both: Array, known: dict[bytes, tuple[float, float]]) -> tuple[float, float]:
    """p and effect of a pair [n, 2]; those of the same numbers are looked up."""
    key = both.tobytes()
    if key not in known:
        d = log_ratio(*both.T)
        known[key] = wilcoxon(d)[1], rank_biserial(d)
    return known[key]


def _pairs(wide: pd.DataFrame) -> Iterator[tuple[tuple[str, str], Array]]:
    values = wide.to_numpy(dtype=np.float64)  # not frame by frame, which takes longer than the tests
    for (i, a), (j, b) in combinations(enumerate(map(str, wide.columns)), 2):
        both = values[:, [i, j]]
        both = both[~np.isnan(both).any(axis=1)]
        if len(both):
            yield (a, b), both


def _compare(
    cell: CellKey, labels: tuple[str, str], both: Array, alpha: float, margin: float, wanted: float
) -> Verdict:
    a, b = both.T
    d = log_ratio(a, b)
    statistic, p = wilcoxon(d)
    # An interval needs two runs; of one run the median itself is all there is.
    interval = median_interval(d, 1 - alpha) if d.size > 1 else Interval(-np.inf, np.inf, "none")
    finite = np.isfinite(a) & np.isfinite(b) & (a > 0) & (b > 0)
    largest = np.abs(d[finite]).max(initial=0.0)
    middle, low, high = (_ratio(value, largest) for value in (float(np.median(d)), interval.low, interval.high))
    size, better = effect_share(d), improvement(a, b)
    size_in, better_in = (share_interval(s.value, _variance(s), d.size, 1 - alpha) for s in (size, better))
    return Verdict(
        *cell, metric="rmse", a=labels[0], b=labels[1], pairs=len(both), lost_a=int(np.isinf(a).sum()),
        lost_b=int(np.isinf(b).sum()), statistic=statistic, p=p, p_holm=p, family=1, effect=rank_biserial(d), ratio=middle,
        low=low, high=high, level=1 - alpha, interval=interval.method, winner=NO_DIFFERENCE,
        effect_low=2 * size_in.low - 1, effect_high=2 * size_in.high - 1,
        better=better.value, better_low=better_in.low, better_high=better_in.high,
        margin=margin, p_equivalent=power.equivalence(d, float(np.log1p(margin))), wanted=wanted,
        scatter=float(np.std(d[finite], ddof=1)) if finite.sum() > 1 else np.nan,
    )  # fmt: skip


def _winner(v: Verdict, p: float, alpha: float) -> str:
    return _decided(v.a, v.b, v.effect, p, alpha)


def _decided(a: str, b: str, effect: float, p: float, alpha: float) -> str:
    if not p <= alpha or effect == 0:
        return NO_DIFFERENCE
    return a if effect > 0 else b


def _power(v: Verdict, alpha: float) -> tuple[float, float]:
    """Runs needed for the wanted effect, and the smallest share found by the pairs at hand, at the level alpha."""
    if not np.isfinite(v.scatter) or not np.isfinite(v.wanted):
        return np.nan, np.nan
    if v.scatter == 0:
        return float(power.least(alpha)), 0.0 if v.pairs >= power.least(alpha) else np.inf
    runs = power.needed(float(np.log1p(v.wanted)) / v.scatter, alpha)
    return runs, float(np.expm1(power.detectable(v.scatter, v.pairs, alpha)))


def _variance(share: Share) -> float:
    return float(np.var(share.parts, ddof=1)) / share.parts.size if share.parts.size > 1 else np.nan


def _beyond(d: Array) -> float:
    # More than three times the largest, so that half-way between it and any finite difference is still beyond them all.
    return 4 * float(np.abs(d[np.isfinite(d)]).max(initial=0.0)) + 1


def _ratio(log: float, largest: float) -> float:
    """Back from the logarithm; what lies beyond every finite difference stands for lost runs."""
    if abs(log) > largest * (1 + 1e-12):
        return np.inf if log > 0 else 0.0
    return float(np.exp(log))
