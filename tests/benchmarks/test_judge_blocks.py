"""The stored error rates of decisions along one run: the page shows them, and the level is kept."""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import judge_blocks
from board_estimates import page

STORED = json.loads(judge_blocks.STORE.read_text())
ALARMS = "equal programs called different"
VARYING = ("varying size", "size over 10 s")


def test_the_page_shows_the_stored_rates() -> None:
    text = judge_blocks.PAGE.read_text()
    assert page(text, STORED, judge_blocks.START) == text
    assert page(text, [{**STORED[0], ALARMS: 0.9}, *STORED[1:]], judge_blocks.START) != text


@pytest.mark.parametrize("row", STORED, ids=str)
def test_equal_programs_are_rarely_called_different(row: dict[str, Any]) -> None:
    """The level is kept, or exceeded by less than a third where the size of errors varies over time, as the page says."""
    error = math.sqrt(judge_blocks.LEVEL * (1 - judge_blocks.LEVEL) / judge_blocks.STUDIES)
    excess = 1 / 3 if row["correlation"] in VARYING else 0.0
    assert row[ALARMS] <= judge_blocks.LEVEL * (1 + excess) + 2 * error * (not excess)


def test_the_rates_are_those_of_the_code() -> None:
    """60 studies: false alarms within 4 standard errors of the stored rate, the same share tested."""
    row = next(r for r in STORED if r["correlation time [s]"] == "5" and r["length [s]"] == 300)
    rates = judge_blocks.measure_rates("exponential", 5.0, 300, studies=60)
    assert rates["tested"] > 0.9
    for name in (ALARMS, "decided at 20 % smaller errors"):
        error = math.sqrt(row[name] * (1 - row[name]) / 60)
        assert abs(rates[name] - row[name]) <= 4 * error + 1 / 60
