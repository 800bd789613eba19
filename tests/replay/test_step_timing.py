"""Filters of a stored study are timed in turn: a slower filter is found slower, and the report states it."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import pfbench

import pfbench as package
from pfbench import job
from pfbench.results.step_times import STEP_TIMES, read_step_times

WALK = ("scenario=linear_walk", "scenario.steps=25", "runs=20", "score_steps=2", "study=walks", "noise=nominal")  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cost")
    for words in (("filter=ekf",), ("filter=sir", "particles=5000"), ("filter=sir", "particles=50")):  # fmt: skip
        job.run(job.compose([*WALK, f"results_dir={folder}/results", *words]))
    return folder


def test_filters_take_turns_and_the_report_states_the_ratio(home: Path) -> None:
    said = pfbench("cost", "study=walks", "rounds=5", "seconds=0.001", home=home)
    assert said.code == 0, said.err
    assert "1 of 1 conditions to measure, about" in said.out
    assert "3 filters, 20 steps, 5 rounds; about 0 s left" in said.out
    file = home / "results/walks" / STEP_TIMES
    ((_, entry),) = read_step_times(file.parent).items()
    by_label = {row["label"]: np.array(row["cpu"]) for row in entry["jobs"].values()}
    large, small = (by_label[f"sir[particles={n}]"] for n in (5000, 50))
    assert np.median(large) > np.median(small)  # 100 times the particles, whatever runs beside
    before = file.read_bytes()
    assert "skipped" in pfbench("cost", "study=walks", home=home).out
    assert file.read_bytes() == before
    frame = package.load("walks", home / "results")
    rows = frame[(frame.metric == "seconds_per_step") & (frame.label == "sir[particles=5000]")]
    stored = rows.groupby("component")["value"].first()
    np.testing.assert_allclose(stored[["quartile_25", "", "quartile_75"]], np.quantile(large, (0.25, 0.5, 0.75)))  # fmt: skip
    said = pfbench("report", "study=walks", f"reports_dir={home}/reports", home=home)
    assert said.code == 0, said.err
    page = (home / "reports/walks/report.md").read_text()
    assert "median and quartiles of 5 rounds" in page
    assert "| ratio of ms/step |" in page
    assert (home / "reports/walks" / STEP_TIMES).read_bytes() == before


def test_a_changed_job_is_measured_again_and_old_times_are_not_used(home: Path) -> None:
    file = home / "results/walks" / STEP_TIMES
    content = json.loads(file.read_text())
    (first,) = content["conditions"]
    job.run(job.compose([*WALK, f"results_dir={home}/results", "filter=ukf"]))
    assert "measured" in pfbench("cost", "study=walks", "rounds=5", "seconds=0.001", home=home).out
    assert first not in read_step_times(file.parent)
    file.unlink()
    frame = package.load("walks", home / "results")
    assert set(frame[frame.metric == "seconds_per_step"].component) == {""}
    pfbench("report", "study=walks", f"reports_dir={home}/reports", home=home)
    assert "one timing per job" in (home / "reports/walks/report.md").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("rounds=3",), "rounds must be a whole number in [5, 1000], got 3. Default: rounds=7"),
        (("seconds=-1",), "seconds must be in [0.001, 3600], got -1"),
        (("round=9",), "key must be one of"),
    ],
)
def test_mistakes_have_advice(home: Path, words: tuple[str, ...], message: str) -> None:
    said = pfbench("cost", "study=walks", *words, home=home)
    assert said.code == 2
    assert message in said.err
