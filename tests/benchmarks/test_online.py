"""The benchmark of latency: its page on made-up numbers, and one filter measured in a process of its own."""

from __future__ import annotations

import sys

import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import online


def test_the_page_states_how_busy_the_machine_was() -> None:
    row = {"filter": "sir", "particles": 500, "wall": 1.25, "wall_tail": 3.0, "cpu": 1.2, "cpu_tail": 1.5, "start": 0.5, "mib": 10.0}  # fmt: skip
    text = online.page({"cpu": "a CPU", "load": 0.1, "cores": 2, "steps": 500, "rows": [row]})
    assert "0.1 processes for 2 cores" in text
    assert "| `sir` | 500 | 1.25 | 3.00 | 1.20 | 1.50 | 0.5 | 10.0 |" in text


@pytest.mark.slow
def test_a_step_of_one_run_is_measured_apart() -> None:
    row = online.measure_apart("ekf", 0, 60)
    assert 0.0 < row["cpu"] <= row["cpu_tail"]
    assert 0.0 < row["wall"] <= row["wall_tail"]
    assert row["mib"] >= 0.0 < row["start"]
