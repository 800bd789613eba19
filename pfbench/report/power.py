"""What a comparison of so many runs can show: power, the runs it takes, the smallest effect it finds, and equivalence.

Effects are differences of the logarithm of the loss between two filters on the same runs, in units of their standard
deviation. The signed-rank test of n pairs is as good as the t test of 3/pi n of them when differences are normal, and of
0.864 n at the least, whatever their law [Hodges, Lehmann 1956]; the t test is counted by the closed form of Guenther 1981.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import product

import numpy as np
from scipy import stats
from scipy.special import ndtr, ndtri

from pfbench.metrics import Array

EFFICIENCY = 3 / math.pi
POWER = 0.8
_ENUMERATED = 13  # differences of which some are tied and all signs are tried, as in scipy


def least(alpha: float) -> int:
    """Pairs below which the two-sided signed-rank test never reaches p <= alpha: all signs alike has p = 2^(1 - n)."""
    return math.ceil(1 + math.log2(1 / alpha) - 1e-9)


def power(effect: float, pairs: int, alpha: float = 0.05, efficiency: float = EFFICIENCY) -> float:
    """Probability that the paired signed-rank test finds an effect, two-sided at level alpha.

    Args:
        effect: mean difference in standard deviations of the difference.
        pairs: runs that both filters have.
        alpha: level; that of the whole family divided by its size where Holm's correction follows, which is cautious.
        efficiency: of the test relative to the t test.
    """
    z = float(-ndtri(alpha / 2))
    if pairs < least(alpha):
        return 0.0
    return float(ndtr(abs(effect) * math.sqrt(max(efficiency * pairs - z**2 / 2, 0.0)) - z))


def needed(
    effect: float, alpha: float = 0.05, wanted: float = POWER, efficiency: float = EFFICIENCY
) -> float:
    """Runs that it takes to find an effect with the wanted power; infinite for none. Arguments as `power`."""
    if effect == 0:
        return math.inf
    z = float(-ndtri(alpha / 2))
    of_t = ((z + ndtri(wanted)) / effect) ** 2 + z**2 / 2
    return float(max(math.ceil(of_t / efficiency), least(alpha)))


def needed_share(share: float, limit: float, alpha: float = 0.05, wanted: float = POWER) -> float:
    """Runs that it takes to find on which side of a limit a probability lies; infinite at the limit.

    By the normal law of counts, corrected for their steps as the exact test has them [Fleiss, Levin, Paik 2003].

    Args:
        share: the probability.
        limit: that it is compared to.
        alpha: level, one-sided.
        wanted: power.
    """
    if share == limit:
        return math.inf
    spread = -ndtri(alpha) * math.sqrt(limit * (1 - limit)) + ndtri(wanted) * math.sqrt(share * (1 - share))
    off = abs(share - limit)
    smooth = (spread / off) ** 2
    return float(math.ceil(smooth / 4 * (1 + math.sqrt(1 + 2 / (smooth * off))) ** 2))


def detectable(
    sd: float, pairs: int, alpha: float = 0.05, wanted: float = POWER, efficiency: float = EFFICIENCY
) -> float:
    """Smallest mean difference that is found with the wanted power, in the unit of `sd`; infinite where none is."""
    z = float(-ndtri(alpha / 2))
    room = efficiency * pairs - z**2 / 2
    if pairs < least(alpha) or room <= 0:
        return math.inf
    return float(sd * (z + ndtri(wanted)) / math.sqrt(room))


def equivalence(d: Array, margin: float) -> float:
    """p of the claim that the differences d [n] are centred within the margin.

    Two one-sided signed-rank tests, against a centre at -margin or below and at +margin or above; the larger p counts
    [Schuirmann 1987; Wellek 2010, section 5.4]. As the signed-rank test itself it takes the law of d to be symmetric.

    Raises:
        ValueError: the margin is not positive.
    """
    if not margin > 0:
        raise ValueError(f"margin={margin}: two filters are equivalent within a positive margin only; 0.05 is five per cent")
    return max(_above(np.asarray(d) + margin), _above(margin - np.asarray(d)))


def signed_rank(d: Array, side: str = "two-sided") -> tuple[float, float]:
    """Wilcoxon's T and p of paired differences [n], the ranks of zeros split evenly; all zero gives p = 1.

    The law of T is scipy's choice: exact up to 13 differences, and up to 50 where no two are tied; else normal. Where it is
    ties among few, or many, its values are computed here: scipy takes ten to a thousand times as long over them.

    Args:
        d: differences.
        side: "two-sided", or "greater" where d is claimed to be centred above zero.
    """
    n = d.size
    if not d.any():
        return n * (n + 1) / 4, 1.0
    rank, ties = ranks_of(np.abs(d))
    tied = bool((ties > 1).any() or (d == 0).any())
    if n <= 50 and not (tied and n <= _ENUMERATED):
        found = stats.wilcoxon(d, alternative=side, zero_method="zsplit")
        return float(found.statistic), float(found.pvalue)
    zero = float(rank[d == 0].sum()) / 2
    above, below = float(rank[d > 0].sum()) + zero, float(rank[d < 0].sum()) + zero
    if n <= _ENUMERATED:
        law = _signs(n) @ np.where(d == 0, 0.0, rank) + zero  # sums of halves: no rounding
        more, less = float((law >= above).mean()), float((law <= above).mean())
        return (above, more) if side == "greater" else (min(above, below), min(1.0, 2 * more, 2 * less))
    deviation = math.sqrt((n * (n + 1) * (2 * n + 1) - float((ties**3 - ties).sum()) / 2) / 24)
    z = (above - n * (n + 1) / 4) / deviation
    return (above, float(ndtr(-z))) if side == "greater" else (min(above, below), float(2 * ndtr(-abs(z))))


@cache
def _signs(n: int) -> Array:
    """Which of n differences are positive, in all 2^n ways [2^n, n]."""
    return np.array(list(product((0.0, 1.0), repeat=n)))


def ranks_of(values: Array) -> tuple[Array, Array]:
    """Ranks of values [n], 1 is smallest, ties sharing theirs; and how many share each."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[place], count.astype(np.float64)


def _above(d: Array) -> float:
    """One-sided p that d is centred above zero."""
    return signed_rank(np.asarray(d, dtype=np.float64), "greater")[1]
