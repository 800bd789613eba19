"""Sample sizes: power of the paired signed-rank test, runs required, smallest detectable effect.

Effects are differences of log losses of two filters on the same runs, in standard deviations of the
difference. For normal differences the signed-rank test of n pairs equals the t test of 3 n / pi
pairs, and for any distribution at least of 0.864 n [Hodges, Lehmann 1956]. The t test is counted by
the closed form of Guenther 1981.
"""

from __future__ import annotations

import math

from scipy.special import ndtr, ndtri

EFFICIENCY = 3 / math.pi
POWER = 0.8


def min_pairs(alpha: float) -> int:
    """Return the pairs below which the two-sided signed-rank test cannot reach p <= alpha.

    If all signs are equal, p = 2^(1 - n).
    """
    return math.ceil(1 + math.log2(1 / alpha) - 1e-9)


def compute_power(
    effect: float, pairs: int, alpha: float = 0.05, efficiency: float = EFFICIENCY
) -> float:
    """Compute the probability that the two-sided paired signed-rank test shows an effect.

    Args:
        effect: Mean difference in standard deviations of the difference.
        pairs: Runs that both filters have.
        alpha: Level. Before Holm's correction, the level of the family divided by its size.
        efficiency: Efficiency of the test relative to the t test.

    Returns:
        Power, 0 to 1.
    """
    z = float(-ndtri(alpha / 2))
    if pairs < min_pairs(alpha):
        return 0.0
    return float(ndtr(abs(effect) * math.sqrt(max(efficiency * pairs - z**2 / 2, 0.0)) - z))


def required_runs(
    effect: float, alpha: float = 0.05, power: float = POWER, efficiency: float = EFFICIENCY
) -> float:
    """Compute the runs required to show an effect; infinite for no effect.

    Args:
        effect: Mean difference in standard deviations of the difference.
        alpha: Level.
        power: Power required.
        efficiency: Efficiency of the test relative to the t test.

    Returns:
        Number of runs.
    """
    if effect == 0:
        return math.inf
    z = float(-ndtri(alpha / 2))
    of_t_test = ((z + ndtri(power)) / effect) ** 2 + z**2 / 2
    return float(max(math.ceil(of_t_test / efficiency), min_pairs(alpha)))


def required_runs_proportion(
    proportion: float, limit: float, alpha: float = 0.05, power: float = POWER
) -> float:
    """Compute the runs required to show on which side of a limit a probability lies.

    Normal approximation with a continuity correction [Fleiss, Levin, Paik 2003].

    Args:
        proportion: Probability.
        limit: Limit of the probability.
        alpha: One-sided level.
        power: Power required.

    Returns:
        Number of runs, infinite if the probability equals the limit.
    """
    if proportion == limit:
        return math.inf
    at_limit, at_value = (math.sqrt(p * (1 - p)) for p in (limit, proportion))
    spread = -ndtri(alpha) * at_limit + ndtri(power) * at_value
    distance = abs(proportion - limit)
    smooth = (spread / distance) ** 2
    return float(math.ceil(smooth / 4 * (1 + math.sqrt(1 + 2 / (smooth * distance))) ** 2))
