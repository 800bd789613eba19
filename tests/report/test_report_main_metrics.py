"""The metric that decides a study, its choice, and the bands of consistency of a report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.report.options import ReportOptions
from pfbench.report.study_report import write_report
from pfbench.results import store
from pfbench.stats.main_metrics import MAIN_METRICS


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
        if metric == "log_score":
            values = np.exp(-result.data["log_evidence"] / result.meta["steps"])
        logs[result.meta["label"]] = np.log(values)
    d = logs["ukf"] - logs["ekf"]
    return float(np.exp(np.median(np.add.outer(d, d)[np.triu_indices(len(d))] / 2)))


@pytest.mark.parametrize("metric", ["rmse", "max_error", "log_score"])
def test_the_metric_of_the_option_decides(metric: str, results: Path, tmp_path: Path) -> None:
    options = ReportOptions(metric=metric, figure_formats=("svg",))
    folder = write_report("demo", results, tmp_path, options).parent
    rows = pd.read_csv(folder / "verdicts.csv")
    assert rows["metric"].iloc[0] == metric
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
    assert "rmse" in MAIN_METRICS
    with pytest.raises(ValueError, match=r"report\.metric must be one of rmse, crps"):
        ReportOptions(metric="nees")
