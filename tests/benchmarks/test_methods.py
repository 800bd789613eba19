"""The page of costs states the stored results of every filter."""

from __future__ import annotations

import json
import sys

from checkout import ROOT

from pfbench import job

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import methods


def test_the_page_is_written_from_the_stored_results_of_all_filters() -> None:
    stored = json.loads(methods.STORE.read_text())
    assert (ROOT / "benchmarks" / "methods.md").read_text() == methods.page(stored)
    names = {file.stem for file in job.list_groups()["filter"]}
    assert set(stored["rows"]) | set(stored["refused"]) == names
    assert all(
        low <= middle <= high for low, middle, high in map(ratio_of, stored["rows"].values())
    )
    assert ratio_of(stored["rows"]["sir"]) == [1.0, 1.0, 1.0]


def ratio_of(row: dict[str, list[float]]) -> list[float]:
    return row["ratio"]


def test_ratios_are_those_of_the_same_round() -> None:
    class Method:
        particles = 20

    spent = {"sir": [1.0, 2.0, 4.0], "other": [3.0, 4.0, 16.0]}
    rows = methods.rows_of(dict.fromkeys(spent, Method()), spent)
    assert rows["other"] == {"particles": "20", "ms": 4.0, "ratio": [2.0, 3.0, 4.0]}
