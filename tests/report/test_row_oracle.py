"""All rows and pairs of published studies are those of a computation by scipy alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pandas as pd
import pytest
from checkout import ROOT
from row_oracle import compare_pairs, compare_rows

from pfbench.report import RUNS_FILE, rebuild_page


@pytest.mark.parametrize("study", ["recorded_quad", "paper_004"])
def test_all_rows_and_pairs_are_those_of_scipy(study: str, tmp_path: Path) -> None:
    """Also with lost runs; a planted change of one verdict is found."""
    folder = tmp_path / study
    folder.mkdir()
    shutil.copy(ROOT / "reports" / study / RUNS_FILE, folder)
    rebuild_page(folder)
    rows, problems = compare_rows(folder)
    pairs, others = compare_pairs(folder)
    assert rows > 30
    assert pairs > 20
    assert problems + others == []
    table = pd.read_csv(folder / "decisions.csv")
    k = int(table.index[table["word"] == "better"][0])
    table.loc[k, "word"] = "worse"
    table.to_csv(folder / "decisions.csv", index=False)
    assert len(compare_pairs(folder)[1]) == 1
