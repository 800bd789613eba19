"""All numbers of verdicts.csv and of the first sentence, against a computation without code of pfbench."""

from __future__ import annotations

from pathlib import Path

import pytest
import synthetic_results as synthetic
from board_oracle import find_differences

from pfbench.report.study_report import write_report

METHODS = (*synthetic.METHODS, synthetic.Method("cpf", 1.01, 0.9, 200, 7.0, (1, 2, 3, 4, 5)))


@pytest.mark.slow  # a whole report
def test_numbers_of_the_page_are_those_of_an_independent_computation(tmp_path: Path) -> None:
    for noise in ("nominal", "surge"):
        for method in METHODS:
            synthetic.write(tmp_path / "demo", method, noise=noise, runs=20, steps=30)
    folder = write_report("demo", tmp_path, tmp_path / "reports").parent
    assert find_differences(folder) == []
    file = folder / "verdicts.csv"
    rows = file.read_text().splitlines()
    number = next(cell for cell in rows[2].split(",") if cell.startswith("0.") and len(cell) > 4)
    file.write_text("\n".join([*rows[:2], rows[2].replace(number, f"{1.01 * float(number):.4g}", 1), *rows[3:]]))  # fmt: skip
    assert len(find_differences(folder)) == 1
