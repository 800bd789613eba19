"""Closed forms of the measures, and what becomes of lost runs and missing truth."""

import numpy as np
import pytest
from scipy import stats

from pfbench.results import consistency, error_measures, status

NONE = np.zeros(4, dtype=bool)


def test_constant_error_is_its_own_rmse():
    error = np.broadcast_to([3.0, -4.0], (4, 6, 2))
    assert error_measures.rmse_norm(error, NONE).value == pytest.approx(5.0)
    assert error_measures.rmse_run_mean(error, NONE).value == pytest.approx(5.0)
    np.testing.assert_allclose(error_measures.rmse_component(error, NONE).value, [3.0, 4.0])
    np.testing.assert_allclose(error_measures.rmse_per_run(error, NONE), 5.0)
    np.testing.assert_allclose(error_measures.max_error(error, NONE), 5.0)


def test_the_three_definitions_differ_as_they_should():
    # Two runs of constant error 1 and 7: quadratic mean 5, arithmetic mean 4.
    error = np.array([1.0, 7.0])[:, None, None] * np.ones((2, 9, 1))
    lost = np.zeros(2, dtype=bool)
    assert error_measures.rmse_norm(error, lost).value == pytest.approx(5.0)
    assert error_measures.rmse_component(error, lost).value == pytest.approx(5.0)
    assert error_measures.rmse_run_mean(error, lost).value == pytest.approx(4.0)


def test_norm_is_the_components_together():
    error = np.random.default_rng(0).standard_normal((5, 7, 3)) * [1.0, 2.0, 3.0]
    lost = np.zeros(5, dtype=bool)
    each = error_measures.rmse_component(error, lost).value
    assert error_measures.rmse_norm(error, lost).value == pytest.approx(np.sqrt(np.sum(each**2)))
    # Quadratic mean is never below the arithmetic mean.
    assert (
        error_measures.rmse_norm(error, lost).value
        >= error_measures.rmse_run_mean(error, lost).value
    )


def test_gaussian_errors_give_their_standard_deviation():
    n, sd = 40_000, np.array([0.5, 2.0])
    error = np.random.default_rng(1).standard_normal((n // 100, 100, 2)) * sd
    found = error_measures.rmse_component(error, np.zeros(n // 100, dtype=bool)).value
    # The standard error of a sample standard deviation is sd / sqrt(2 n); five of them.
    np.testing.assert_allclose(found / sd, 1.0, atol=5 / np.sqrt(2 * n))


def test_a_lost_run_is_counted_and_never_averaged():
    error = np.ones((4, 6, 1))
    error[2, 3:] = np.nan
    lost = np.array([False, False, True, False])
    assert error_measures.rmse_norm(error, lost) == (1.0, 3)
    assert error_measures.rmse_run_mean(error, lost) == (1.0, 3)
    assert error_measures.rmse_component(error, lost).runs == 3
    np.testing.assert_array_equal(np.isinf(error_measures.rmse_per_run(error, lost)), lost)
    np.testing.assert_array_equal(np.isinf(error_measures.max_error(error, lost)), lost)
    np.testing.assert_array_equal(np.isnan(error_measures.mean_per_run(error[..., 0], lost)), lost)
    assert status.lost_fraction(lost) == (0.25, 4)
    nobody = error_measures.rmse_norm(error, np.ones(4, dtype=bool))
    assert np.isnan(nobody.value)
    assert nobody.runs == 0


def test_padding_of_a_short_flight_has_no_weight():
    rng = np.random.default_rng(2)
    error = rng.standard_normal((3, 8, 2))
    padded = np.concatenate([error, np.full((3, 5, 2), np.nan)], axis=1)
    lost = np.zeros(3, dtype=bool)
    for measure in (
        error_measures.rmse_norm,
        error_measures.rmse_run_mean,
        error_measures.rmse_component,
    ):
        np.testing.assert_allclose(
            measure(padded, lost).value, measure(error, lost).value, rtol=1e-14
        )
    np.testing.assert_allclose(
        error_measures.max_error(padded, lost), error_measures.max_error(error, lost)
    )
    one = error_measures.rmse_norm(np.where(np.arange(3)[:, None, None] == 0, np.nan, error), lost)
    assert one.runs == 2
    np.testing.assert_allclose(one.value, error_measures.rmse_norm(error[1:], lost[1:]).value)


def test_single_precision_does_not_overflow():
    error = np.full((2, 3, 2), 3e30, np.float32)
    assert error_measures.rmse_norm(error, np.zeros(2, dtype=bool)).value == pytest.approx(
        3e30 * np.sqrt(2)
    )


@pytest.mark.parametrize(("dof", "runs"), [(1, 1), (3, 20), (6, 100)])
def test_band_holds_the_average_as_often_as_it_says(dof, runs):
    n, alpha = 20_000, 0.05
    nees = np.random.default_rng(3).chisquare(dof, (runs, n))
    found = consistency.compute_consistency(nees, np.zeros(runs, dtype=bool), dof, alpha)
    assert found.inside == pytest.approx(1 - alpha, abs=5 * np.sqrt(alpha * (1 - alpha) / n))
    assert found.mean == pytest.approx(dof, abs=5 * np.sqrt(2 * dof / (runs * n)))
    low, high = consistency.nees_band(dof, runs, alpha)
    # Equal tails, in the same units as the average.
    assert stats.chi2.cdf(low * runs, dof * runs) == pytest.approx(alpha / 2)
    assert stats.chi2.sf(high * runs, dof * runs) == pytest.approx(alpha / 2)


def test_band_of_bar_shalom():
    # Bar-Shalom, Li, Kirubarajan 2001, section 5.4.2: 50 runs, 2 states, 95 %: [1.5, 2.6].
    low, high = consistency.nees_band(2, 50)
    assert (round(float(low), 1), round(float(high), 1)) == (1.5, 2.6)


def test_band_widens_where_runs_end():
    nees = np.ones((10, 4))
    nees[3:, 2:] = np.nan
    nees[:, 3] = np.nan
    found = consistency.compute_consistency(nees, np.zeros(10, dtype=bool), 1)
    np.testing.assert_array_equal(found.runs_at, [10, 10, 3, 0])
    assert found.high[2] > found.high[0]
    assert np.isnan(found.average[3])
    assert found.inside == 1.0
    assert found.runs == 10


def test_convergence_is_the_last_entry():
    time = np.array([10.0, 20.0, 30.0, 40.0])
    error = np.array(
        [[5, 1, 5, 1], [1, 1, 1, 1], [1, 1, 1, 5], [5, 1, 1, np.nan], [np.nan] * 4, [1, 1, 1, 1]]
    )[..., None]
    lost = np.array([False] * 5 + [True])
    found = error_measures.convergence_time(time, error, lost, 2.0)
    np.testing.assert_array_equal(found, [40.0, 10.0, np.inf, 20.0, np.nan, np.inf])


def test_a_run_is_diverged_where_its_error_is_ten_of_its_own_sigmas_on_the_average():
    nees = np.full((4, 10, 2), 3.0)
    nees[1, :, 1] = 299.0  # below 100 x 3
    nees[2, :, 1] = 301.0
    nees[3] = 1e6
    nees[2, :5, 1] = np.nan  # instants without truth do not count
    nees[2, 5:, 1] = 301.0
    lost = np.array([False, False, False, True])
    assert status.is_severely_overconfident(nees, (3, 3), lost).tolist() == [
        False,
        False,
        True,
        False,
    ]
