"""Test of a share by exchange of the two filters in whole runs.

If two filters are alike, the exchange of their labels in a run does not change the distribution of
the results. All conditions of a run are exchanged together, because they share random numbers.
McNemar's test over conditions ignores this and is too liberal.

The distribution over all 2^N exchanges is computed exactly where the contributions are multiples of
a common step. Otherwise labels are exchanged at random.

References:
    R. A. Fisher (1935), The design of experiments.
"""

from __future__ import annotations

import math
import zlib
from fractions import Fraction
from functools import lru_cache

import numpy as np
from scipy.special import gammaln

from pfbench.results.error_measures import Array

FLIPS = 9999  # random exchanges: the smallest p-value is 1e-4, as many pairs require
_LONGEST_SUM = 20_000  # steps up to which the distribution is exact
_TOLERANCE = 1e-9


def run_contributions(d: Array, weights: Array, shared_runs: bool = True) -> Array:
    """Compute the contribution of each run to a mean over worlds and conditions.

    Args:
        d: Differences, [..., W, C, N], 0 if the filters agree; NaN for an absent run.
        weights: Weights of the conditions of a world, [W, C], with sum 1 for each world.
        shared_runs: Whether a run has the same random numbers in all worlds, so that its
            contributions are exchanged together.

    Returns:
        Contributions, [..., N], or [..., W * N] for worlds with runs that are not shared.
    """
    runs = np.count_nonzero(~np.isnan(d), axis=-1)
    share = weights / np.maximum(runs, 1) / d.shape[-3]
    by_world = np.einsum("...wc,...wcn->...wn", share, np.nan_to_num(d))
    if shared_runs:
        return np.asarray(by_world.sum(axis=-2))
    return by_world.reshape(*by_world.shape[:-2], -1)


def flip_p_value(contributions: Array, seed: int = 0, key: str = "") -> float:
    """Test whether contributions are symmetric around zero, two-sided.

    Args:
        contributions: Contribution of each run, [N].
        seed: Seed of random exchanges. They are used only without a common step.
        key: Name of the comparison. Each comparison has a stream of its own, so that further
            comparisons do not change its p-value.

    Returns:
        p-value; 1 if all contributions are 0.
    """
    x = contributions[np.abs(contributions) > _TOLERANCE]
    if not x.size:
        return 1.0
    steps = _as_steps(x)
    if steps is not None:
        sizes, counts = np.unique(np.abs(steps), return_counts=True)
        sums = _positive_sum_distribution(tuple(map(int, sizes)), tuple(map(int, counts)))
        distance = np.abs(2 * np.arange(sums.size) - (sums.size - 1))
        return min(1.0, float(sums[distance >= abs(int(steps.sum()))].sum()))
    rng = np.random.default_rng([seed, zlib.crc32(key.encode())])
    signs = rng.integers(0, 2, (FLIPS, x.size)) * 2.0 - 1.0
    extreme = np.abs(signs @ x) >= abs(float(x.sum())) - _TOLERANCE
    return (1 + int(extreme.sum())) / (1 + FLIPS)


def _as_steps(x: Array) -> np.ndarray | None:
    """Express numbers as multiples of a common step; None without a step of useful size."""
    smallest = float(np.abs(x).min())
    denominator = 1
    for ratio in np.unique(np.round(np.abs(x) / smallest, 9)):
        fraction = Fraction(float(ratio)).limit_denominator(1000)
        if abs(float(fraction) - ratio) > 1e-6:
            return None
        denominator = math.lcm(denominator, fraction.denominator)
        if denominator > _LONGEST_SUM:
            return None
    steps = np.rint(x / smallest * denominator).astype(np.int64)
    return steps if np.abs(steps).sum() <= _LONGEST_SUM else None


@lru_cache(maxsize=4096)
def _positive_sum_distribution(sizes: tuple[int, ...], counts: tuple[int, ...]) -> Array:
    """Compute the distribution of the sum of sizes, each included with probability 1/2."""
    total = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        spaced = np.zeros(size * count + 1)
        k = np.arange(count + 1)
        spaced[::size] = np.exp(
            gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1) - count * math.log(2)
        )
        total = np.convolve(total, spaced)
    return total
