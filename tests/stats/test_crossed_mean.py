"""Intervals of a mean over two crossed samples and of a median, against scipy and by their coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pfbench.results import crossed_mean_interval, order_statistic_interval


def test_one_row_has_the_interval_of_student() -> None:
    values = np.random.default_rng(1).normal(2.0, 3.0, (1, 12))
    mean, half = crossed_mean_interval(values, 0.9)
    low, high = stats.t.interval(0.9, 11, values.mean(), stats.sem(values[0]))
    assert (mean - half, mean + half) == pytest.approx((low, high))
    assert crossed_mean_interval(np.full((3, 4), 2.0)) == (2.0, 0.0)


def test_the_interval_covers_the_mean_of_both_populations() -> None:
    """Rows alone, as in an interval over columns that forgets the rows, cover far too rarely."""
    rng, studies, rows, columns = np.random.default_rng(2), 2000, 4, 30
    inside, forgets = 0, 0
    for _ in range(studies):
        values = rng.normal(0, 1, (rows, 1)) + rng.normal(0, 1, (1, columns)) + rng.normal(0, 0.3, (rows, columns))  # fmt: skip
        mean, half = crossed_mean_interval(values)
        inside += abs(mean) < half
        forgets += abs(mean) < crossed_mean_interval(values.mean(0, keepdims=True))[1]
    assert inside / studies == pytest.approx(0.95, abs=4 * (0.95 * 0.05 / studies) ** 0.5 + 0.01)
    assert forgets / studies < 0.8


def test_the_interval_of_the_median_covers_as_often_as_it_says() -> None:
    for n in (1, 5, 6, 9, 20, 60):
        low, high, _ = order_statistic_interval(np.arange(n, dtype=float), 0.95)
        if n < 6:  # 1 - 2 / 2^5 < 0.95: no interval of five numbers is wide enough
            assert (low, high) == (-np.inf, np.inf)
            continue
        k = int(low)  # the median is outside when k or fewer signs are one way
        assert high == n - 1 - k
        assert 2 * stats.binom.cdf(k, n, 0.5) <= 0.05 < 2 * stats.binom.cdf(k + 1, n, 0.5)
