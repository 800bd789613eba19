"""Rank tests against scipy, statsmodels and numbers that R prints, and a filter against itself."""

import numpy as np
import pytest
import torch
from scipy import stats
from statsmodels.stats.multitest import multipletests

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import ParticleFilter, run_filter
from pfbench.model.linear_gaussian import linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation
from pfbench.stats import comparison, rank_tests

# R 4, ?wilcox.test: depression of nine patients at two visits [Hollander, Wolfe 1973, p. 29]
FIRST = np.array([1.83, 0.50, 1.62, 2.48, 1.68, 1.88, 1.55, 3.06, 1.30])
SECOND = np.array([0.878, 0.647, 0.598, 2.05, 1.06, 1.29, 1.06, 3.14, 1.29])


def test_wilcoxons_test_is_that_of_r() -> None:
    """wilcox.test(x, y, paired = TRUE, alternative = "greater"): V = 40, p-value = 0.01953, which is exact."""
    statistic, p = rank_tests.wilcoxon_signed_rank(FIRST - SECOND)
    assert statistic in (40.0, 45.0 - 40.0)
    assert p / 2 == pytest.approx(0.01953, abs=5e-6)


@pytest.mark.slow
def test_a_filter_under_two_names_beats_itself_as_seldom_as_alpha() -> None:
    """Two sets of draws on the same worlds, 2000 studies of 15 paired runs each; with other numbers it does win."""
    studies, size, steps, alpha = 2000, 15, 10, 0.05
    runs = torch.arange(studies * size)
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelSimulation(model, steps).draw(NominalNoise(), runs, 1)
    truth = model.assemble(episode.truth)

    def loss(seed: int, particles: int) -> np.ndarray:
        estimate = run_filter(
            ParticleFilter(particles), model, episode.record, PhiloxStream(seed, runs)
        )
        return (
            (estimate.mean - truth)[..., 0].square().mean(1).sqrt().numpy().reshape(studies, size)
        )

    def share_of_wins(a: np.ndarray, b: np.ndarray) -> float:
        return float(
            np.mean(
                [
                    rank_tests.wilcoxon_signed_rank(d)[1] <= alpha
                    for d in comparison.subtract_losses(np.log(a), np.log(b))
                ]
            )
        )

    one, other, poor = loss(1, 20), loss(2, 20), loss(3, 4)
    error = 4 * np.sqrt(alpha * (1 - alpha) / studies)
    assert share_of_wins(one, other) == pytest.approx(alpha, abs=error)
    assert share_of_wins(one, poor) > 0.5


@pytest.mark.parametrize("alternative", ["two-sided", "greater", "less"])
@pytest.mark.parametrize("n", [1, 2, 7, 13, 14, 40, 50, 51, 90])
def test_signed_rank_tests_of_many_pairs_are_those_of_scipy(n, alternative):
    rng = np.random.default_rng(n)
    d = rng.normal(0.3, 1, (9, n))
    d[3:6] = np.round(d[3:6], 1)  # some ties and zeros
    d[6:] = np.round(d[6:])  # many
    statistic, p = rank_tests.wilcoxon_signed_rank_rows(d, alternative)
    # scipy permutes ties of few differences, for seconds: one row without and one with ties
    checked = (0, {"two-sided": 3, "greater": 6, "less": 4}[alternative]) if n == 13 else range(9)
    for k, (row, t, value) in enumerate(zip(d, statistic, p, strict=True)):
        if row.any() and k in checked:
            expected = stats.wilcoxon(row, alternative=alternative, zero_method="zsplit")
            assert (t, value) == pytest.approx((expected.statistic, expected.pvalue), rel=1e-11)
        assert rank_tests.wilcoxon_signed_rank(row, alternative) == (
            t,
            value,
        )  # alone as among others
    assert rank_tests.wilcoxon_signed_rank(np.zeros(n))[1] == 1


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
    assert rank_tests.wilcoxon_signed_rank(d)[0] == 9
    assert comparison.subtract_losses(b, a).tolist() == (-d).tolist()


def test_rounding_decides_nothing():
    a = np.linspace(0, 1, 30)
    # in every run the same way, but less than single precision tells
    assert rank_tests.wilcoxon_signed_rank(comparison.subtract_losses(a, a + 1e-7))[1] == 1.0
    assert rank_tests.wilcoxon_signed_rank(comparison.subtract_losses(a, a + 1e-5))[1] < 1e-5


def test_the_probabilities_of_the_posterior_are_shares_of_studies() -> None:
    """600 studies of 20 runs, whose effects are uniform: of those with a probability p a share p has the effect."""
    rng, margin = np.random.default_rng(5), 0.05
    effects = rng.uniform(-0.25, 0.25, 600)
    data = effects[:, None] + 0.3 * rng.standard_normal((600, 20))
    stated = np.array([rank_tests.weigh_regions(d, margin) for d in data])
    is_so = np.stack([effects < -margin, np.abs(effects) <= margin, effects > margin], 1)
    error = 4 * np.sqrt(0.25 / 600)
    assert stated.mean(0) == pytest.approx(is_so.mean(0), abs=error)
    sure, tends = stated[:, 0] > 0.8, (stated[:, 0] > 0.5) & (stated[:, 0] < 0.9)
    for some in (sure, tends):
        share = is_so[some, 0].mean()
        assert stated[some, 0].mean() == pytest.approx(share, abs=4 * np.sqrt(0.25 / some.sum()))
    # of equal filters: the wider the region, the more of the posterior is in it
    widths = [rank_tests.weigh_regions(0.3 * rng.standard_normal(20), m)[1] for m in (0.0, 10.0)]
    assert widths == [pytest.approx(0.0, abs=0.02), 1.0]
