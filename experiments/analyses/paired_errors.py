"""Errors of filters compared on paired runs, for docs/robustness.md: centres, intervals and tests of logarithms of ratios."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from pfbench.results import wilcoxon_signed_rank

ALPHA = 0.05
LOST = 1e12  # error of a lost run, so that two lost runs are equal


def signed_rank_interval(d: np.ndarray, level: float = 1.0 - ALPHA) -> tuple[float, float, float]:
    """Compute the centre of paired differences and its interval, which belong to the signed-rank test.

    The centre is the median of the means of all pairs of differences [Hodges and Lehmann 1963]. The
    rank sum is taken as normal.

    Args:
        d: Differences, [n].
        level: Coverage.

    Returns:
        Centre and ends of the interval.
    """
    n = d.size
    means = np.sort([(d[i] + d[j]) / 2.0 for i in range(n) for j in range(i, n)])
    spread = stats.norm.ppf(0.5 + 0.5 * level) * np.sqrt(n * (n + 1) * (2 * n + 1) / 24.0)
    k = max(int(np.floor(n * (n + 1) / 4.0 - spread)), 1)
    return float(np.median(means)), float(means[k - 1]), float(means[-k])


class Comparison(NamedTuple):
    """A particle filter and all Kalman filters of a condition.

    Attributes:
        closest: Kalman filter to which the ratio is largest.
        ratio: Centre over runs of the error divided by that of the closest Kalman filter.
        low: Lower end of its 95 % interval.
        high: Upper end.
        p: Largest p-value over the Kalman filters, 1 if one of them has smaller errors.
    """

    closest: str
    ratio: float
    low: float
    high: float
    p: float


def compare_with_all(errors: pd.DataFrame, label: str, kalman: Sequence[str]) -> Comparison:
    """Compare a filter with several others on paired runs.

    Args:
        errors: Error of each run by filter, NaN for a lost run.
        label: Filter.
        kalman: The others.
    """
    logs = np.log(errors.fillna(LOST))
    differences = {name: (logs[label] - logs[name]).to_numpy() for name in kalman}
    centres = {name: signed_rank_interval(d) for name, d in differences.items()}
    p = max(
        wilcoxon_signed_rank(d)[1] if centres[n][0] < 0.0 else 1.0 for n, d in differences.items()
    )
    closest = max(kalman, key=lambda name: centres[name][0])
    ratio, low, high = (float(np.exp(value)) for value in centres[closest])
    return Comparison(closest, ratio, low, high, float(p))


def describe_comparison(label: str, found: Comparison) -> str:
    """State the ratio of a filter to the closest Kalman filter.

    Args:
        label: Filter.
        found: Comparison with all Kalman filters.
    """
    return f"`{label}` {found.ratio:.2f} [{found.low:.2f}, {found.high:.2f}] of `{found.closest}`"
