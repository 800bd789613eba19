"""`pfbench infer scenario=NAME`: noise numbers of an own log, a scenario with them that other commands know, and sentences."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import synthetic_log
from command_line import pfbench as command

from pfbench.job import compose

FEW = ("infer.draws=200", "infer.rounds=2", "study=s")


def write_log(folder: Path, late: float = 0.0) -> str:
    """Write 60 s of a drive with a noisy IMU, fixes of 0.5 and 0.8 m each second that are late; return its words."""
    tables, rng = synthetic_log.tables(60.0), np.random.default_rng(3)
    imu, gnss = tables["imu"], tables["gnss"].iloc[::5].drop(columns=["vn", "ve", "vd"])
    imu[["wx", "wy", "wz"]] += 0.01 * rng.standard_normal((len(imu), 3))
    imu[["fx", "fy", "fz"]] += 0.2 * rng.standard_normal((len(imu), 3))
    gnss["t"] += late
    gnss[["pn", "pe", "pd"]] += rng.standard_normal((len(gnss), 3)) * [0.5, 0.5, 0.8]
    synthetic_log.write(folder / "drive", {**tables, "gnss": gnss})
    return f"scenario=user_log data.root={folder} scenario.folder=drive"


def test_numbers_of_a_log_become_a_scenario_of_other_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fixes of 0.5 and 0.8 m that are 0.3 s late: the next run reads numbers and delay from the file, by its name."""
    monkeypatch.chdir(tmp_path)
    words = write_log(tmp_path, late=0.3)
    said = command("infer", *shlex.split(words), *FEW, "infer.rounds=6", "name=my_drive", home=tmp_path)  # fmt: skip
    assert said.code == 0, said.err
    (path,) = (tmp_path / "results" / "s" / "inference").glob("noise_*.json")
    assert path.with_suffix(".svg").is_file()
    content = json.loads(path.read_text())
    rows = content["rows"]
    assert rows["position_horizontal"]["low"] < 0.5 < rows["position_horizontal"]["high"] * 1.3
    assert rows["delay"]["value"] == pytest.approx(0.3, abs=0.1)
    assert all(word in said.out for word in ("not identified", "second half", "Pareto k", "NIS/dim"))  # fmt: skip
    assert content["scores"]["inferred"]["log score"] > content["scores"]["scenario"]["log score"]
    values = compose(["scenario=my_drive", "scenario.folder=drive", f"data.root={tmp_path}", "hydra.searchpath=[file://conf]"]).values  # fmt: skip
    tuning = values["scenario"]["tuning"]
    assert tuning["gyro_density"] == rows["gyro_density"]["value"] == values["model"]["tuning"]["gyro_density"]  # fmt: skip
    assert tuning["position_sd"] == [rows[f"position_{axis}"]["value"] for axis in ("horizontal", "horizontal", "vertical")]  # fmt: skip
    assert values["scenario"]["corrections"]["shift_s"] == {"gnss": rows["delay"]["value"]}
    place = (f"data.root={tmp_path}", "scenario.folder=drive")
    assert f"Use: pfbench run scenario=my_drive {' '.join(place)}" in said.out
    ran = command("run", "scenario=my_drive", *place, "filter=ekf", "runs=2", "study=s", home=tmp_path)  # fmt: skip
    assert ran.code == 0, ran.err
    again = command("infer", *shlex.split(words), *FEW, "infer.rounds=6", "name=my_drive", home=tmp_path)  # fmt: skip
    assert again.out == said.out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("scenario.end_s=20", "the log must have at least 40 fixes, half of them to check the numbers, got 20"),
        ("particles=100", "particles must be left out for method=noise, a Kalman filter, got 100. Leave it out, or use method=pmmh."),
        ("filter=sir", "filter must be ekf for method=noise"),
        ("method=noise parameters={velocity_vertical:[1,2]}", "parameters must name noise numbers that change the fixes of this log, got velocity_vertical. Choose from gyro_density"),
        ("method=noise parameters={delay:[2,1]}", "parameters.delay must be two increasing numbers"),
        ("infer.sheet.gyro_deg_s=-1", "infer.sheet.gyro_deg_s must be"),
        ("infer.rounds=0", "infer.rounds must be"),
        ("runs=2", "runs must be 1 for a log, whose runs have the motion and the IMU in common, got 2"),
        ("model=strapdown_blocks", "model must be strapdown_total for method=noise, got strapdown_blocks"),
        ("name=user_log", "name must be that of a new file, or of one that this command wrote, got user_log"),
    ],
)  # fmt: skip
def test_what_is_not_valid_is_answered_by_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    said = command("infer", *shlex.split(write_log(tmp_path)), *FEW, *words.split(), home=tmp_path)
    assert said.code == 2
    assert sentence in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "conf").exists()
