"""Decisions of whole studies, from their files, against a computation that shares no code with pfbench."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path

import command_line as cli
import pytest
from checkout import ROOT
from decision_oracle import find_differences, recompute
from recompute import compare_planned, compare_rows, read_page
from result_oracle import read_runs

STUDY = [
    "scenario=linear_walk,passive_1",
    "scenario.steps=40",
    "scenario.interval_s=1.0,2.0",
    "noise=nominal,outliers",
    "filter=ekf,ukf,sir",
    "particles=100",
    "runs=20",
]
FAST = "report.figure_formats=[svg]"  # the figures are no matter here
PUBLISHED = ("paper_003_biases", "paper_002_fading")  # settings of the scenario, and of the filters


@pytest.mark.slow  # 24 jobs and a report: two worlds with two settings, two regimes and three pairs
def test_decisions_of_a_study_are_those_of_an_independent_computation(tmp_path: Path) -> None:
    folders = f"results_dir={tmp_path}/results", f"reports_dir={tmp_path}/reports"
    assert cli.pfbench("run", "-m", *STUDY, "study=oracle", folders[0], home=tmp_path).code == 0
    assert cli.pfbench("report", "study=oracle", FAST, *folders, home=tmp_path).code == 0
    records = json.loads((tmp_path / "reports" / "oracle" / "decisions.json").read_text())
    runs = read_runs(tmp_path / "results" / "oracle")
    table = recompute(runs, records)
    assert len(table) >= 45
    assert set(runs["scenario"]) > {"passive_1[interval_s=1.0]", "linear_walk[interval_s=2.0]"}
    assert not len(find_differences(table)), find_differences(table).to_string()
    # the study has lost tracks, and words of several kinds, so that an error of each kind is seen
    assert 0.5 < runs["keeps"].mean() < 0.95
    assert {"better", "worse", "inconclusive"} <= set(table["word"])
    # a record that is changed is seen, in the family that it is corrected with
    records[0]["word"] = "identical"
    family = [record for record in records if record["family"] == records[0]["family"]]
    assert 1 < len(family) < len(records)
    assert len(find_differences(recompute(runs, family))) == 1


@pytest.mark.parametrize("study", PUBLISHED)
def test_published_decisions_are_those_of_an_independent_computation(
    study: str, tmp_path: Path
) -> None:
    """From the files that git stores, for sweeps with settings too."""
    folder = ROOT / "reports" / study
    planned, words = compare_planned(folder)
    assert planned.problems == []
    assert planned.count >= 1
    rows = compare_rows(folder, words)
    assert rows.problems == []
    assert rows.count >= 50


def test_a_changed_number_of_a_published_decision_is_seen(tmp_path: Path) -> None:
    for name in ("runs.parquet", "verdicts.csv"):
        shutil.copy(ROOT / "reports" / PUBLISHED[0] / name, tmp_path)
    page = read_page(ROOT / "reports" / PUBLISHED[0])
    page["planned"][0]["low"] *= 1.001
    (tmp_path / "page.json.gz").write_bytes(gzip.compress(json.dumps(page).encode()))
    problems = compare_planned(tmp_path)[0].problems
    assert len(problems) == 1
    assert " low: " in problems[0]
