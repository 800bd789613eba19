"""The datasheet of a scene: its measures are those of the worlds, and its page is drawn from the file alone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkout import ROOT
from command_line import block, pfbench

from pfbench.core.record import Episode, Record
from pfbench.job import datasheet_data
from pfbench.model.linear_gaussian import LinearGaussian, linear_walk
from pfbench.noise.base import NominalNoise
from pfbench.report import datasheet
from pfbench.scenario.simulated import ModelSimulation

WALK = ("scenario=linear_walk", "scenario.steps=12")
PAGE = ROOT / "docs" / "write_a_scenario.md"


def doubles(values: Any) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


# measures


def test_residuals_at_the_truth_are_the_errors_that_were_drawn() -> None:
    model = linear_walk(1.0, 0.5, 2.0)
    episode = ModelSimulation(model, steps=30).draw(NominalNoise(), torch.arange(40), seed=3)
    truth = model.assemble(episode.truth)
    z = datasheet_data.compute_residuals(model, truth, episode)
    assert torch.allclose(z[..., 0], (episode.record.y[..., 0] - truth[..., 0]) / 2.0)
    assert abs(float(z.var()) - 1.0) < 4 * (2 / z.numel()) ** 0.5


def test_a_residual_that_hangs_on_an_unknown_state_is_unknown_and_no_other() -> None:
    eye = np.eye(3)
    # the first state is seen alone, the two unknown ones by their difference, and all by their sum
    h = [[1.0, 0.0, 0.0], [0.0, 1.0, -1.0], [1.0, 1.0, 1.0]]
    model = LinearGaussian(eye, eye, h, [2.0, 1.0, 1.0], np.zeros(3), np.ones(3))
    truth = doubles([[[4.0, np.nan, np.nan]], [[1.0, 2.0, 3.0]]])
    y = doubles([[[6.0, 0.0, 0.0]], [[np.nan, 0.0, 5.0]]])
    z = datasheet_data.compute_residuals(model, truth, Episode(Record(y), doubles([1.0]), {}))[:, 0]
    nan = np.nan
    np.testing.assert_allclose(z.numpy(), [[1.0, nan, nan], [nan, 1.0, -1.0]])


def test_deviations_are_about_the_mean_of_the_runs_that_have_a_truth() -> None:
    model = linear_walk(1.0, 0.5, 2.0)
    truth = doubles([[[1.0, 5.0]], [[3.0, np.nan]], [[8.0, 7.0]]])
    np.testing.assert_allclose(
        datasheet_data.compute_deviations(model, truth)[:, 0].numpy(),
        [[-3.0, -1.0], [-1.0, np.nan], [4.0, 1.0]],
    )


# the command


def test_a_scene_becomes_a_file_and_a_page_and_is_not_drawn_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench("datasheet", *WALK, "runs=6", home=tmp_path)
    assert said.code == 0, said.err
    page = tmp_path / "reports" / "datasheets" / "linear_walk_nominal" / "index.html"
    assert f"datasheet: {page.resolve()}" in said.out
    text = page.read_text()
    assert "12 steps" in text
    assert "6 runs" in text
    assert "Posterior Cramer-Rao bound" in text
    (file,) = (tmp_path / "results" / "datasheets").glob("*.npz")
    stamp, drawn = file.stat().st_mtime_ns, page.stat().st_mtime_ns
    assert (
        pfbench("datasheet", *WALK, "runs=6", "filter=ekf", "particles=7", home=tmp_path).code == 0
    )  # nothing of the scene
    assert file.stat().st_mtime_ns == stamp
    assert page.stat().st_mtime_ns > drawn
    assert pfbench("datasheet", *WALK, "runs=6", "overwrite=true", home=tmp_path).code == 0
    assert file.stat().st_mtime_ns > stamp
    assert (
        pfbench("datasheet", *WALK, "noise=student", home=tmp_path).code == 0
    )  # as many runs as it takes by itself
    other = (tmp_path / "reports" / "datasheets" / "linear_walk_student" / "index.html").read_text()
    assert f"{datasheet_data.RUNS} runs" in other
    assert "No bound: measurement distribution must be normal" in other
    assert f"{datasheet_data.RUNS} runs" in other


def test_a_page_needs_only_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert pfbench("datasheet", *WALK, "runs=3", home=tmp_path).code == 0
    (file,) = (tmp_path / "results" / "datasheets").glob("*.npz")
    elsewhere = datasheet.write_datasheet(file, tmp_path / "elsewhere")
    assert (
        elsewhere.read_bytes()
        == (tmp_path / "reports" / "datasheets" / "linear_walk_nominal" / "index.html").read_bytes()
    )


MISTAKES = {
    "unknown scenario": (
        ("scenario=flight_30s",),
        "scenario=flight_30s does not exist. Similar: flight_300s",
    ),
    "no data": (("scenario=recorded_berlin",), "data.root"),
    "no runs": ((*WALK, "runs=0"), "runs must be a whole number of at least 1, got 0"),
    "unknown key": ((*WALK, "scenario.stps=3"), "Similar: scenario.steps."),
    "bound": ((*WALK, "pcrb=maybe"), "pcrb must be auto"),
    "no scenario": (
        ("noise=student",),
        "scenario must be set. Use: pfbench datasheet scenario=NAME",
    ),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_told_as_elsewhere(tmp_path: Path, case: str) -> None:
    words, message = MISTAKES[case]
    said = pfbench("datasheet", *words, home=tmp_path)
    assert said.code == 2
    assert message in said.err
    assert not list(tmp_path.rglob("*.npz"))


OLD_COMMANDS = {
    ("report", "scenario=flight_300s"): "pfbench datasheet scenario=flight_300s",
    ("report", "study=datasheets"): "pfbench datasheet scenario=NAME",
    ("report", "study=claims"): "pfbench claims",
}


@pytest.mark.parametrize("words", OLD_COMMANDS)
def test_an_old_command_names_the_new_one(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench(*words, home=tmp_path)
    assert said.code == 2
    assert f"se: {OLD_COMMANDS[words]}" in said.err


def test_a_study_with_a_scenario_is_still_a_study(tmp_path: Path) -> None:
    said = pfbench("report", "study=none", *WALK, home=tmp_path)
    assert said.code == 2
    assert "study must be a study with results, got none" in said.err


@pytest.mark.slow
def test_the_page_write_a_scenario_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for language, code in re.findall(
        r"^```(python|bash)\n(.*?)^```", PAGE.read_text(), re.DOTALL | re.MULTILINE
    ):
        if language == "python":
            exec(compile(code, PAGE.name, "exec"), names)
        else:
            block(code, tmp_path)
    assert (tmp_path / "reports" / "datasheets" / "survey_nominal" / "index.html").exists()
    assert len(list(tmp_path.glob("results/mine/*.npz"))) == 2
    assert "Cramer-Rao bound" in (tmp_path / "reports" / "mine" / "index.html").read_text()
