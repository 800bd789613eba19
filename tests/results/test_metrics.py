"""Closed forms of the measures, and what becomes of lost runs and missing truth."""

import numpy as np
import pytest

from pfbench.results import status
from pfbench.stats import error_measures

NONE = np.zeros(4, dtype=bool)


def test_constant_error_is_its_own_rmse():
    error = np.broadcast_to([3.0, -4.0], (4, 6, 2))
    np.testing.assert_allclose(error_measures.rmse_per_run(error, NONE), 5.0)
    np.testing.assert_allclose(error_measures.max_error(error, NONE), 5.0)


def test_norm_is_the_components_together():
    error = np.random.default_rng(0).standard_normal((5, 7, 3)) * [1.0, 2.0, 3.0]
    lost = np.zeros(5, dtype=bool)
    each = [error_measures.rmse_per_run(error[..., [k]], lost) for k in range(3)]
    np.testing.assert_allclose(
        error_measures.rmse_per_run(error, lost), np.sqrt(np.sum(np.square(each), axis=0))
    )


def test_gaussian_errors_give_their_standard_deviation():
    n, sd = 40_000, 2.0
    error = sd * np.random.default_rng(1).standard_normal((1, n, 1))
    (found,) = error_measures.rmse_per_run(error, np.zeros(1, dtype=bool))
    # The standard error of a sample standard deviation is sd / sqrt(2 n); five of them.
    assert found / sd == pytest.approx(1.0, abs=5 / np.sqrt(2 * n))


def test_a_lost_run_is_infinite_and_has_no_mean():
    error = np.ones((4, 6, 1))
    error[2, 3:] = np.nan
    lost = np.array([False, False, True, False])
    np.testing.assert_array_equal(np.isinf(error_measures.rmse_per_run(error, lost)), lost)
    np.testing.assert_array_equal(np.isinf(error_measures.max_error(error, lost)), lost)
    np.testing.assert_array_equal(np.isnan(error_measures.mean_per_run(error[..., 0], lost)), lost)


def test_padding_of_a_short_flight_has_no_weight():
    error = np.random.default_rng(2).standard_normal((3, 8, 2))
    padded = np.concatenate([error, np.full((3, 5, 2), np.nan)], axis=1)
    lost = np.zeros(3, dtype=bool)
    for measure in (error_measures.rmse_per_run, error_measures.max_error):
        np.testing.assert_allclose(measure(padded, lost), measure(error, lost), rtol=1e-14)
    empty = np.where(np.arange(3)[:, None, None] == 0, np.nan, error)
    assert np.isnan(error_measures.rmse_per_run(empty, lost)).tolist() == [True, False, False]


def test_single_precision_does_not_overflow():
    error = np.full((2, 3, 2), 3e30, np.float32)
    found = error_measures.rmse_per_run(error, np.zeros(2, dtype=bool))
    np.testing.assert_allclose(found, 3e30 * np.sqrt(2))


def test_convergence_is_the_last_entry():
    time = np.array([10.0, 20.0, 30.0, 40.0])
    error = np.array(
        [[5, 1, 5, 1], [1, 1, 1, 1], [1, 1, 1, 5], [5, 1, 1, np.nan], [np.nan] * 4, [1, 1, 1, 1]]
    )[..., None]
    lost = np.array([False] * 5 + [True])
    found = error_measures.convergence_time(time, error, lost, 2.0)
    np.testing.assert_array_equal(found, [40.0, 10.0, np.inf, 20.0, np.nan, np.inf])


def test_a_run_is_severely_overconfident_where_its_error_is_ten_of_its_own_sigmas_on_the_average():
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
