"""The table of metrics, the status of runs, and signed-rank tests of many pairs at once."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic_results as synthetic
from scipy import stats

from pfbench.claims import schema
from pfbench.report import tables
from pfbench.results import conditions, frame, metrics, status, store
from pfbench.results.consistency import compute_consistency
from pfbench.results.statistics import signed_rank


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    synthetic.study(root / "demo", runs=8, steps=20)
    return root


def test_one_entry_adds_a_metric_to_the_frame_the_tables_and_the_definitions(results, monkeypatch):
    def final_error(data):
        last = data.select("error")[:, -1]
        return {"norm": np.where(data.lost, np.inf, np.linalg.norm(last, axis=-1))}

    entry = metrics.Metric(
        "final_error",
        final_error,
        "components",
        metrics.GROUP_UNIT,
        "lower",
        "Error at the last step.",
        head="final error",
    )
    monkeypatch.setattr(metrics, "METRICS", (*metrics.METRICS, entry))
    rows = frame.load_frame("demo", results).query("metric == 'final_error'")
    assert set(rows.group) == {"attitude", "velocity", "position"}
    assert set(rows[rows.group == "attitude"].unit) == {"arcmin"}
    assert np.isinf(rows.value[rows.lost]).all()
    (condition,) = conditions.load_conditions("demo", results)
    table = tables.accuracy_table(
        {job.label: job.load() for job in condition.jobs}, "position"
    ).set_index("filter")
    mean = rows[(rows.group == "position") & (rows.label == "sir") & ~rows.lost].value.mean()
    assert table.loc["sir", "final error [m]"] == pytest.approx(mean)
    assert "final error: Error at the last step." in metrics.metric_definitions()


def test_the_table_of_metrics_is_complete():
    names = [metric.name for metric in metrics.METRICS]
    assert len(names) == len(set(names))
    assert set(names) <= set(schema.METRICS)
    for metric in metrics.METRICS:
        assert metric.direction in ("lower", "higher", "target"), metric.name
        assert metric.caption.endswith("."), metric.name


@pytest.mark.parametrize("alternative", ["two-sided", "greater", "less"])
@pytest.mark.parametrize("n", [1, 2, 7, 13, 14, 40, 50, 51, 90])
def test_signed_rank_tests_of_many_pairs_are_those_of_scipy(n, alternative):
    rng = np.random.default_rng(n)
    d = rng.normal(0.3, 1, (9, n))
    d[3:6] = np.round(d[3:6], 1)  # some ties and zeros
    d[6:] = np.round(d[6:])  # many
    statistic, p = signed_rank.wilcoxon_signed_rank_rows(d, alternative)
    permuted = n == 13  # scipy permutes ties of few differences: one row of each kind is enough
    for k, (row, t, value) in enumerate(zip(d, statistic, p, strict=True)):
        if row.any() and not (permuted and k % 3):
            expected = stats.wilcoxon(row, alternative=alternative, zero_method="zsplit")
            assert (t, value) == pytest.approx((expected.statistic, expected.pvalue), rel=1e-11)
        assert signed_rank.wilcoxon_signed_rank(row, alternative) == (
            t,
            value,
        )  # alone as among others
    assert signed_rank.wilcoxon_signed_rank(np.zeros(n)).p == 1


def test_equivalence_of_many_pairs_is_that_of_each():
    d = np.random.default_rng(0).normal(0.0, 0.1, (5, 20))
    each = [signed_rank.equivalence_p_value(row, 0.05) for row in d]
    assert signed_rank.equivalence_p_values(d, 0.05).tolist() == each


def test_a_run_is_diverged_if_its_error_exceeds_the_threshold_in_a_tenth_of_the_steps_or_at_the_end():
    error = np.zeros((7, 21, 2))
    error[0, 2:4] = 100.0  # 2 of 21 steps
    error[1, -1] = 100.0
    error[2, -2], error[2, -1] = 100.0, np.nan  # the last step has no truth
    error[3] = np.nan
    error[4] = 100.0
    error[5, 2:5] = 100.0  # 3 of 21 steps
    error[6, 2:4], error[6, 4:12] = 100.0, np.nan  # 2 of 13 steps with truth
    lost = np.arange(7) == 4
    diverged = status.is_diverged(error, lost, 50.0)
    assert diverged.tolist() == [False, True, True, False, False, True, True]


def test_a_scenario_without_a_threshold_has_no_diverged_runs_but_a_dash(results):
    (condition,) = conditions.load_conditions("demo", results)
    result = condition.jobs[0].load()
    assert status.count_statuses(result.data, result.meta).diverged is None
    assert tables.overview_table({"ekf": result})["diverged runs"].tolist() == ["–"]
    arrays = {**result.data, "error": result.data["error"].copy()}
    arrays["error"][:3, -4:, 6:] = 1e4
    config = {**result.meta["config"], "scenario": {"paper": {"divergence_threshold": 1e3}}}
    far = store.JobResult({**result.meta, "config": config}, arrays)
    count = status.count_statuses(far.data, far.meta)
    assert (count.lost, count.diverged, count.runs) == (0, 3, 8)
    assert tables.overview_table({"ekf": far})["diverged runs"].tolist() == ["3"]


@pytest.mark.parametrize(
    ("factor", "word"), [(1.0, "consistent"), (2.0, "overconfident"), (0.5, "underconfident")]
)
def test_consistency_is_named_by_the_chi_square_limits(factor, word):
    nees = factor * np.random.default_rng(1).chisquare(3, (60, 40))
    lost = np.zeros(60, dtype=bool)
    assert status.classify_consistency(compute_consistency(nees, lost, 3), 3) == word
    assert status.classify_consistency(compute_consistency(nees, ~lost, 3), 3) == ""
