"""Statistics: Wilcoxon's test, Holm's correction and log ratios against other implementations."""

import numpy as np
import pytest
from statsmodels.stats.multitest import multipletests

from pfbench.stats import comparison, rank_tests


def test_demsar_example():
    # Demsar 2006, table 2: AUC of C4.5 and C4.5+m on 14 data sets; T = 12 with the rank of the tie split.
    plain = [
        0.763,
        0.599,
        0.954,
        0.628,
        0.882,
        0.936,
        0.661,
        0.583,
        0.775,
        1.000,
        0.940,
        0.619,
        0.972,
        0.957,
    ]
    other = [
        0.768,
        0.591,
        0.971,
        0.661,
        0.888,
        0.931,
        0.668,
        0.583,
        0.838,
        1.000,
        0.962,
        0.666,
        0.981,
        0.978,
    ]
    statistic, _ = rank_tests.wilcoxon_signed_rank(np.round(np.array(plain) - np.array(other), 3))
    assert statistic == 12.0


@pytest.mark.parametrize("seed", range(3))
def test_holm_is_that_of_statsmodels(seed):
    p = np.random.default_rng(seed).random(12) ** 3
    p[3] = p[7]
    np.testing.assert_allclose(rank_tests.holm(p), multipletests(p, method="holm")[1])


def test_a_lost_run_outranks_any_other():
    a, b = np.zeros(9), np.full(9, 14.0)
    a[0], b[0] = np.inf, 0.0
    d = comparison.subtract_losses(a, b)
    # a wins 8 pairs by a factor of a million and loses one run: that pair holds the largest rank, 9 of 45.
    assert rank_tests.wilcoxon_signed_rank(d).statistic == 9
    assert comparison.subtract_losses(b, a).tolist() == (-d).tolist()


def test_rounding_decides_nothing():
    a = np.linspace(0, 1, 30)
    # in every run the same way, but less than single precision tells
    assert rank_tests.wilcoxon_signed_rank(comparison.subtract_losses(a, a + 1e-7)).p == 1.0
    assert rank_tests.wilcoxon_signed_rank(comparison.subtract_losses(a, a + 1e-5)).p < 1e-5
