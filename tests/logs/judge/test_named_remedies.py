"""Other separators, useless options, wrong axes and clocks: the message names the fault and its remedy."""

from __future__ import annotations

from pathlib import Path

import judge_cases as cases
import pandas as pd
import pytest
from command_line import pfbench

POSITION = ["pn", "pe", "pd"]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    truth = cases.drive()
    cases.write(truth, tmp_path / "truth.csv")
    cases.write(full(truth), tmp_path / "theirs.csv")
    return tmp_path


def full(truth: pd.DataFrame) -> pd.DataFrame:
    """Position with errors and SD, velocity and attitude without."""
    rest = truth.drop(columns=["t", *POSITION])
    return pd.concat([cases.estimate(truth, 1.0, 1), rest], axis=1)


def judge(home: Path, *words: str):
    names = {"reference": "truth.csv", "mine": "mine.csv", "theirs": "theirs.csv"}
    given = {word.partition("=")[0] for word in words}
    files = [f"{name}={home / file}" for name, file in names.items() if name not in given]
    return pfbench("judge", *files, f"reports_dir={home / 'reports'}", *words, home=home)


@pytest.mark.parametrize(
    ("separator", "name"), [(";", "semicolons"), ("\t", "tabs"), (" ", "blanks"), ("|", "bars")]
)
@pytest.mark.parametrize("decimal", [".", ","])
def test_other_separators_are_named(home: Path, separator: str, name: str, decimal: str) -> None:
    """The remedy of the message is followed, and the table is read."""
    table = full(cases.drive())
    table.to_csv(home / "mine.csv", sep=separator, decimal=decimal, index=False)
    said = judge(home)
    assert said.code == 2
    assert (
        f"line 1 must be names of columns separated by commas, got {name} as separators" in said.err
    )
    pattern = {" ": r"\s+"}.get(separator, separator)
    options = f"sep={pattern!r}" + (", decimal=','" if decimal == "," else "")
    assert f"read_csv('mine.csv', {options})" in said.err
    again = pd.read_csv(home / "mine.csv", sep=pattern, decimal=decimal)
    cases.write(again, home / "mine.csv")
    assert judge(home).code == 0


@pytest.mark.parametrize(
    ("first", "problem"),
    [("# made by a program\nt,pn,pe,pd\n", "a comment"), ("", "numbers alone")],
)  # fmt: skip
def test_a_first_line_without_names_is_named(home: Path, first: str, problem: str) -> None:
    text = cases.drive()[["t", *POSITION]].to_csv(index=False, header=False)
    (home / "mine.csv").write_text(first + text)
    said = judge(home)
    assert said.code == 2
    assert (
        f"mine.csv: line 1 must be names of columns separated by commas, got {problem}" in said.err
    )


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("mine.frame=enu", "frame must belong to a TUM file, got mine.csv"),
        ("mine.shift=1e300", "shift must be in [-1e+10, 1e+10], got 1e+300"),
        ("origin=200,11,0", "origin must be in [-90, 90], got 200.0"),
        (f"study={'x' * 300}", "study must be letters, digits, _, -, + or ., at most 100"),
        ("my program=mine.csv", "got 'my program'. Rename the program: my_program=mine.csv"),
    ],
)
def test_a_word_without_use_is_refused(home: Path, word: str, message: str) -> None:
    cases.write(full(cases.drive()), home / "mine.csv")
    said = judge(home, word)
    assert said.code == 2
    assert message in said.err
    assert not (home / "reports").exists()


def test_names_of_columns_can_be_exchanged(home: Path) -> None:
    table = full(cases.drive())
    cases.write(table.rename(columns={"pn": "pe", "pe": "pn"}), home / "mine.csv")
    assert judge(home).code == 2
    said = judge(home, "mine.columns=pn:pe,pe:pn")
    assert said.code == 0, said.err


def test_tabs_are_named_beside_a_comma_in_a_name(home: Path) -> None:
    full(cases.drive()).rename(columns={"yaw": "yaw, deg"}).to_csv(
        home / "mine.csv", sep="\t", index=False
    )
    assert "got tabs as separators" in judge(home).err


def test_trajectories_that_all_stop_early_are_named(home: Path) -> None:
    table = full(cases.drive())
    cases.write(table[:120], home / "mine.csv")
    cases.write(table[120:], home / "theirs.csv")
    said = judge(home)
    assert said.code == 2
    assert "one trajectory must cover 90 % of the time" in said.err
    assert "Set from and to, or a smaller coverage." in said.err


def test_a_file_that_is_no_result_is_refused_without_advice_of_its_reader(home: Path) -> None:
    (home / "mine.npz").write_text("t,pn\n")
    said = judge(home, f"mine={home / 'mine.npz'}")
    assert said.code == 2
    assert "mine.npz must be a result of pfbench" in said.err
    assert "pickle" not in said.err


def test_a_period_of_the_motion_does_not_mislead_the_shift(home: Path) -> None:
    """The direction repeats after 125.7 s, at other places."""
    truth = cases.drive(300.0)
    cases.write(truth, home / "truth.csv")
    cases.write(cases.estimate(truth, 1.0, 3), home / "theirs.csv")
    mine = cases.estimate(truth, 1.0, 4)
    cases.write(mine.assign(t=mine.t + 1000), home / "mine.csv")
    said = judge(home)
    assert said.code == 2
    assert "The motion agrees at mine.shift=-1000." in said.err
