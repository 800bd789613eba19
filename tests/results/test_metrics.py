"""Closed forms of the measures, and what becomes of lost runs and missing truth."""

from typing import Any

import numpy as np
import pytest

from pfbench.results import status
from pfbench.results.metrics import MetricInput, compute_metric, mean_trace
from pfbench.results.store import JobResult
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


NAN = np.nan


def told(**arrays: Any) -> JobResult:
    """Three runs of four steps, the last one lost, of a filter of ten particles."""
    meta = {
        "particles": 10, "is_exact": True, "seconds": {"per_step": 2e-3}, "memory": 3 * 2**20, "likelihoods_per_step": 12.5,
        "state": {"groups": {"state": [0]}, "names": ["x"], "units": [""]},
    }  # fmt: skip
    common = {
        "lost": np.array([False, False, True]),
        "nees": np.ones((3, 4, 1)),
        "log_evidence": np.array([-1.0, -3.0, -np.inf]),
    }
    return JobResult(meta, common | {name: np.array(value) for name, value in arrays.items()})


HIT = [[True, False, True, False], [False, True, False, False], [True, True, True, True]]


def test_ancestors_are_counted_at_refreshes_of_runs_that_are_left() -> None:
    result = told(
        resampled=HIT,
        ancestors=[[4, 10, 6, 10], [10, 8, 10, 10], [1, 1, 1, 1]],
        ess=np.full((3, 4), 5.0),
    )
    assert mean_trace(result, "ancestors")[:2].tolist() == [0.5, 0.8]
    assert np.isnan(mean_trace(result, "ancestors")[2])
    assert mean_trace(result, "unique")[:2].tolist() == [0.5, 0.8]  # nothing moved
    assert np.isnan(mean_trace(result, "iterations")).all()
    ess = compute_metric("ess", MetricInput(result))[""]
    assert ess[:2].tolist() == [0.5, 0.5]


def test_the_innovations_are_per_observed_component() -> None:
    nis, dof = [[2.0, 0.0], [5.0, 3.0], [900.0, 900.0]], [[2, 0], [2, 2], [2, 2]]
    values = compute_metric("nis", MetricInput(told(nis=nis, nis_dof=dof)))[""]
    assert values[:2].tolist() == pytest.approx([2 / 2, 8 / 4])


def test_what_no_filter_tells_has_no_value() -> None:
    moving = told(resampled=HIT, accepted_0=[[0.5, 0, 0.3, 0], [0, 0.2, 0, 0], [1, 1, 1, 1]])
    values = compute_metric("accepted", MetricInput(moving))[""]
    assert values[:2].tolist() == pytest.approx([0.4, 0.2])
    for name in ("accepted", "nis"):
        assert not np.isfinite(compute_metric(name, MetricInput(told())).get("", NAN)).any()


def test_fixes_are_counted_over_the_run_and_a_filter_without_evidence_shows_none() -> None:
    gated = told(rejected=[[0, 1, 0, 1], [2, 0, 0, 2], [9, 9, 9, 9]])
    gated.meta["has_evidence"] = False
    assert compute_metric("log_evidence", MetricInput(gated)) == {}
    assert compute_metric("log_evidence", MetricInput(told()))[""].tolist()[:2] == [-1.0, -3.0]
    assert compute_metric("rejected", MetricInput(gated))[""].tolist()[:2] == [2.0, 4.0]


def test_a_floor_stands_beside_an_evidence_and_nowhere_else() -> None:
    floored = told(evidence_floor=[-2.0, -2.5, -9.0])
    values = compute_metric("log_evidence_floor", MetricInput(floored))[""]
    assert values.tolist() == pytest.approx([-2.0, -2.5, NAN], nan_ok=True)
    assert compute_metric("log_evidence_floor", MetricInput(told())) == {}
    floored.meta["has_counts"] = True
    assert compute_metric("log_evidence_floor", MetricInput(floored)) == {}
