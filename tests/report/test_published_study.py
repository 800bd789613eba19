"""An own filter beside a published study: the verdicts of one study of all filters, and no comparison of other worlds."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from refusals import check_refused

import pfbench
from pfbench.cli.report import COMPARE_COMMAND as COMPARE
from pfbench.report.published_study import compare_tables, find_witness
from pfbench.report.stored_study import RUNS_FILE, StoredStudy, read_stored_study
from pfbench.report.study_report import find_overviews

WORLD = {"seed": 7, "runs": 12, "particles": 50, "progress": False}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A published study of three filters in a world, an own study of two, and a study of all of them."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for study, filters in {
            "public": ["ukf", "sir", "rpf"], "mine": ["ukf", "apf"], "all": ["ukf", "sir", "rpf", "apf"],
        }.items():  # fmt: skip
            pfbench.run("linear_walk", filters, scenario__steps=20, study=study, **WORLD)
        pfbench.study("public").report()
    return folder


def test_verdicts_are_those_of_one_study_of_all_filters(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(home)
    compared = pfbench.study("mine").against("public")
    (verdicts,), (witness,) = compared.verdicts.values(), compared.witnesses.values()
    assert ({(v.a, v.b) for v in verdicts}, witness) == ({("apf", "ukf"), ("apf", "sir"), ("apf", "rpf")}, "ukf")  # fmt: skip
    for verdict in verdicts:
        joint = pfbench.study("all").compare(verdict.a, verdict.b)
        assert verdict.ratio == pytest.approx(joint.ratio, rel=1e-5)
        assert verdict.n == 12
    assert ("apf against 3 filters" in str(compared), "A part" in str(compared)) == (True, False)
    other = pfbench.run("linear_walk", ["ukf", "apf"], scenario__steps=20, study="other", **{**WORLD, "particles": 40})  # fmt: skip
    assert "2 published filters have 50 particles, the own ones another number" in str(other.against("public"))  # fmt: skip
    COMPARE(["study=mine", "published=public"])
    assert "ukf has the errors of the published study" in capsys.readouterr().out
    table = pd.read_csv(home / "reports" / "mine" / "published.csv")
    assert list(table["ratio"]) == pytest.approx([v.ratio for v in verdicts])


def test_other_worlds_are_not_compared(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(home)
    study = read_stored_study(home / "reports" / "public")
    stored = study.table
    own = stored[stored["filter"] == "ukf"]
    assert find_witness(own, stored) == "ukf"
    moved = own.assign(rmse=own["rmse"] * np.where(own["run"] == 3, 1.01, 1.0))
    check_refused(
        [
            (
                r"ukf must have the errors of the published study, got others in 1 of 12 runs",
                lambda: find_witness(moved, stored),
            ),
            (r"its runs must have seed=7", lambda: find_witness(own.assign(seed=8), stored)),
            (
                r"must run again as a witness. Add filter=\w+",
                lambda: find_witness(own.assign(filter="apf"), stored),
            ),
        ],
        remedy=False,
    )
    both = pd.concat([own, own.assign(seed=8)])
    check_refused(
        [(r"its runs must have seed=7, got \[7, 8\]", lambda: find_witness(both, stored))],
        remedy=False,
    )
    compared = compare_tables(own.assign(scenario="elsewhere"), study)
    assert compared.verdicts == {}
    assert "Choose one of its scenarios" in str(compared)


def test_a_copy_of_a_filter_has_its_column_in_the_heat_map() -> None:
    """Worlds in which it did not run have a dash, and the columns of all others are as published."""
    pack, table = read_stored_study(ROOT / "reports" / "all_seven", decides=False)
    names = table["filter"].astype(str).str.partition("[")[0]
    some = [
        "mcmc_rpf",
        "dmc_reconstructed",
        "qmc_polymerised",
        "sir",
        "ekf",
        "ukf",
        "ekf_scaled_tuned",
    ]
    table = table[table["scenario"].isin(["growth", "lorenz63", "pendulum"]) & names.isin(some)]
    table = table[table["particles"].isna() | (table["particles"] == 100)]
    labels = set(table["filter"])
    looks = [look for look in pack["facts"]["looks"] if look["key"] in labels]
    pack = {**pack, "facts": {**pack["facts"], "looks": looks}}
    study = StoredStudy(pack, table)
    copied = table[table["filter"].astype(str).str.startswith("sir[")]
    own = pd.concat([copied.assign(filter="copy"), table[table["filter"] == "ekf"]])
    compared = compare_tables(own[own["scenario"] != "pendulum"], study)
    cells = {cell.world: cell for cell in compared.cells}
    assert set(cells) == {"growth", "lorenz63"}
    overviews = find_overviews(pack, table)
    assert overviews is not None
    published = {c.world: c for c in next(iter(overviews.values())).cells if c.filter == "sir"}
    for world, cell in cells.items():
        assert cell.verdict.ratio == published[world].verdict.ratio
        assert cell.track_share == published[world].track_share
    figure = compared._replace(names={"copy": "Copy of SIR"}).plot()
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert texts.count("Copy of SIR") == 1
    assert texts.count("–") >= 1


def test_a_study_of_one_world_has_a_table_alone(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(home)
    compared = pfbench.study("mine").against("public")
    assert not compared.cells
    check_refused(
        [(r"must have a published study of several methods.*Use table", lambda: compared.plot())],
        remedy=False,
    )


def test_a_filter_that_ignores_the_measurements_is_no_witness(home: Path) -> None:
    """Its errors agree whatever is measured; and one agreeing filter does not excuse another."""
    stored = read_stored_study(home / "reports" / "public").table
    ukf, sir = stored[stored["filter"] == "ukf"], stored[stored["filter"] == "sir"]
    blind = ukf.assign(filter="dead_reckoning")
    check_refused(
        [
            (
                r"must run again as a witness",
                lambda: find_witness(blind, pd.concat([stored, blind])),
            ),
            (
                r"ukf must have the errors .* got others in 12 of 12 runs",
                lambda: find_witness(pd.concat([sir, ukf.assign(rmse=2 * ukf["rmse"])]), stored),
            ),
        ],
        remedy=False,
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study=mine"], r"published must be set\. Use: pfbench compare study=NAME published=all_seven"),
        (["study=mine", "published=nothing"], rf"published must be a report with {RUNS_FILE}, got 'nothing'.*public"),
        (["study=nothing", "published=public"], r"study must be a study with results, got nothing"),
    ],
)  # fmt: skip
def test_what_is_missing_is_said(
    words: list[str], message: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(home)
    check_refused([(message, lambda: COMPARE(words))], remedy=False)
