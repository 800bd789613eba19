"""Metrics that decide: their values from stored arrays, their rules, and the choice of the main one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import synthetic_results as synthetic
from scipy import stats

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.options import ReportOptions
from pfbench.report.study_report import write_study_files
from pfbench.results import store
from pfbench.results.conditions import load_conditions
from pfbench.results.frame import load_frame
from pfbench.stats.main_metrics import (
    MAIN_METRICS,
    RULES,
    select_main_metrics,
    tidy_main,
    tidy_secondary,
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    for method in synthetic.METHODS:
        synthetic.write(folder / "demo", method, runs=20, steps=24)
    return folder


def test_values_are_those_of_the_stored_arrays(results: Path) -> None:
    table = load_frame("demo", results, convergence_threshold={"position": 4.0})
    key = table.groupby(["scenario", "noise", "model"]).size().index[0]
    rows = select_main_metrics(table, {key: "position"}, "main")
    assert set(rows["group"]) == {"main"}
    for path in sorted((results / "demo").glob("*.npz")):
        result = store.read_result(path)
        data, lost, label = result.data, result.data["lost"], result.meta["label"]
        values = rows[rows["label"] == label].set_index("metric")["value"]
        log_score = np.where(lost, np.nan, data["log_evidence"] / result.meta["steps"])
        assert values["log_score"].to_numpy() == pytest.approx(log_score, nan_ok=True)
        nees = data["nees"][..., 2].astype(float).mean(1)
        limit = stats.chi2.ppf(0.999, 3)
        flags = np.where(lost, np.nan, nees > limit)
        assert values["overconfident"].to_numpy() == pytest.approx(flags, nan_ok=True)
        ratio = np.where(lost, np.nan, nees / 3)
        assert values["nees_ratio"].to_numpy() == pytest.approx(ratio, nan_ok=True)
        norm = np.linalg.norm(data["error"][..., 6:9].astype(float), axis=-1)
        for run, share in enumerate(values["time_to_converge"]):
            above = np.nonzero(norm[run] > 4.0)[0]
            first = 0 if not len(above) else above[-1] + 1
            late = lost[run] or first == norm.shape[1]
            assert share == pytest.approx(1.0 if late else data["time"][first] / data["time"][-1])


def test_each_metric_has_a_rule_and_a_table(results: Path) -> None:
    table = load_frame("demo", results, convergence_threshold={"position": 4.0})
    key = table.groupby(["scenario", "noise", "model"]).size().index[0]
    rows = select_main_metrics(table, {key: "position"}, "main")
    tables = tidy_secondary(rows, "main")
    assert set(tables) == set(RULES)
    assert len(tables["rmse"]) == len(tables["log_score"]) == 4 * 20  # lost runs stay, at the end
    assert len(tables["overconfident"]) == 4 * 20 - 1  # one lost run
    assert set(MAIN_METRICS) < set(RULES)
    without = rows[(rows["metric"] != "crps") | (rows["label"] != "sir")]
    with pytest.raises(
        ValueError, match=r"report\.metric must be a metric of all results, got crps"
    ):
        tidy_main(without, "crps", "main")
    with pytest.raises(ValueError, match=r"report\.metric must be one of rmse, crps"):
        ReportOptions(metric="nees")


@pytest.mark.parametrize("metric", ["rmse", "crps"])
def test_the_main_metric_is_in_the_first_family_and_the_others_in_the_second(
    metric: str, results: Path, tmp_path: Path
) -> None:
    options = ReportOptions(metric=metric, convergence_threshold={"position": 4.0})
    table = load_frame("demo", results, convergence_threshold=options.convergence_threshold)
    with RecordedFolder(tmp_path) as folder:
        downloads = write_study_files(table, load_conditions("demo", results), options, folder)
    assert [d["href"] for d in downloads] == ["decisions.json", "consistency.json", "metrics.csv"]
    assert all((tmp_path / d["href"]).stat().st_size == d["bytes"] for d in downloads)
    records = json.loads((tmp_path / "decisions.json").read_text())
    assert len({tuple(map(str, record.values())) for record in records}) == len(records)
    first = {r["metric"] for r in records if "track and error" in r["family"]}
    assert first == {"keeps track", f"position {RULES[metric].name}"}
    second = {r["metric"] for r in records if "secondary" in r["family"]}
    others = {"attitude error", "velocity error"}  # RMSE of the groups that are not the main one
    assert second == {RULES[name].name for name in RULES if name != metric} | others
    tested = [r for r in records if "secondary" in r["family"] and r["question"] == "a"]
    assert len(tested) == 6 * len(second)  # all pairs of four filters are planned
    assert len({r["family_size"] for r in tested}) == 1  # one family
    bands = json.loads((tmp_path / "consistency.json").read_text())
    assert {b["quantity"] for b in bands} == {"NEES"}
    assert {b["group"] for b in bands} == {"attitude", "velocity", "position"}
    assert {b["label"] for b in bands if b["word"] == "overconfident"} >= {"ekf"}
