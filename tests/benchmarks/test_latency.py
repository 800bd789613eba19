"""The benchmark of waiting times: its verdicts on made-up times, and the time before the first step of a run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import latency


def test_a_goal_is_judged_by_the_median_of_the_cpu_time_and_missed_ones_come_first() -> None:
    found = {
        "first_step": [(1.4, 9.0), (1.4, 9.0), (9.0, 9.0)],
        "check": [(9.0, 9.0), (11.0, 9.0), (12.0, 9.0)],
        "report": [(10.0, 99.0)] * 3,
    }
    lines = latency.page(found)
    check = latency.GOALS[1].said
    assert lines[2] == f"Missed: {check}: 11.0 s, must 10 s."
    assert f"| {latency.GOALS[0].said} | 1.40 (1.40-5.20) | 9.00 | 1.5, met |" in lines
    assert f"| {check} | 11.00 (10.00-11.50) | 9.00 | 10, missed |" in lines
    assert f"| {latency.GOALS[2].said} | 10.00 (10.00-10.00) | 99.00 | 10, met |" in lines


@pytest.mark.slow
def test_the_first_step_comes_before_the_end_of_the_command(tmp_path: Path) -> None:
    cpu, wall = latency.first_step(tmp_path, 0)
    assert 0.1 < cpu < wall  # one thread
    assert list((tmp_path / "results" / "n0").glob("*.npz"))
