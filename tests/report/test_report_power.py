"""What a comparison can show: against other formulas, by simulation, and by how often it is wrong."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.power import TTestPower

from pfbench.stats import rank_tests, study_size


def _p(d):
    """p of the signed-rank test in each row, by the normal law, as for so many runs it is."""
    rank = stats.rankdata(np.abs(d), axis=1)
    n = d.shape[1]
    plus = (rank * (d > 0)).sum(1)
    return 2 * stats.norm.sf(
        np.abs(plus - n * (n + 1) / 4) / np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
    )


@pytest.mark.parametrize(
    ("effect", "alpha"), [(0.3, 0.05), (0.5, 0.05), (0.5, 0.05 / 21), (0.8, 0.05)]
)
def test_the_runs_of_a_t_test_are_those_of_statsmodels(effect, alpha):
    exact = TTestPower().solve_power(effect, alpha=alpha, power=0.8, alternative="two-sided")
    assert study_size.required_runs(effect, alpha, efficiency=1.0) == pytest.approx(
        np.ceil(exact), abs=1
    )
    n = int(np.ceil(exact))
    theirs = TTestPower().power(effect, n, alpha)
    assert study_size.compute_power(effect, n, alpha, efficiency=1.0) == pytest.approx(
        theirs, abs=0.01
    )


@pytest.mark.parametrize("effect", [0.35, 0.6])
def test_the_runs_needed_find_the_effect_as_often_as_said(effect):
    n = int(study_size.required_runs(effect, 0.05))
    trials = 4000
    found = np.mean(_p(effect + np.random.default_rng(1).standard_normal((trials, n))) <= 0.05)
    # The asymptotic efficiency is within two per cent of power at these sizes.
    assert found == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / trials) + 0.02)
    assert study_size.compute_power(effect, n, 0.05) == pytest.approx(found, abs=0.05)


@pytest.mark.parametrize("n", [5, 9, 13, 14, 50, 51, 100])
@pytest.mark.parametrize("digits", [0, 1, 9])  # with many ties and zeros, with some, with none
def test_the_signed_rank_test_is_scipys(n, digits):
    d = np.round(np.random.default_rng(n).normal(0.3, 1, n), digits)
    for side in ("two-sided", "greater"):
        expected = stats.wilcoxon(d, alternative=side, zero_method="zsplit")
        assert rank_tests.wilcoxon_signed_rank(d, side) == pytest.approx(
            (expected.statistic, expected.pvalue), rel=1e-11
        )


def test_needed_runs_and_power_are_one_relation():
    for effect, alpha in ((1.5, 0.05), (0.2, 0.01)):
        n = int(study_size.required_runs(effect, alpha))
        assert (
            study_size.compute_power(effect, n, alpha)
            >= 0.8
            > study_size.compute_power(effect, n - 1, alpha)
        )
    assert study_size.required_runs(0.0) == np.inf
    assert study_size.required_runs(1e9, 0.05) == study_size.min_pairs(0.05) == 6
    assert (
        stats.wilcoxon(np.arange(1.0, 7)).pvalue <= 0.05 < stats.wilcoxon(np.arange(1.0, 6)).pvalue
    )
    assert study_size.compute_power(9.0, 5) == 0.0
