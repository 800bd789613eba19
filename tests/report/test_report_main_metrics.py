"""The metric that decides a study, its choice, and the bands of consistency of a report."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.report import ReportOptions, write_report
from pfbench.report.board.entries import build_run_table
from pfbench.results import metrics, store
from pfbench.results.conditions import load_conditions
from pfbench.results.frame import load_frame


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    for method in synthetic.METHODS:
        synthetic.write(folder / "demo", method, runs=20, steps=24)
    return folder


def median_ratio(results: Path, metric: str) -> float:
    """Ratio of UKF to EKF by Hodges and Lehmann, from the stored arrays."""
    logs = {}
    for path in sorted((results / "demo").glob("*.npz")):
        result = store.read_result(path)
        error = result.data["error"][..., 6:9].astype(float)
        largest, mean = np.linalg.norm(error, axis=-1).max(1), (error**2).sum(-1).mean(1)
        values = largest if metric == "max_error" else np.sqrt(mean)
        if metric == "first_error":
            values = np.linalg.norm(error[:, 0], axis=-1)
        if metric == "log_score":
            values = np.exp(-result.data["log_evidence"] / result.meta["steps"])
        logs[result.meta["label"]] = np.log(values)
    d = logs["ukf"] - logs["ekf"]
    return float(np.exp(np.median(np.add.outer(d, d)[np.triu_indices(len(d))] / 2)))


def test_values_are_those_of_the_stored_arrays(results: Path) -> None:
    """Of the runs that decide, and of the table of all metrics."""
    runs = build_run_table(load_conditions("demo", results)).set_index(["filter", "run"])
    table = load_frame("demo", results).query("metric == 'nees_ratio' and group == 'position'")
    ratios = table.set_index(["label", "run"])["value"]
    for path in sorted((results / "demo").glob("*.npz")):
        result = store.read_result(path)
        data, lost, label = result.data, result.data["lost"], result.meta["label"]
        norm = np.linalg.norm(data["error"][..., 6:9].astype(float), axis=-1)
        nees = data["nees"][..., 2].astype(float).mean(1) / 3
        for values, expected in (
            (runs.loc[label, "rmse"], np.sqrt((norm**2).mean(1))), (runs.loc[label, "max_error"], norm.max(1)),
            (runs.loc[label, "nees_ratio"], nees), (ratios.loc[label], nees),
        ):  # fmt: skip
            np.testing.assert_allclose(values[~lost], expected[~lost], rtol=1e-6)


def first_error(data: metrics.MetricInput) -> dict[str, np.ndarray]:
    return {"norm": np.linalg.norm(data.select("error")[:, 0], axis=-1)}


FIRST = metrics.Metric("first_error", first_error, "components", metrics.GROUP_UNIT, "lower", "Error of the first step.", page_name="first error")  # fmt: skip


@pytest.mark.parametrize("metric", ["rmse", "max_error", "log_score", "first_error"])
def test_the_metric_of_the_option_decides(metric: str, results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    """A new metric, too, which is one entry of the table of metrics."""
    monkeypatch.setattr(metrics, "METRICS", (*metrics.METRICS, FIRST))
    options = ReportOptions(metric=metric, figure_formats=("svg",))
    folder = write_report("demo", results, tmp_path, options).parent
    rows = pd.read_csv(folder / "verdicts.csv")
    assert rows["metric"].iloc[0] == metric
    assert metrics.page_metrics()[metric].page_name in (folder / "report.md").read_text()
    row = rows.query("filter == 'ukf' and baseline == 'ekf'").iloc[0]
    assert row["ratio"] == pytest.approx(median_ratio(results, metric), rel=1e-3)
    pairs = pd.read_csv(folder / "decisions.csv").set_index(["a", "b"])
    assert pairs.loc[("ekf", "ukf"), "ratio"] == pytest.approx(1 / row["ratio"], rel=1e-3)


def test_bands_of_a_report(results: Path, tmp_path: Path) -> None:
    """A filter that reports 0.7 of its errors has a NEES of 1 / 0.49 over its expectation."""
    folder = write_report("demo", results, tmp_path, ReportOptions(figure_formats=("svg",))).parent
    bands = pd.read_csv(folder / "consistency.csv")
    assert set(bands["quantity"]) == {"NEES"}
    assert set(bands["group"]) == {"attitude", "velocity", "position"}
    ekf = bands[bands["filter"] == "ekf"]
    assert set(ekf["word"]) == {"overconfident"}
    assert ((ekf["low"] <= 1 / 0.49) & (ekf["high"] >= 1 / 0.49)).all()
    assert set(bands.loc[bands["filter"] == "cofm_amssrcpf", "word"]) == {"no deviation shown"}
    assert set(bands.loc[bands["filter"] == "sir", "lost"]) == {1}


def test_other_metrics_are_refused() -> None:
    with pytest.raises(ValueError, match=r"report\.metric must be one of rmse, max_error"):
        ReportOptions(metric="nees")
