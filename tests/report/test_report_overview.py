"""What filters tell of themselves, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pfbench.results.metrics import MetricInput, compute_metric, mean_trace
from pfbench.results.store import JobResult

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
