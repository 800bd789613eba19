"""Trimmed means with influence values, worlds and label flips against hand examples and oracles."""

import warnings
from itertools import product

import numpy as np
import pytest
from scipy import stats

from pfbench.stats.effects import (
    WorldEffects,
    combine_conditions,
    common_variance,
    estimate_in_new_world,
    estimate_in_these_worlds,
    is_identical,
    order_failed_runs,
    paired_log_ratio,
    prediction_interval,
    trimmed_effects,
)
from pfbench.stats.rank_tests import flip_p_value, run_contributions

SAMPLE = np.array([40.0, 1.0, 2.0, 8.0, 4.0, 5.0, -5.0, 7.0, 3.0, 6.0])


def worlds_of(d, weights=None):
    weights = np.full(d.shape[-3:-1], 1 / d.shape[-2]) if weights is None else weights
    return combine_conditions(trimmed_effects(d), weights)


def test_yuen_by_hand():
    """Middle 2 to 7, winsorised sum of squares 42.5, squared error 42.5 / (6 * 5)."""
    effects = trimmed_effects(SAMPLE)
    assert effects.location == 4.5
    assert effects.middle == 6
    estimate = estimate_in_these_worlds(worlds_of(SAMPLE[None, None]))
    assert estimate.standard_error**2 == pytest.approx(42.5 / 30, rel=1e-12)
    assert estimate.df == 5
    t = 4.5 / np.sqrt(42.5 / 30)
    assert estimate.p == pytest.approx(2 * stats.t.sf(t, 5), rel=1e-12)
    half = stats.t.ppf(0.975, 5) * np.sqrt(42.5 / 30)
    assert estimate.interval(0.05) == pytest.approx((4.5 - half, 4.5 + half), rel=1e-12)


def test_without_trimming_it_is_the_t_test():
    effects = combine_conditions(trimmed_effects(SAMPLE[None, None], 0.0), np.ones((1, 1)))
    expected = stats.ttest_1samp(SAMPLE, 0.0)
    assert estimate_in_these_worlds(effects).p == pytest.approx(expected.pvalue, rel=1e-12)


def test_absent_runs_change_nothing():
    padded = np.insert(SAMPLE, [0, 3, 10], np.nan)
    assert trimmed_effects(padded).location == trimmed_effects(SAMPLE).location
    parts = trimmed_effects(padded).parts
    assert np.array_equal(parts[~np.isnan(padded)], trimmed_effects(SAMPLE).parts)
    assert not parts[np.isnan(padded)].any()


def test_influence_is_the_derivative_of_the_location():
    """A small shift of one run in the middle changes the location by its influence value / n."""
    rng = np.random.default_rng(0)
    d = rng.standard_normal(20_001)
    effects = trimmed_effects(d)
    step = d.size * effects.parts  # influence values
    x = np.linspace(-2, 2, 9)
    low, high = np.quantile(d, [0.2, 0.8])
    expected = (np.clip(x, low, high) - np.clip(d, low, high).mean()) / 0.6
    assert np.interp(x, np.sort(d), step[np.argsort(d)]) == pytest.approx(expected, abs=0.01)


def test_lost_runs_lie_at_the_ends():
    a, b = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 2.0, 3.0 + 1e-9, 1.0])
    keeps_a, keeps_b = np.array([True, False, True, False]), np.array([True, True, True, False])
    d = paired_log_ratio(a, b, keeps_a, keeps_b)
    assert d.tolist() == [pytest.approx(np.log(0.5)), np.inf, 0.0, 0.0]
    assert order_failed_runs(np.ones(1), np.array([True]), np.array([False])) == -np.inf
    twenty = np.sort(np.random.default_rng(1).standard_normal(20))
    for lost in (4, 5):
        d = np.where(np.arange(20) >= 20 - lost, np.inf, twenty)
        assert np.isfinite(trimmed_effects(d).location) == (lost == 4)
    both = np.where(np.arange(20) < 6, -np.inf, np.where(np.arange(20) > 13, np.inf, twenty))
    assert np.isnan(trimmed_effects(both).location)


def test_an_early_stop_is_not_a_small_error():
    keeps = np.array([True, False])
    d = paired_log_ratio(np.array([1.0, 1e-9]), np.ones(2), keeps, np.ones(2, dtype=bool))
    assert d[1] == np.inf


def test_identical_filters():
    assert is_identical(np.array([0.0, 1e-7, np.nan]))
    assert not is_identical(np.array([0.0, 1e-5]))


def test_runs_are_added_by_key():
    """Regimes with the same runs count once: two copies of a regime give the error of one."""
    d = np.random.default_rng(2).standard_normal((1, 1, 30))
    twice = np.repeat(d, 2, axis=1)
    one, two = (estimate_in_these_worlds(worlds_of(x)) for x in (d, twice))
    assert two.standard_error == pytest.approx(one.standard_error, rel=1e-12)
    apart = np.full((1, 2, 60), np.nan)
    apart[0, 0, :30], apart[0, 1, 30:] = d[0, 0], d[0, 0]
    error = estimate_in_these_worlds(worlds_of(apart)).standard_error
    assert error == pytest.approx(one.standard_error / np.sqrt(2), rel=1e-12)


def test_worlds_share_runs_or_do_not():
    d = np.random.default_rng(3).standard_normal((1, 1, 30))
    copies = np.repeat(d, 4, axis=0)
    one = estimate_in_these_worlds(worlds_of(d))
    shared, separate = (estimate_in_these_worlds(worlds_of(copies), flag) for flag in (True, False))
    assert shared.standard_error == pytest.approx(one.standard_error, rel=1e-12)
    assert separate.standard_error == pytest.approx(one.standard_error / 2, rel=1e-12)
    assert separate.df == pytest.approx(4 * one.df)
    assert common_variance(worlds_of(copies)) == pytest.approx(one.standard_error**2, rel=1e-12)


def test_weights_of_conditions():
    d = np.random.default_rng(4).standard_normal((1, 3, 20))
    weights = np.array([[0.5, 0.25, 0.25]])
    location = trimmed_effects(d).location[0]
    assert worlds_of(d, weights).location == pytest.approx(location @ weights[0])


def test_new_world_is_the_t_test_of_worlds():
    values = np.array([0.1, -0.3, -0.2, -0.5, 0.0])
    worlds = WorldEffects(values, np.zeros((5, 10)), np.full(5, 6))
    assert estimate_in_new_world(worlds).p == pytest.approx(stats.ttest_1samp(values, 0).pvalue)
    mean, sd = values.mean(), values.std(ddof=1)
    half = stats.t.ppf(0.975, 4) * sd * np.sqrt(1 + 1 / 5)
    assert prediction_interval(values, 0.05) == pytest.approx((mean - half, mean + half))
    one = WorldEffects(values[:1], np.zeros((1, 10)), np.full(1, 6))
    assert np.isnan(estimate_in_new_world(one).p)
    assert np.isinf(estimate_in_new_world(one).interval(0.05)).all()


def test_new_world_against_a_mixed_model():
    """In a balanced design the REML error of the mean is the SD of world means / sqrt(W)."""
    from statsmodels.regression.mixed_linear_model import MixedLM

    rng = np.random.default_rng(5)
    cells = 0.4 * rng.standard_normal((8, 1)) + 0.2 * rng.standard_normal((8, 4)) - 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = MixedLM(cells.ravel(), np.ones(32), groups=np.repeat(np.arange(8), 4)).fit(reml=True)
    worlds = WorldEffects(cells.mean(axis=1), np.zeros((8, 30)), np.full(8, 18))
    estimate = estimate_in_new_world(worlds)
    assert estimate.value == pytest.approx(float(fit.params[0]), abs=1e-9)
    assert estimate.standard_error == pytest.approx(float(fit.bse[0]), rel=1e-4)


@pytest.mark.parametrize("step", [0.05, 1.0])
def test_exact_flips_against_enumeration(step):
    x = step * np.array([1, -1, 2, 0, 1, 3, -2, 1, 1, 2])
    signs = np.array(list(product([-1.0, 1.0], repeat=x.size)))
    expected = (np.abs(signs @ x) >= abs(x.sum()) - 1e-9).mean()
    assert flip_p_value(x) == pytest.approx(expected, rel=1e-9)


def test_random_flips_without_a_common_step():
    x = np.random.default_rng(6).standard_normal(12) + 0.5
    signs = np.array(list(product([-1.0, 1.0], repeat=x.size)))
    expected = (np.abs(signs @ x) >= abs(x.sum()) - 1e-9).mean()
    error = np.sqrt(expected * (1 - expected) / 9999)
    assert abs(flip_p_value(x, key="a b") - expected) < 4 * error + 1e-4
    assert flip_p_value(x, key="a b") == flip_p_value(x, key="a b")
    assert flip_p_value(np.zeros(5)) == 1.0


def test_contributions_sum_to_the_mean_difference():
    rng = np.random.default_rng(7)
    d = rng.integers(-1, 2, (3, 2, 15)).astype(float)
    weights = np.full((3, 2), 0.5)
    for shared in (True, False):
        x = run_contributions(d, weights, shared)
        assert x.sum() == pytest.approx(d.mean())
        assert x.size == (15 if shared else 45)
