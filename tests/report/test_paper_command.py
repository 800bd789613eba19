"""The command `pfbench paper`: files of a study at the width of a journal, and its errors."""

import shutil
from pathlib import Path

import pandas as pd
import pytest
import synthetic_results as synthetic
from refusals import check_refused

from pfbench.cli.report import PAPER_COMMAND as PAPER
from pfbench.report.study_report import write_report


@pytest.fixture(autouse=True)
def without_latex(monkeypatch: pytest.MonkeyPatch) -> None:
    """PGF, a minute of pdflatex, has a test of its own."""
    monkeypatch.setattr(shutil, "which", lambda name: None)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    synthetic.study(folder / "results" / "demo", runs=6, steps=10)
    return folder


def test_it_writes_figures_tables_text_and_data(home: Path) -> None:
    words = ["study=demo", "width=120mm", f"results_dir={home}/results", f"reports_dir={home}/out"]
    PAPER(words)
    folder = home / "out" / "demo" / "paper"
    names = {path.name for path in folder.iterdir()}
    assert names >= {
        "paper.tex", "methods.tex", "table_main.tex", "table_planned.tex", "table_cost.tex",
        "leaderboard.pdf", "planned.pdf", "cost.pdf", "pfbench.bib", "verdicts.csv", "runs.parquet",
    }  # fmt: skip
    assert "COFM-AMSSRCPF" in (folder / "table_main.tex").read_text()
    rows = pd.read_csv(folder / "verdicts.csv").query("metric == 'rmse' and baseline == 'sir'")
    runs = pd.read_parquet(folder / "runs.parquet")
    assert set(rows["filter"]) == set(runs["filter"]) == {m.name for m in synthetic.METHODS}


def test_without_results_it_uses_the_stored_data_of_the_report(
    home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same files as from results, byte for byte."""
    words = ["study=demo", "width=120mm", f"reports_dir={tmp_path}"]
    PAPER([*words, f"results_dir={home}/results"])
    paper = tmp_path / "demo" / "paper"
    expected = {path.name: path.read_bytes() for path in paper.iterdir()}
    shutil.rmtree(paper)
    write_report("demo", home / "results", tmp_path)
    capsys.readouterr()
    PAPER([*words, f"results_dir={tmp_path}/none"])
    assert {path.name: path.read_bytes() for path in paper.iterdir()} == expected
    data = tmp_path / "demo" / "runs.parquet"
    assert f"note: without results, the paper is made of {data}" in capsys.readouterr().out
    check_refused(
        [
            (
                r"options of the report must have results, got report\.alpha=0\.1",
                lambda: PAPER([*words, f"results_dir={tmp_path}/none", "report.alpha=0.1"]),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["study=demo"], "journal or width must be set"),
        (["study=demo", "journal=nature"], "journal must be one of ieee, elsevier, springer"),
        (["study=demo", "width=3mm"], "width must"),
        (["study=dema", "journal=ieee"], "study must be a study with results, got dema"),
    ],
)
def test_errors_name_key_value_and_remedy(home: Path, words: list[str], message: str) -> None:
    check_refused(
        [
            (
                message,
                lambda: PAPER([*words, f"results_dir={home}/results", f"reports_dir={home}/none"]),
            )
        ],
        remedy=False,
    )
    assert not (home / "none").exists()
