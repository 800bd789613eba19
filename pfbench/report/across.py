"""Which filter is better across cells, decided once: cells are the blocks, filters the treatments [Demsar 2006].

The value of a block is the median over the runs of a cell of log RMSE. Runs of one cell share scene and regime and are never
blocks. Differences of logarithms have no unit, so that cells of different worlds can stand side by side.

An omnibus test (Friedman, corrected for ties, in the form of Iman and Davenport 1980) comes first; then every pair of filters by
Nemenyi's test, Conover's with Holm's correction and Wilcoxon's with Holm's correction. A filter is called better when the
omnibus test and Nemenyi's both show it [ours]: that is what the critical-difference diagram shows; the other two are printed
beside it. The Bayesian signed-rank test says how probable it is that a filter is better, or as good within a margin
[Benavoli et al. 2014].

Regimes of one world share its seeds, so that cells are more alike than independent blocks are: what the omnibus test says with
worlds as blocks is printed beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd
import scikit_posthocs as posthocs
from scipy import stats

from pfbench.metrics import Array
from pfbench.report import power
from pfbench.report.frame import natural
from pfbench.report.significance import (
    NO_DIFFERENCE,
    SAME,
    WORST,
    LostRule,
    Share,
    holm,
    improvement,
    log_ratio,
    losses,
    rank_biserial,
    share_interval,
    wilcoxon,
)

CELLS, FILTERS = 5, 3  # that a test across cells takes at least [ours]
WORLDS = 3  # that one with worlds as blocks takes at least [ours]
VALUE = "median over runs of log RMSE"
_SAMPLES = 20_000
_PRIOR = 0.5  # of the pseudo-observation at zero [Benavoli et al. 2014], as baycomp has it


class Blocks(NamedTuple):
    """What enters a comparison across cells.

    Attributes:
        group: of the state.
        filters: labels [K].
        cells: names [B].
        values: median over runs of log RMSE [B, K]; infinite where half of the runs or more were lost.
        runs: RMSE [n, K] of each cell, of the runs that all filters have.
        left_out: cells and filters that do not enter, and why.
        shared: cells that see the worlds of another one, with another model: scenario and noise are the same.
    """

    group: str
    filters: tuple[str, ...]
    cells: tuple[str, ...]
    values: Array
    runs: tuple[Array, ...]
    left_out: tuple[str, ...]
    shared: int


class Friedman(NamedTuple):
    """The omnibus test.

    Attributes:
        ranks: mean rank of each filter [K], 1 is best.
        plain: chi-square without the correction for ties, as in Demsar 2006.
        chi2, p: with it.
        f, p_f: Iman and Davenport's form of it.
        critical: Nemenyi's critical difference of mean ranks.
    """

    ranks: Array
    plain: float
    chi2: float
    p: float
    f: float
    p_f: float
    critical: float


@dataclass(frozen=True)
class AcrossPair:
    """Filter a against filter b across cells.

    Attributes:
        a, b: labels.
        wins, losses: cells in which the median error of a is the smaller or the larger one.
        rank_a, rank_b: mean ranks.
        p_nemenyi, p_conover, p_wilcoxon: corrected over all `family` pairs, the last two by Holm.
        family: pairs.
        effect: rank-biserial correlation over cells, positive when a is better.
        ratio: median over cells of the ratio of median errors of a to b; 0 or infinite where lost runs decide it.
        bayes_a, bayes_equal, bayes_b: posterior probability that a is better, both are within the margin, b is better.
        better, better_low, better_high: probability of improvement of a over b in a run, mean over cells, and its interval over
            runs, of coverage 1 - alpha.
        winner: a, b or "no difference shown".
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
class ByWorld:
    """The omnibus test with worlds as blocks: of each filter the median, over the cells of a world, of its rank.

    Attributes:
        worlds: how many.
        p, p_f: Friedman's, and in Iman and Davenport's form.
        best: filters of the smallest mean rank; several where they tie.
    """

    worlds: int
    p: float
    p_f: float
    best: tuple[str, ...]


@dataclass(frozen=True)
class Across:
    """What is decided across the cells of a study, for one group of the state.

    Attributes:
        group, metric, value, rule: what was compared, what stands for a block, and what for a lost run.
        alpha, margin: level, and share by which RMSE may differ between filters that count as equal.
        filters, cells: that entered.
        left_out: cells and filters that did not, and why.
        shared: cells that see the worlds of another cell.
        refused: why no test was made; empty where it was.
        ranks: mean ranks, as filters.
        chi2, p: Friedman's.
        f, p_f: Iman and Davenport's.
        critical: Nemenyi's critical difference.
        pairs: all of them.
        by_world: the test with worlds as blocks; None where each cell has a world of its own, or worlds are too few.
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
    pairs: tuple[AcrossPair, ...] = ()
    by_world: ByWorld | None = None

    @property
    def worlds(self) -> int:
        """Distinct worlds among the cells."""
        return len(worlds_of(self.cells))

    @property
    def best(self) -> tuple[str, ...]:
        """Filters of the smallest mean rank; several where they tie."""
        return _first(self.filters, self.ranks)

    @property
    def least(self) -> int:
        """Cells below which Wilcoxon's test with Holm's correction over all pairs can show no difference whatever."""
        return power.least(self.alpha / max(1, len(self.pairs)))

    @property
    def unbeaten(self) -> list[str]:
        """Filters that no other one is shown to be better than."""
        beaten = {p.b if p.winner == p.a else p.a for p in self.pairs if p.winner != NO_DIFFERENCE}
        return [label for label in self.filters if label not in beaten]

    @property
    def shown(self) -> int:
        """Pairs of which a difference is shown."""
        return sum(p.winner != NO_DIFFERENCE for p in self.pairs)


def across(
    table: pd.DataFrame, group: str, alpha: float = 0.05, margin: float = 0.05, rule: LostRule = WORST
) -> Across:
    """Compares all filters across the cells of a study.

    Args:
        table: from `frame`; rows of metric "rmse" and component "norm" are used, in any order.
        group: of the state.
        alpha: level.
        margin: region of practical equivalence: share by which RMSE may differ.
        rule: for lost runs.
    """
    found = blocks(table, group, rule)
    head = (group, "rmse", VALUE, rule.name, alpha, margin, found.filters, found.cells, found.left_out, found.shared)
    why = _refusal(found)
    if why:
        return Across(*head, refused=why)
    test = friedman(ranks(found.values), alpha)
    pairs = _compared(found, test, alpha, margin)
    return Across(
        *head, refused="", ranks=tuple(map(float, test.ranks)), chi2=test.chi2, p=test.p, f=test.f, p_f=test.p_f,
        critical=test.critical, pairs=tuple(pairs), by_world=_by_world(found),
    )  # fmt: skip


def winners(table: pd.DataFrame, group: str, alpha: float, rule: LostRule) -> dict[tuple[str, str], str] | str:
    """Winner of each pair by another rule for lost runs, or why no test is made; arguments as `across`."""
    found = blocks(table, group, rule)
    if why := _refusal(found):
        return why
    rank = ranks(found.values)
    test, p = friedman(rank, alpha), nemenyi(rank)
    pairs = combinations(range(len(found.filters)), 2)
    return {(found.filters[i], found.filters[j]): _better(found, test, float(p[i, j]), i, j, alpha) for i, j in pairs}


def blocks(table: pd.DataFrame, group: str, rule: LostRule = WORST) -> Blocks:
    """The cells in which all filters ran on the same worlds.

    Where not every filter ran in every cell, filters are taken by the number of cells that they ran in, as many as leave the
    largest number of values (cells times filters), of those that leave a test to be made if any do [ours].
    """
    rows = table[table.group == group]
    wides = sorted(losses(rows, rule), key=lambda item: [natural(part) for part in item[0]])
    whole = {" / ".join(cell[:3]): wide.dropna(axis=1, how="all") for cell, wide in wides}
    present = {name: set(map(str, wide.columns)) for name, wide in whole.items()}
    filters, names = _complete(present)
    left_out = [
        f"{label} (ran in {sum(label in own for own in present.values())} of {len(present)} cells)"
        for label in sorted(set().union(*present.values()) - set(filters), key=natural)
    ] if present else []
    cells, runs = [], []
    for name, wide in whole.items():
        if name not in names:
            missing = sorted(set(filters) - present[name], key=natural)
            left_out.append(f"{name} (without {', '.join(missing)})")
            continue
        own = wide[list(filters)].dropna().to_numpy(dtype=np.float64)
        if len(own):
            cells.append(name)
            runs.append(own)
        else:
            left_out.append(f"{name} (no run in common of all filters)")
    worlds = [name.rsplit(" / ", 1)[0] for name in cells]
    with np.errstate(divide="ignore"):
        values = np.array([np.median(np.log(own), axis=0) for own in runs]).reshape(len(cells), len(filters))
    return Blocks(group, filters, tuple(cells), values, tuple(runs), tuple(left_out), len(worlds) - len(set(worlds)))


def worlds_of(cells: Sequence[str]) -> list[str]:
    """The distinct worlds of cells named `scenario / noise / model`, in their order."""
    return list(dict.fromkeys(cell.split(" / ")[0] for cell in cells))


def ranks(values: Array) -> Array:
    """Ranks of the values within each block [B, K], 1 is smallest; ties share theirs, infinite ones and rounding too."""
    values = np.asarray(values, dtype=np.float64)
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    with np.errstate(invalid="ignore"):
        step = np.diff(ordered, axis=1)
    apart = np.cumsum(np.where(np.isnan(step), 0, step > SAME), axis=1)
    level = np.empty(values.shape)
    np.put_along_axis(level, order, np.column_stack([np.zeros(len(values)), apart]), axis=1)
    return np.asarray(stats.rankdata(level, axis=1))


def friedman(rank: Array, alpha: float = 0.05) -> Friedman:
    """The omnibus test on ranks [B, K] and Nemenyi's critical difference."""
    n, k = rank.shape
    mean = rank.mean(axis=0)
    plain = 12 * n / (k * (k + 1)) * (float(np.sum(mean**2)) - k * (k + 1) ** 2 / 4)
    tied = bool(np.ptp(rank) == 0)  # every filter ties with every other one everywhere
    chi2, p = (0.0, 1.0) if tied else map(float, stats.friedmanchisquare(*rank.T))
    rest = n * (k - 1) - chi2
    f = (n - 1) * chi2 / rest if rest > 1e-9 * n else math.inf
    p_f = float(stats.f.sf(f, k - 1, (k - 1) * (n - 1)))
    q = float(stats.studentized_range.isf(alpha, k, np.inf)) / math.sqrt(2)
    return Friedman(mean, plain, chi2, p, f, p_f, q * standard_error(n, k))


def standard_error(cells: int, filters: int) -> float:
    """Of the difference of two mean ranks when all filters are alike."""
    return math.sqrt(filters * (filters + 1) / (6 * cells))


def nemenyi(rank: Array) -> Array:
    """p of each pair [K, K], from ranks [B, K]; corrected over all of them."""
    return np.asarray(posthocs.posthoc_nemenyi_friedman(rank), dtype=np.float64)


def conover(rank: Array) -> Array:
    """p of each pair [K, K] after Conover 1999, Holm over all of them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.asarray(posthocs.posthoc_conover_friedman(rank), dtype=np.float64)
    # Where all blocks agree the residual variance is zero: 0 / 0 for ties, which differ in nothing.
    p = np.where(np.isnan(p), 1.0, p)
    upper = np.triu_indices(len(p), 1)
    p[upper] = holm(p[upper])
    p.T[upper] = p[upper]
    return p


def wilcoxons(values: Array) -> dict[tuple[int, int], float]:
    """p of each pair of columns of log values [B, K], Holm over all of them."""
    pairs = list(combinations(range(values.shape[1]), 2))
    p = holm([wilcoxon(_difference(values, i, j))[1] for i, j in pairs])
    return dict(zip(pairs, map(float, p), strict=True))


def signed_rank(d: Array, rope: float, seed: int = 0) -> tuple[float, float, float]:
    """Posterior probabilities that d [B] is centred below -rope, within the rope, or above it [Benavoli et al. 2014].

    The law of d is a Dirichlet process with half a pseudo-observation at zero; the three statements are weighed by the
    mean of two differences drawn from it, and the probability is that of each being the weightiest.
    """
    full = np.concatenate([[0.0], d])
    sums = full[:, None] + full
    below, above = (np.heaviside(side, 0.5) for side in (-sums - 2 * rope, sums - 2 * rope))
    weight = _weights(d.size, seed)
    left, right = (np.einsum("si,si->s", weight @ law, weight) for law in (below, above))
    most = np.argmax(np.column_stack([left, 1 - left - right, right]), axis=1)
    first, second, third = np.bincount(most, minlength=3) / _SAMPLES
    return float(first), float(second), float(third)


@lru_cache(maxsize=2)
def _weights(n: int, seed: int) -> Array:
    """Draws of the Dirichlet law over n differences and the pseudo-observation; the same for all pairs of a size."""
    return np.random.default_rng([n, seed]).dirichlet(np.concatenate([[_PRIOR], np.ones(n)]), _SAMPLES)


def profile(found: Blocks, at: Array) -> Array:
    """Performance profile [K, len(at)]: share of the runs in which a filter's error is at most `at` times the best one's.

    A run of a cell is one problem, which all filters solve [Dolan, More 2002]; every cell has the same weight, and a lost run
    never gets there.
    """
    shares = []
    for own in found.runs:
        best = own.min(axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(own == best, 1.0, own / best)
        ratio = np.where(np.isfinite(own), ratio, np.inf)
        shares.append((ratio[:, :, None] <= np.asarray(at) * (1 + SAME)).mean(axis=0))
    return np.mean(shares, axis=0)


def _compared(found: Blocks, test: Friedman, alpha: float, margin: float) -> list[AcrossPair]:
    rank = ranks(found.values)
    by_nemenyi, by_conover, by_wilcoxon = nemenyi(rank), conover(rank), wilcoxons(found.values)
    pairs = []
    for i, j in by_wilcoxon:
        a, b = found.filters[i], found.filters[j]
        d = _difference(found.values, i, j)
        left, equal, right = signed_rank(d, float(np.log1p(margin)))
        shares = [improvement(own[:, i], own[:, j]) for own in found.runs]
        better, (low, high) = _mean_share(shares, 1 - alpha)
        middle = float(np.median(d))
        known = found.values[:, [i, j]]
        largest = np.abs(d[np.isfinite(known).all(axis=1)]).max(initial=0.0)
        pairs.append(AcrossPair(
            a, b, wins=int((d < 0).sum()), losses=int((d > 0).sum()), rank_a=float(test.ranks[i]),
            rank_b=float(test.ranks[j]), p_nemenyi=float(by_nemenyi[i, j]), p_conover=float(by_conover[i, j]),
            p_wilcoxon=by_wilcoxon[i, j], family=len(by_wilcoxon), effect=rank_biserial(d),
            ratio=math.exp(middle) if abs(middle) <= largest * (1 + 1e-12) else (math.inf if middle > 0 else 0.0),
            bayes_a=left, bayes_equal=equal, bayes_b=right, better=better, better_low=low, better_high=high,
            winner=_better(found, test, float(by_nemenyi[i, j]), i, j, alpha),
        ))  # fmt: skip
    return pairs


def _by_world(found: Blocks) -> ByWorld | None:
    names = worlds_of(found.cells)
    if not WORLDS <= len(names) < len(found.cells):
        return None
    own = ranks(found.values)
    of_world = [[cell.split(" / ")[0] == name for cell in found.cells] for name in names]
    # Ranks and not errors: those of a rough regime and of a quiet one have no common size to take a median of.
    test = friedman(ranks(np.array([np.median(own[rows], axis=0) for rows in of_world])))
    return ByWorld(len(names), test.p, test.p_f, _first(found.filters, test.ranks))


def _first(filters: Sequence[str], rank: Sequence[float] | Array) -> tuple[str, ...]:
    """Those of the smallest mean rank, to rounding."""
    return tuple(label for label, value in zip(filters, rank, strict=False) if value <= min(rank) + SAME)


def _better(found: Blocks, test: Friedman, p: float, i: int, j: int, alpha: float) -> str:
    """The filter of the better rank, where the omnibus test and Nemenyi's p both show a difference."""
    if test.p_f > alpha or p > alpha:
        return NO_DIFFERENCE
    return found.filters[i if test.ranks[i] < test.ranks[j] else j]


def _mean_share(shares: Sequence[Share], level: float) -> tuple[float, tuple[float, float]]:
    """Mean over cells of a probability and its interval over runs; the cells are as they are."""
    value = float(np.mean([share.value for share in shares]))
    some = [share for share in shares if share.parts.size > 1]
    variance = sum(float(np.var(share.parts, ddof=1)) / share.parts.size for share in some) / len(shares) ** 2
    runs = sum(share.parts.size for share in shares) if some else 1
    low, high, _ = share_interval(value, variance, runs, level)
    return value, (low, high)


def _difference(values: Array, i: int, j: int) -> Array:
    return log_ratio(np.exp(values[:, i]), np.exp(values[:, j]))


def _complete(present: Mapping[str, set[str]]) -> tuple[tuple[str, ...], set[str]]:
    """Filters and the cells that have them all; see `blocks`."""
    labels = sorted(set().union(*present.values()), key=natural) if present else []
    labels.sort(key=lambda label: -sum(label in own for own in present.values()))
    choices = []
    for k in range(1, len(labels) + 1):
        names = {name for name, own in present.items() if own.issuperset(labels[:k])}
        fit = k >= FILTERS and len(names) >= CELLS
        choices.append((fit, k * len(names), k, names))
    if not choices:
        return (), set()
    _, _, k, names = max(choices, key=lambda choice: choice[:3])
    return tuple(sorted(labels[:k], key=natural)), names


def _refusal(found: Blocks) -> str:
    cells, filters = len(found.cells), len(found.filters)
    if filters < FILTERS:
        return f"it compares {FILTERS} filters at least, and {_counted(filters, 'filter')} ran in the same cells"
    if cells < CELLS:
        return (
            f"it takes {CELLS} cells at least, and the {filters} filters have {_counted(cells, 'cell')} in common; runs of one "
            "cell are no cells of their own"
        )
    return ""


def _counted(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
