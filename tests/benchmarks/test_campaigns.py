"""The benchmark of whole processes: its tables on made-up results, and processes that it starts."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import campaigns
import problems
import race
import workload
from compare import EAGER, LOOPS
from race import Result

STUDY = campaigns.STUDIES[0]


def result(cpu: list[float]) -> Result:
    evidence = np.random.default_rng(1).standard_normal((6, 8))
    qualities = {"evidence": evidence, "normalised": evidence, "position": evidence}
    return Result(np.array(cpu), np.array(cpu), qualities, {}, 0.0)


def test_goals_are_judged_by_default_settings_with_a_stored_step_and_the_faster_form_of_each_library() -> (
    None
):
    found = {
        campaigns.DEFAULT: result([7e3, 7e3, 7e3]), campaigns.STORED: result([4e3, 5e3, 6e3]),
        campaigns.FLOAT32: result([2e3, 2e3, 2e3]),
        campaigns.PARTICLES: result([14e3, 17.5e3, 21e3]), campaigns.COUNT: result([40e3] * 3),
        campaigns.RUN_BY_RUN: result([10e3, 12.5e3, 15e3]),
    }  # fmt: skip
    rows, missed = campaigns.verdicts(STUDY, found)
    default, label = campaigns.DEFAULT.label, campaigns.STORED.label
    assert rows == [
        f"| six campaigns of W4 | {default} | particles float32 | 2.50 (2.25-2.75) | - | - |",
        f"| six campaigns of W4 | {label} | particles float32 | 3.50 (3.50-3.50) | 2, met | 3, met |",
        f"| six campaigns of W4 | {label} | JAX, run by run | 2.50 (2.50-2.50) | 3, missed | 4, missed |",
    ]
    assert missed == [f"six campaigns of W4, {label}: 2.50 times JAX, run by run, must 3"]
    lines = campaigns.section(STUDY, found, [])
    start = f"| {label} | 5 (4.5-5.5) | 5 | 2.50 (2.50-2.50) |"
    assert any(line.startswith(start) for line in lines)
    assert lines[-1] == "All contestants agree."
    assert f"Not timed: {campaigns.DEFAULT32.label}." in lines


def test_the_least_time_is_the_start_and_the_fused_loop(tmp_path: Path) -> None:
    """Median start 2 s and 100 runs of 30 ms make 5 s; half of 7 s is asked for."""
    (tmp_path / "latency.json").write_text('{"first_step": [[1.0, 9.0], [2.0, 9.0], [4.0, 9.0]]}')
    assert campaigns.least_time(tmp_path, 7.0, 2.0) == ""
    race.store_results(
        tmp_path / "compare.json", "W1, N = 1e4", {"fused C": result([20.0, 30.0, 40.0])}
    )
    text = campaigns.least_time(tmp_path, 7.0, 2.0)
    assert "(2.00 s, latency.md)" in text
    assert "(3.00 s, compare.md) take 5.00 s together; the must is 3.50 s." in text


def test_a_peer_that_took_no_part_leaves_its_column_empty() -> None:
    found = {campaigns.DEFAULT: result([8e3, 8e3, 8e3])}
    assert campaigns.verdicts(STUDY, found) == ([], [])
    lines = campaigns.section(STUDY, found, ["particles float32: it did not run"])
    assert any(
        line.startswith(f"| {campaigns.DEFAULT.label} | 8 (8-8) | 8 | - |") for line in lines
    )
    assert lines[-1] == "**Not the same work:** particles float32: it did not run."


@pytest.mark.parametrize("kind", ["growth", "volatility", "radar"])
def test_runs_of_a_workload_are_different_worlds(kind: str) -> None:
    work = problems.make(kind, 20, 10, runs=3)
    alone = problems.make(kind, 20, 10)
    assert work.y.shape[:2] == work.truth.shape[:2] == (3, 20)
    assert alone.y.shape[0] == 1
    assert np.abs(np.diff(work.y, axis=0)).max(1).min() > 0.0


WORKER = """
import json, sys
print(json.dumps({"versions": {}}))
for line in sys.stdin:
    print(json.dumps(int(line.split()[1])))
sum(range(10**7))
"""


def test_a_process_is_measured_to_its_end() -> None:
    spent = campaigns.one([sys.executable, "-c", WORKER], os.environ, seeds=6)
    assert spent is not None
    cpu, wall, told = spent
    assert told == [{"versions": {}}, 1, 2, 3, 4, 5]
    assert min(cpu, wall) > 20.0  # ms
    assert campaigns.one([sys.executable, "-c", "raise SystemExit(3)"], os.environ, seeds=6) is None


@pytest.mark.slow
def test_fresh_processes_compute_the_same() -> None:
    study = STUDY._replace(contestants=(LOOPS, EAGER, campaigns.PARTICLES), seeds=3)
    work = {**workload.make(4, 10, 100)._asdict(), "kind": np.array("ins")}
    found = campaigns.race(study, work, {"own": sys.executable}, rounds=1)
    assert list(found) == [LOOPS, EAGER]
    told = {who: taken for who, taken in found.items() if taken is not None}
    assert len(told) == 2
    assert all(
        taken.qualities["evidence"].shape == (3, 4) and taken.cpu > 0.0 for taken in told.values()
    )
    first, second = (taken.qualities["evidence"] for taken in told.values())
    assert np.abs(first - second).max() < 0.5  # the same draws
