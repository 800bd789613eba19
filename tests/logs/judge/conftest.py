"""A folder with a reference and a program for the tests of judge."""

from pathlib import Path

import judge_cases as cases
import pytest


@pytest.fixture
def home(tmp_path: Path) -> Path:
    truth = cases.drive()
    cases.write(truth, tmp_path / "truth.csv")
    cases.write(cases.full(truth), tmp_path / "theirs.csv")
    return tmp_path
