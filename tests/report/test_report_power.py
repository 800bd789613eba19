"""What a comparison can show: against other formulas, by simulation, and by how often it is wrong."""

import numpy as np
import pytest
from scipy import stats
from statsmodels.stats.power import TTestPower

from pfbench.results.statistics import effect_sizes, intervals, power, signed_rank


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
    assert power.required_runs(effect, alpha, efficiency=1.0) == pytest.approx(
        np.ceil(exact), abs=1
    )
    n = int(np.ceil(exact))
    theirs = TTestPower().power(effect, n, alpha)
    assert power.compute_power(effect, n, alpha, efficiency=1.0) == pytest.approx(theirs, abs=0.01)


@pytest.mark.parametrize("effect", [0.35, 0.6])
def test_the_runs_needed_find_the_effect_as_often_as_said(effect):
    n = int(power.required_runs(effect, 0.05))
    trials = 4000
    found = np.mean(_p(effect + np.random.default_rng(1).standard_normal((trials, n))) <= 0.05)
    # The asymptotic efficiency is within two per cent of power at these sizes.
    assert found == pytest.approx(0.8, abs=4 * np.sqrt(0.16 / trials) + 0.02)
    assert power.compute_power(effect, n, 0.05) == pytest.approx(found, abs=0.05)


def test_needed_runs_smallest_effect_and_power_are_one_relation():
    for sd, alpha in ((0.2, 0.05), (1.5, 0.01)):
        n = power.required_runs(0.3 / sd, alpha)
        assert (
            power.detectable_effect(sd, int(n), alpha)
            <= 0.3
            < power.detectable_effect(sd, int(n) - 1, alpha)
        )
        assert (
            power.compute_power(0.3 / sd, int(n), alpha)
            >= 0.8
            > power.compute_power(0.3 / sd, int(n) - 1, alpha)
        )
    assert power.required_runs(0.0) == np.inf
    assert power.required_runs(1e9, 0.05) == power.min_pairs(0.05) == 6
    assert (
        stats.wilcoxon(np.arange(1.0, 7)).pvalue <= 0.05 < stats.wilcoxon(np.arange(1.0, 6)).pvalue
    )
    assert power.detectable_effect(1.0, 5) == np.inf
    assert power.compute_power(9.0, 5) == 0.0


@pytest.mark.parametrize(
    ("share", "limit", "alpha"), [(0.15, 0.05, 0.05), (0.7, 0.5, 0.01), (0.3, 0.5, 0.025)]
)
def test_the_runs_of_a_share_find_it_as_often_as_said(share, limit, alpha):
    def exact(n):
        """Power of the exact binomial test."""
        if share > limit:
            return stats.binom.sf(stats.binom.isf(alpha, n, limit), n, share)
        return stats.binom.cdf(stats.binom.ppf(alpha, n, limit) - 1, n, share)

    n = int(power.required_runs_proportion(share, limit, alpha))
    # the exact test is cautious, and its power goes up and down with n
    assert np.mean([exact(k) for k in range(n - 5, n + 6)]) == pytest.approx(0.8, abs=0.06)
    assert power.required_runs_proportion(limit, limit) == np.inf


def test_equivalence_is_shown_within_the_margin_only():
    d = np.linspace(-0.02, 0.02, 21)
    assert signed_rank.equivalence_p_value(d, 0.05) < 1e-4
    assert signed_rank.equivalence_p_value(d + 0.1, 0.05) > 0.99
    assert signed_rank.equivalence_p_value(d, 0.05) == signed_rank.equivalence_p_value(-d, 0.05)
    assert signed_rank.equivalence_p_value(np.zeros(20), 0.05) < 0.001
    assert (
        signed_rank.equivalence_p_value(d[:3], 0.05) > 0.05
    )  # an inconclusive test shows no equivalence
    with pytest.raises(ValueError, match="margin must be positive"):
        signed_rank.equivalence_p_value(d, 0.0)


def test_equivalence_is_claimed_wrongly_as_rarely_as_alpha():
    rng, n, alpha = np.random.default_rng(2), 600, 0.05
    for side in (-1, 1):
        p = [
            signed_rank.equivalence_p_value(0.1 * side + 0.05 * rng.standard_normal(20), 0.1)
            for _ in range(n // 2)
        ]
        assert np.mean(np.array(p) <= alpha) == pytest.approx(
            alpha, abs=4 * np.sqrt(alpha * (1 - alpha) / (n // 2))
        )


def test_intervals_of_the_effects_hold_the_truth():
    rng, n, runs = np.random.default_rng(3), 600, 30
    hits = np.zeros(2)
    spread, shift = np.sqrt(2) * 0.2, 0.15
    # log a - log b of different runs has the common world twice; the mean of two paired differences has not.
    better = stats.norm.cdf(shift / np.hypot(spread, np.sqrt(2) * 0.3))
    smaller = stats.norm.cdf(shift * np.sqrt(2) / spread)
    for _ in range(n):
        a, b = np.exp(0.3 * rng.standard_normal(runs) + 0.2 * rng.standard_normal((2, runs)))
        b = b * np.exp(shift)
        shares = (
            effect_sizes.probability_of_improvement(a, b),
            effect_sizes.rank_biserial_proportion(effect_sizes.log_ratio(a, b)),
        )
        for k, (share, truth) in enumerate(zip(shares, (better, smaller), strict=True)):
            low, high, _ = intervals.proportion_interval(
                share.value, np.var(share.parts, ddof=1) / runs, runs, 0.9
            )
            hits[k] += low <= truth <= high
    # First-order intervals of 30 runs are within a few per cent of their level.
    np.testing.assert_allclose(hits / n, 0.9, atol=4 * np.sqrt(0.09 / n))


def test_probability_of_improvement_by_counting():
    a, b = np.array([1.0, 2.0, np.inf, 4.0]), np.array([2.0, 2.0, 3.0, np.inf])
    won = [(x < y) + 0.5 * (x == y) for x in a for y in b]
    assert effect_sizes.probability_of_improvement(a, b).value == np.mean(won)
    assert effect_sizes.probability_of_improvement(b, a).value == 1 - np.mean(won)
    assert effect_sizes.probability_of_improvement(a, a).value == 0.5
    share = effect_sizes.probability_of_improvement(a, b)
    assert share.parts.mean() == pytest.approx(share.value)
    d = effect_sizes.log_ratio(a, b)
    effect = effect_sizes.rank_biserial_proportion(d)
    assert 2 * effect.value - 1 == pytest.approx(effect_sizes.rank_biserial(d))
    low, high, how = intervals.proportion_interval(1.0, 0.0, 20, 0.95)
    assert (how, high) == ("exact", 1.0)
    assert low == pytest.approx(stats.beta.ppf(0.025, 20, 1))  # Clopper and Pearson


@pytest.mark.parametrize("n", [5, 9, 13, 14, 50, 51, 100])
@pytest.mark.parametrize("digits", [0, 1, 9])  # with many ties and zeros, with some, with none
def test_the_signed_rank_test_is_scipys(n, digits):
    d = np.round(np.random.default_rng(n).normal(0.3, 1, n), digits)
    for side in ("two-sided", "greater"):
        expected = stats.wilcoxon(d, alternative=side, zero_method="zsplit")
        assert signed_rank.wilcoxon_signed_rank(d, side) == pytest.approx(
            (expected.statistic, expected.pvalue), rel=1e-11
        )
    ranks, ties = effect_sizes.rank_with_ties(d)
    np.testing.assert_array_equal(ranks, stats.rankdata(d))
    assert ties.sum() == n
