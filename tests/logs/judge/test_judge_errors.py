"""Each kind of bad input gives one sentence with file, column, value and remedy; nothing is written."""

from collections.abc import Callable
from pathlib import Path

import judge_cases as cases
import numpy as np
import pandas as pd
import pytest

Change = Callable[[pd.DataFrame], pd.DataFrame]
POSITION = ["pn", "pe", "pd"]


def scale(columns: list[str], factor: float) -> Change:
    return lambda table: table.assign(**{name: factor * table[name] for name in columns})


BAD: dict[str, tuple[Change, str, str]] = {
    "no overlap": (lambda d: d.assign(t=d.t + 1e5), "column t must overlap truth.csv", "mine.shift=-100000"),
    "milliseconds": (lambda d: d.assign(t=d.t * 1e3 + 1e6), "column t must overlap", "in ms"),
    "milliseconds from 0": (lambda d: d.assign(t=d.t * 1e3), "column t must overlap", "in ms"),
    "minutes": (lambda d: d.assign(t=d.t / 60), "column t must overlap", "in minutes"),
    "leap seconds": (lambda d: d.assign(t=d.t + 18), "must have the clock of truth.csv", "mine.shift=-1"),
    "unknown column": (lambda d: d.rename(columns={"pe": "east"}), "without pe", "Add the missing columns"),
    "no time": (lambda d: d.rename(columns={"t": "time"}), "must have the column t", "mine.columns=t:"),
    "NaN": (lambda d: d.assign(pe=d.pe.where(d.index != 7)), "line 9, column pe must be a finite", "Remove these rows"),
    "text": (lambda d: d.assign(pe=d.pe.astype(object).where(d.index != 7, "x")), "line 9, column pe must be a number", "Repair"),
    "repeated time": (lambda d: pd.concat([d[:5], d[4:]]), "got 2 after 2 in line 7, which repeats the previous time", "Keep one row for each time."),
    "feet": (scale(POSITION, 3.28084), "column pn must be in m", "Multiply the column by 0.3048"),
    "km/h": (scale(["vn", "ve", "vd"], 3.6), "column vn must be in m/s", "0.277778"),
    "degrees": (scale(["roll", "pitch", "yaw"], 180 / np.pi), "column pitch must be", "0.017453"),
    "negative deviation": (lambda d: d.assign(sd_pe=-1.0), "column sd_pe must be above 0", "Remove the uncertainty"),
    "yaw from East": (lambda d: d.assign(yaw=np.pi / 2 - d.yaw), "column yaw must be that of axes", "from 1.571 rad"),
    "velocity in ENU": (lambda d: d.rename(columns={"vn": "ve", "ve": "vn"}), "times those of ve", "the name or the place of ve"),
    "another place": (lambda d: d.assign(pn=d.pn + 3e5), "positions must come within", "origin of the columns"),
    "other epochs": (lambda d: d.assign(t=d.t + 0.2), "must share at least 10 epochs", "tolerance=0.201"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused(home: Path, case: str) -> None:
    change, problem, remedy = BAD[case]
    cases.write(change(cases.full(cases.drive())), home / "mine.csv")
    said = cases.judge(home)
    assert said.code == 2
    assert problem in said.err
    assert remedy in said.err
    assert "mine.csv" in said.err or "truth.csv" in said.err
    assert not (home / "reports").exists()


def test_the_remedies_help(home: Path) -> None:
    truth = cases.full(cases.drive())
    cases.write(truth.assign(t=truth.t + 18).rename(columns={"pe": "east"}), home / "mine.csv")
    said = cases.judge(home, "mine.shift=-18", "mine.columns=pe:east")
    assert said.code == 0, said.err
    assert (home / "reports/judge/decisions.json").is_file()


def test_radians_for_degrees(home: Path) -> None:
    truth = cases.drive()
    table = pd.DataFrame(cases.geodetic(truth), columns=["lat_deg", "lon_deg", "h_m"])
    cases.write(table.assign(t=truth.t), home / "truth.csv")
    cases.write(table.assign(t=truth.t, lat_deg=np.radians(table.lat_deg)), home / "mine.csv")
    said = cases.judge(home, f"theirs={home / 'mine.csv'}")
    assert said.code == 2
    assert "column lat_deg must be in deg" in said.err
    assert "radians" in said.err


def test_a_hole_of_the_reference(home: Path) -> None:
    truth = cases.drive()
    cases.write(cases.full(truth), home / "mine.csv")
    cases.write(truth[(truth.t < 40) | (truth.t > 60)], home / "truth.csv")
    said = cases.judge(home)
    assert said.code == 2
    assert "truth.csv: line 82, column t must follow the row before within 1.25 s" in said.err
    assert "holes=skip" in said.err
    said = cases.judge(home, "holes=skip")
    assert said.code == 0, said.err
    assert "200 common epochs" in said.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("hole=3",), "hole must be a program with a file, got hole=3. Similar: holes"),
        (("from=abc",), "from must be a number, got abc"),
        (("coverage=2",), "coverage must be in (0, 1], got 2.0"),
        (("baseline=other",), "baseline must be a program, got other"),
        (("mine.speed=3",), "mine.speed must be an option of a program, got speed"),
        (("other.shift=3",), "other must be a program with a file"),
        (("theirs=no.csv",), "no.csv must be a file, got none"),
        (("study=../x",), "study must be letters"),
        (("theirs=theirs.xyz",), "must be a file"),
        (("mine.frame=enu",), "frame must belong to a TUM file, got mine.csv"),
        (("mine.shift=1e300",), "shift must be in [-1e+10, 1e+10], got 1e+300"),
        (("origin=200,11,0",), "origin must be in [-90, 90], got 200.0"),
        ((f"study={'x' * 300}",), "study must be letters, digits, _, -, + or ., at most 100"),
        (("my program=mine.csv",), "got 'my program'. Rename the program: my_program=mine.csv"),
        (("from=1e6",), "from must be within truth.csv (0 to"),
        (("to=-5",), "to must be within truth.csv (0 to"),
        (("block=1e9",), "block must be at most half of the scored time"),
        (("every=1e9",), "Set a smaller every"),
        (("mine.sd=sd.txt",), "sd must belong to a text file of KF-GINS, got sd.txt for mine.csv"),
        (("margin=0",), "error judge: margin must be in [1e-6, 1e6]"),
        (("alpha=1",), "error judge: alpha must be in [1e-9, 1)"),
    ],
)
def test_bad_words(home: Path, words: tuple[str, ...], message: str) -> None:
    cases.write(cases.full(cases.drive()), home / "mine.csv")
    said = cases.judge(home, *words)
    assert said.code == 2
    assert message in said.err
    assert not (home / "reports").exists()


def test_a_frame_of_a_tum_file_is_required(home: Path) -> None:
    truth = cases.drive()
    zero = np.zeros(len(truth))
    np.savetxt(
        home / "mine.tum", np.column_stack([truth.t, truth[POSITION], zero, zero, zero, zero + 1])
    )
    said = cases.judge(home, f"mine={home / 'mine.tum'}")
    assert said.code == 2
    assert "frame must be ned or enu for mine.tum" in said.err
