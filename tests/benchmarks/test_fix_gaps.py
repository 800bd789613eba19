"""The page of gaps between fixes states the stored results, and its statistics are those of ranks."""

from __future__ import annotations

import json
import sys

from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import fix_gaps


def test_the_page_is_written_from_the_stored_results() -> None:
    stored = json.loads(fix_gaps.STORE.read_text())
    assert (ROOT / "benchmarks" / "fix_gaps.md").read_text() == fix_gaps.page(stored)
    assert [(row["world"], row["filter"]) for row in stored["rows"]] == [
        (world, name) for world, (_, _, names) in fix_gaps.WORLDS.items() for name in names
    ]
    assert {len(row["rmse"]) for row in stored["rows"]} == {stored["runs"]}


def test_a_median_has_its_interval_by_ranks() -> None:
    """Of 20 values the interval of at least 95 % lies between the 6th and the 15th."""
    assert fix_gaps.summarise([float(n) for n in range(1, 21)]) == "10.5 [6, 15]"
