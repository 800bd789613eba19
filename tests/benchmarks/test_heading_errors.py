"""The page of wrong headings states the stored results."""

from __future__ import annotations

import json
import sys

from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import heading_errors


def test_the_page_is_written_from_the_stored_results() -> None:
    stored = json.loads(heading_errors.STORE.read_text())
    assert (ROOT / "benchmarks" / "heading_errors.md").read_text() == heading_errors.page(stored)
    names = set(heading_errors.filters())
    assert {(r["angle"], r["filter"]) for r in stored["rows"]} == {
        (angle, name) for angle in heading_errors.ANGLES for name in names
    }
