"""Tests on ranks of filters within conditions: Friedman, Nemenyi, Conover, Wilcoxon per pair."""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scikit_posthocs as posthocs
from scipy import stats

from pfbench.results.error_measures import Array
from pfbench.results.statistics.effect_sizes import LOG_TOLERANCE, log_ratio
from pfbench.results.statistics.signed_rank import holm, wilcoxon_signed_rank_rows


class FriedmanResult(NamedTuple):
    """Omnibus test over all filters.

    Attributes:
        ranks: Mean rank of each filter, [K]; 1 is best.
        plain: Chi-square without correction for ties, as in Demsar 2006.
        chi2: Chi-square corrected for ties.
        p: p-value of chi2.
        f: F statistic of Iman and Davenport 1980.
        p_f: p-value of f.
        critical: Nemenyi's critical difference of mean ranks.
    """

    ranks: Array
    plain: float
    chi2: float
    p: float
    f: float
    p_f: float
    critical: float


def rank_within_blocks(values: Array) -> Array:
    """Rank values within each block [B, K], 1 is smallest; ties and rounding are averaged."""
    values = np.asarray(values, dtype=np.float64)
    order = np.argsort(values, axis=1, kind="stable")
    ordered = np.take_along_axis(values, order, axis=1)
    with np.errstate(invalid="ignore"):
        step = np.diff(ordered, axis=1)
    count = np.cumsum(np.where(np.isnan(step), 0, step > LOG_TOLERANCE), axis=1)
    level = np.empty(values.shape)
    np.put_along_axis(level, order, np.column_stack([np.zeros(len(values)), count]), axis=1)
    return np.asarray(stats.rankdata(level, axis=1))


def friedman(rank: Array, alpha: float = 0.05) -> FriedmanResult:
    """Test whether filters differ, and compute Nemenyi's critical difference.

    Args:
        rank: Ranks within blocks, [B, K].
        alpha: Level of the critical difference.

    Returns:
        Statistics and p-values.
    """
    n, k = rank.shape
    mean = rank.mean(axis=0)
    plain = 12 * n / (k * (k + 1)) * (float(np.sum(mean**2)) - k * (k + 1) ** 2 / 4)
    is_tied = bool(np.ptp(rank) == 0)  # all filters tie in all blocks
    chi2, p = (0.0, 1.0) if is_tied else map(float, stats.friedmanchisquare(*rank.T))
    rest = n * (k - 1) - chi2
    f = (n - 1) * chi2 / rest if rest > 1e-9 * n else math.inf
    p_f = float(stats.f.sf(f, k - 1, (k - 1) * (n - 1)))
    q = float(stats.studentized_range.isf(alpha, k, np.inf)) / math.sqrt(2)
    return FriedmanResult(mean, plain, chi2, p, f, p_f, q * rank_standard_error(n, k))


def rank_standard_error(blocks: int, filters: int) -> float:
    """Compute the standard error of a difference of mean ranks if all filters are equal.

    Args:
        blocks: Number of blocks.
        filters: Number of filters.
    """
    return math.sqrt(filters * (filters + 1) / (6 * blocks))


def nemenyi(rank: Array) -> Array:
    """Compute Nemenyi's p of each pair [K, K] from ranks [B, K], adjusted over all pairs."""
    return np.asarray(posthocs.posthoc_nemenyi_friedman(rank), dtype=np.float64)


def conover(rank: Array) -> Array:
    """Compute Conover's p [Conover 1999] of each pair [K, K], Holm over all pairs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        p = np.asarray(posthocs.posthoc_conover_friedman(rank), dtype=np.float64)
    # If all blocks agree the residual variance is zero, and ties give 0 / 0.
    p = np.where(np.isnan(p), 1.0, p)
    upper = np.triu_indices(len(p), 1)
    p[upper] = holm(p[upper])
    p.T[upper] = p[upper]
    return p


def wilcoxon_pairs(values: Array) -> dict[tuple[int, int], float]:
    """Compute Wilcoxon's p of each pair of columns of log values [B, K], Holm over all pairs."""
    pairs = list(combinations(range(values.shape[1]), 2))
    d = np.array([log_difference(values, i, j) for i, j in pairs])
    p = holm(wilcoxon_signed_rank_rows(d)[1]) if pairs else ()
    return dict(zip(pairs, map(float, p), strict=True))


def log_difference(values: Array, i: int, j: int) -> Array:
    """Return finite differences of two columns, as `log_ratio`.

    Args:
        values: Log values, [B, K].
        i: First column.
        j: Second column.
    """
    return log_ratio(np.exp(values[:, i]), np.exp(values[:, j]))
