"""The first table of a cell: what filters tell of themselves, by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from pfbench.report import tables
from pfbench.results.metric_values import MetricInput, mean_trace
from pfbench.results.metrics import compute_metric
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
    row = tables.overview_table({"mine": result}).iloc[0]
    assert row["distinct ancestors [%]"] == pytest.approx(65.0)
    assert row["ESS [% of particles]"] == pytest.approx(50.0)
    assert row["peak memory above baseline [MiB]"] == 3
    assert row["likelihood evaluations per step"] == 12.5


def test_the_innovations_of_all_runs_that_are_left_make_one_chi_square() -> None:
    nis, dof = [[2.0, 0.0], [5.0, 3.0], [900.0, 900.0]], [[2, 0], [2, 2], [2, 2]]
    row = tables.overview_table({"mine": told(nis=nis, nis_dof=dof)}, alpha=0.1).iloc[0]
    assert row["mean NIS per component (expected 1)"] == pytest.approx(10 / 6)
    low, high = (float(part) for part in row["NIS 95 % interval"].split(" to "))
    assert [low, high] == pytest.approx([stats.chi2(6).ppf(q) / 6 for q in (0.05, 0.95)], rel=5e-3)


def test_what_no_filter_tells_has_no_column() -> None:
    moving = told(resampled=HIT, accepted_0=[[0.5, 0, 0.3, 0], [0, 0.2, 0, 0], [1, 1, 1, 1]])
    row = tables.overview_table({"one": told(), "other": moving})
    assert "NIS" not in row
    assert "distinct ancestors [%]" not in row
    assert row["MCMC acceptance [%]"].tolist()[1] == pytest.approx(100 * (0.4 + 0.2) / 2)
    assert np.isnan(row["MCMC acceptance [%]"].tolist()[0])


def test_fixes_are_counted_over_the_run_and_a_filter_without_evidence_shows_none() -> None:
    gated = told(rejected=[[0, 1, 0, 1], [2, 0, 0, 2], [9, 9, 9, 9]])
    gated.meta["has_evidence"] = False
    table = tables.overview_table({"plain": told(), "gated": gated})
    assert table["rejected fixes"].tolist()[1] == pytest.approx(3.0)
    assert np.isnan(table["rejected fixes"].tolist()[0])
    assert "downweighted fixes" not in table
    assert table["log evidence"].tolist()[0] == pytest.approx(-2.0)
    assert np.isnan(table["log evidence"].tolist()[1])
    assert compute_metric("log_evidence", MetricInput(gated)) == {}
    assert compute_metric("log_evidence", MetricInput(told()))[""].tolist()[:2] == [-1.0, -3.0]
    assert compute_metric("rejected", MetricInput(gated))[""].tolist()[:2] == [2.0, 4.0]
