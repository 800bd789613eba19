"""The stored comparison of estimates of a board: the page shows it, and levels keep their error."""

from __future__ import annotations

import json
import math
import sys

import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import board_estimates

STORED = json.loads(board_estimates.STORE.read_text())


def test_the_page_shows_the_stored_rates() -> None:
    text = board_estimates.PAGE.read_text()
    assert board_estimates.page(text, STORED) == text
    changed = [{**STORED[0], "paired ratios": 0.999}, *STORED[1:]]
    assert board_estimates.page(text, changed) != text


@pytest.mark.parametrize("row", [r for r in STORED if r["quantity"] == "size"], ids=str)
def test_trimmed_levels_keep_their_level(row: dict[str, float]) -> None:
    error = math.sqrt(0.05 * 0.95 / board_estimates.STUDIES)
    assert row["trimmed log levels"] <= 0.05 + 3 * error
