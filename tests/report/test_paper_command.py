"""The command `pfbench paper`: files of a study at the width of a journal, and its errors."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
import synthetic_results as synthetic

from pfbench.cli.paper import write_study_paper


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    synthetic.study(folder / "results" / "demo", runs=12, steps=20)
    return folder


def test_it_writes_figures_tables_text_and_data(home: Path) -> None:
    words = ["study=demo", "width=120mm", f"results_dir={home}/results", f"reports_dir={home}/out"]
    write_study_paper(words)
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
    with pytest.raises(ValueError, match=message):
        write_study_paper([*words, f"results_dir={home}/results", f"reports_dir={home}/none"])
    assert not (home / "none").exists()
