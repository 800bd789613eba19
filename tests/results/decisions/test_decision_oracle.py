"""Decisions of a whole study, from its files, against a computation that shares no code with pfbench."""

from __future__ import annotations

import json
from pathlib import Path

import command_line as cli
import pytest
from decision_oracle import find_differences, read_runs, recompute

STUDY = [
    "scenario=linear_walk,passive_1,passive_2",
    "scenario.steps=40",
    "noise=nominal,outliers",
    "filter=ekf,ukf,sir,rpf,gpf",
    "particles=100",
    "runs=20",
    "study=oracle",
]


@pytest.mark.slow  # 30 jobs and a report: a study of two worlds, two regimes and ten pairs
def test_decisions_of_a_study_are_those_of_an_independent_computation(tmp_path: Path) -> None:
    folders = f"results_dir={tmp_path}/results", f"reports_dir={tmp_path}/reports"
    assert cli.pfbench("run", "-m", *STUDY, folders[0], home=tmp_path).code == 0
    assert cli.pfbench("report", "study=oracle", *folders, home=tmp_path).code == 0
    records = json.loads((tmp_path / "reports" / "oracle" / "decisions.json").read_text())
    runs = read_runs(tmp_path / "results" / "oracle")
    table = recompute(runs, records)
    assert len(table) >= 100
    assert not len(find_differences(table)), find_differences(table).to_string()
    # the study has lost tracks, and words of several kinds, so that an error of each kind is seen
    assert 0.5 < runs["keeps"].mean() < 0.95
    assert {"better", "worse", "inconclusive"} <= set(table["word"])
    # a record that is changed is seen
    records[0]["word"] = "identical"
    assert len(find_differences(recompute(runs, records))) == 1
