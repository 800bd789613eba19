"""The table of metrics, the status of runs, and signed-rank tests of many pairs at once."""

import numpy as np
import pytest
import synthetic_results as synthetic

from pfbench.report.study_report import summarise_metrics
from pfbench.results import conditions, frame, metrics, status, store
from pfbench.results.conditions import component_groups


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    synthetic.study(root / "demo", runs=8, steps=20)
    return root


def test_probabilities_of_counts_are_not_compared_with_densities(results):
    """A model of counts has another metric: no row of it stands beside a log evidence."""
    (condition,) = conditions.load_conditions("demo", results)
    job = next(job.load() for job in condition.jobs if job.label == "sir")
    names = ("log_evidence", "log_score", "log_probability")
    for has_counts, present in ((None, names[:2]), (False, names[:2]), (True, names[2:])):
        result = job._replace(meta={**job.meta, "has_counts": has_counts})
        data = metrics.data_by_scope(result, "job")[0]
        found = [m.name for m in metrics.METRICS if m.name in names and m.compute(data)]
        assert tuple(found) in (present, tuple(reversed(present)))
        values = next(m for m in metrics.METRICS if m.name == present[0]).compute(data)[""]
        np.testing.assert_array_equal(
            values, np.where(job.data["lost"], np.nan, job.data["log_evidence"])
        )


def test_the_table_of_metrics_is_complete():
    names = [metric.name for metric in metrics.METRICS]
    assert len(names) == len(set(names))
    for metric in metrics.METRICS:
        assert metric.direction in ("lower", "higher", "target"), metric.name
        assert metric.caption.endswith("."), metric.name


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


def test_a_scenario_without_a_threshold_has_no_diverged_runs(results):
    (condition,) = conditions.load_conditions("demo", results)
    result = condition.jobs[0].load()
    assert status.count_statuses(result.data, result.meta).diverged is None
    arrays = {**result.data, "error": result.data["error"].copy()}
    arrays["error"][:3, -4:, 6:] = 1e4
    config = {**result.meta["config"], "scenario": {"paper": {"divergence_threshold": 1e3}}}
    far = store.JobResult({**result.meta, "config": config}, arrays)
    count = status.count_statuses(far.data, far.meta)
    assert (count.lost, count.diverged, count.runs) == (0, 3, 8)


def test_the_summary_is_that_of_the_valid_runs(results):
    table = frame.load_frame("demo", results)
    summary = summarise_metrics(table)
    keys = ["scenario", "noise", "model", "filter", "group", "component", "metric"]
    assert not summary.duplicated(keys).any()
    row = summary.set_index(keys).loc[
        ("flight", "surge", "ins_gnss", "sir", "position", "norm", "rmse")
    ]
    (path,) = [p for p in (results / "demo").glob("*.npz") if store.read_result(p).meta["label"] == "sir"]  # fmt: skip
    data = store.read_result(path).data
    error = data["error"][~data["lost"]][..., 6:9].astype(float)
    rmse = np.sqrt((error**2).sum(-1).mean(1))
    assert data["lost"].sum() == 1
    assert (row["runs"], row["runs_with_value"]) == (8, 7)
    assert row["mean"] == pytest.approx(rmse.mean())
    assert row["root_mean_square"] == pytest.approx(np.sqrt((error**2).sum(-1).mean()))
    assert [row["quantile_10"], row["median"], row["quantile_90"]] == pytest.approx(
        np.quantile(rmse, [0.1, 0.5, 0.9])
    )


def test_the_bound_is_over_the_steps_with_truth(results):
    path = min((results / "demo").glob("*.npz"))
    result = store.read_result(path)
    bound = np.linspace(1.0, 2.0, 20)[:, None] * np.ones(9)
    error = result.data["error"].copy()
    error[1, 5:] = np.nan
    result = store.JobResult(result.meta, {**result.data, "error": error, "pcrb": bound})
    group = next(g for g in component_groups(result.meta["state"]) if g.group == "position")
    values = metrics.compute_metric("pcrb", metrics.MetricInput(result, group, "position"))["norm"]
    assert values[0] == pytest.approx(np.sqrt(3 * (bound[:, 0] ** 2).mean()))
    assert values[1] == pytest.approx(np.sqrt(3 * (bound[:5, 0] ** 2).mean()))
    without = store.JobResult(result.meta, {k: v for k, v in result.data.items() if k != "pcrb"})
    assert metrics.compute_metric("pcrb", metrics.MetricInput(without, group, "position")) == {}
