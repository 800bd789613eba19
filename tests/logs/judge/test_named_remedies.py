"""Other separators, useless options, wrong axes and clocks: the message names the fault and its remedy."""

from pathlib import Path

import judge_cases as cases
import pandas as pd
import pytest

POSITION = ["pn", "pe", "pd"]


@pytest.mark.parametrize(
    ("separator", "name"), [(";", "semicolons"), ("\t", "tabs"), (" ", "blanks"), ("|", "bars")]
)
@pytest.mark.parametrize("decimal", [".", ","])
def test_other_separators_are_named(home: Path, separator: str, name: str, decimal: str) -> None:
    """The remedy of the message is followed, and the table is read."""
    table = cases.full(cases.drive())
    table.to_csv(home / "mine.csv", sep=separator, decimal=decimal, index=False)
    said = cases.judge(home)
    assert said.code == 2
    assert (
        f"line 1 must be names of columns separated by commas, got {name} as separators" in said.err
    )
    pattern = {" ": r"\s+"}.get(separator, separator)
    options = f"sep={pattern!r}" + (", decimal=','" if decimal == "," else "")
    assert f"read_csv('mine.csv', {options})" in said.err
    again = pd.read_csv(home / "mine.csv", sep=pattern, decimal=decimal)
    cases.write(again, home / "mine.csv")
    assert cases.judge(home).code == 0


@pytest.mark.parametrize(
    ("first", "problem"),
    [("# made by a program\nt,pn,pe,pd\n", "a comment"), ("", "numbers alone")],
)  # fmt: skip
def test_a_first_line_without_names_is_named(home: Path, first: str, problem: str) -> None:
    text = cases.drive()[["t", *POSITION]].to_csv(index=False, header=False)
    (home / "mine.csv").write_text(first + text)
    said = cases.judge(home)
    assert said.code == 2
    assert (
        f"mine.csv: line 1 must be names of columns separated by commas, got {problem}" in said.err
    )


def test_names_of_columns_can_be_exchanged(home: Path) -> None:
    table = cases.full(cases.drive())
    cases.write(table.rename(columns={"pn": "pe", "pe": "pn"}), home / "mine.csv")
    assert cases.judge(home).code == 2
    said = cases.judge(home, "mine.columns=pn:pe,pe:pn")
    assert said.code == 0, said.err


def test_tabs_are_named_beside_a_comma_in_a_name(home: Path) -> None:
    cases.full(cases.drive()).rename(columns={"yaw": "yaw, deg"}).to_csv(
        home / "mine.csv", sep="\t", index=False
    )
    assert "got tabs as separators" in cases.judge(home).err


def test_trajectories_that_all_stop_early_are_named(home: Path) -> None:
    table = cases.full(cases.drive())
    cases.write(table[:120], home / "mine.csv")
    cases.write(table[120:], home / "theirs.csv")
    said = cases.judge(home)
    assert said.code == 2
    assert "one trajectory must cover 90 % of the time" in said.err
    assert "Set from and to, or a smaller coverage." in said.err


def test_a_file_that_is_no_result_is_refused_without_advice_of_its_reader(home: Path) -> None:
    (home / "mine.npz").write_text("t,pn\n")
    said = cases.judge(home, f"mine={home / 'mine.npz'}")
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
    said = cases.judge(home)
    assert said.code == 2
    assert "The motion agrees at mine.shift=-1000." in said.err
