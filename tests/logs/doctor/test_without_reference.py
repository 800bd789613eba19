"""Inspection of a log without a reference: which checks work, and the gyro against the course."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_log
import yaml

import pfbench
from pfbench.cli.main import main
from pfbench.logs.doctor.checks import WITHOUT_REFERENCE
from pfbench.logs.doctor.thresholds import THRESHOLDS


def write_log(folder: Path, seed: int = 1) -> Path:
    tables, rng = synthetic_log.tables(60.0), np.random.default_rng(seed)
    imu, gnss = (
        tables["imu"],
        tables["gnss"].iloc[::5][["t", "pn", "pe", "pd"]].reset_index(drop=True),
    )
    imu[["fx", "fy", "fz", "wx", "wy", "wz"]] += rng.normal(size=(len(imu), 6)) * (
        [0.1] * 3 + [0.01] * 3
    )
    gnss[["pn", "pe", "pd"]] += rng.normal(size=(len(gnss), 3))
    return synthetic_log.write(folder, {"imu": imu, "gnss": gnss})


def change(folder: Path, name: str, columns: list[str], factor: float) -> None:
    table = pd.read_csv(folder / f"{name}.csv")
    table[columns] *= factor
    table.to_csv(folder / f"{name}.csv", index=False)


@pytest.mark.parametrize("seed", range(5))
def test_a_clean_log_has_no_finding(tmp_path: Path, seed: int) -> None:
    found = pfbench.inspect_log(write_log(tmp_path / "log", seed))
    assert not found.findings
    assert found.facts["checks without a reference"] == list(WITHOUT_REFERENCE)
    assert set(WITHOUT_REFERENCE) < set(THRESHOLDS)
    assert abs(found.facts["turn of the course over that of the gyro"] - 1.0) < 0.2


RATE = ["wx", "wy", "wz"]


@pytest.mark.parametrize(
    ("columns", "factor", "check"),
    [
        (RATE, 180.0 / np.pi, "turn of the course"),
        (RATE, -1.0, "turn of the course"),
        (["fx", "fy", "fz"], 1.0 / 9.80665, "unit of force"),
    ],
    ids=["deg/s", "sign", "g"],
)
def test_planted_faults_are_named_and_a_remedy_repairs(
    tmp_path: Path, columns: list[str], factor: float, check: str
) -> None:
    folder = write_log(tmp_path / "log")
    change(folder, "imu", columns, factor)
    found = pfbench.inspect_log(folder)
    assert check in [finding.check for finding in found.findings]
    if found.settings:
        assert not found.remaining
    else:
        assert factor == -1.0


def test_the_command_lists_what_works_and_suggests_the_same_scenario(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    change(write_log(tmp_path / "log"), "imu", RATE, 180.0 / np.pi)
    with pytest.raises(SystemExit) as error:
        main(["inspect", "log"])
    assert error.value.code == 3
    said = capsys.readouterr().out
    works, others = (next(line for line in said.splitlines() if words in line) for words in ("These checks work", "were left out"))  # fmt: skip
    assert "imu gap" in works
    assert "lever arm" in others
    assert "imu gap" not in others
    suggested = yaml.safe_load(
        (tmp_path / "reports/inspect_log/scenario/suggested.yaml").read_text()
    )
    assert suggested["defaults"] == ["user_log_aligned", "_self_"]


def test_import_and_python_take_a_log_without_a_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "log")
    main(["import", "copy", "imu=log/imu.csv", "gnss=log/gnss.csv"])
    assert {file.name for file in (tmp_path / "copy").iterdir()} == {"imu.csv", "gnss.csv"}
    assert "no reference. These checks work" in capsys.readouterr().out
    names = {f"{k}{a}": f"{n}[{i}]" for k, n in (("w", "gyro_rad"), ("f", "acc_m_s2")) for i, a in enumerate("xyz")}  # fmt: skip
    with pytest.raises(ValueError, match=r"'gyro_rad\[0\]': 'wx'.*'acc_m_s2\[2\]': 'fz'"):
        pfbench.log(pd.read_csv("log/imu.csv").rename(columns=names)[["t", *sorted(names.values())[::-1]]], "log/gnss.csv")  # fmt: skip
    part = pfbench.log("log/imu.csv", "log/gnss.csv")
    assert part.name == "user_log_aligned"
    scenario = pfbench.job.build_plan(
        pfbench.job.compose([f"scenario={part.name}", *part.changes, "filter=ekf"])
    ).scenario
    assert not scenario.read_checked(Path(scenario.root) / scenario.folder).notes[1:]
