"""The benchmark of whole processes: its table on made-up results, and processes that it starts."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import campaigns
import workload
from race import Result

RUN_BY_RUN = campaigns.CONTESTANTS[-1]


def result(cpu: list[float]) -> Result:
    evidence = np.random.default_rng(1).standard_normal((15, 8))
    qualities = {"evidence": evidence, "normalised": evidence, "position": evidence}
    return Result(np.array(cpu), np.array(cpu), qualities, {}, 0.0)


def test_goals_are_judged_by_the_faster_jax_and_the_best_engine(tmp_path: Path) -> None:
    found = {
        campaigns.LOOPS: result([4e3, 5e3, 6e3]), campaigns.EAGER: result([8e3, 8e3, 8e3]),
        campaigns.PARTICLES: result([8e3, 10e3, 12e3]), campaigns.JAX: result([40e3, 40e3, 40e3]),
        RUN_BY_RUN: result([16e3, 20e3, 24e3]),
    }  # fmt: skip
    lines = campaigns.table(found, [])
    label = campaigns.LOOPS.label
    assert f"| particles float32 | {label} | 2.00 (2.00-2.00) | 1.5, met | 2.5, missed |" in lines
    assert f"| JAX, run by run | {label} | 4.00 (4.00-4.00) | 2.5, met | 4, met |" in lines
    assert any(
        line.startswith(f"| {label} | 5 (4.5-5.5) | 5 | 2.00 (2.00-2.00) | 4.00 (4.00-4.00) |")
        for line in lines
    )
    assert lines[-1] == "All contestants agree."
    campaigns.draw(found, tmp_path / "campaigns.png")
    assert (tmp_path / "campaigns.png").stat().st_size > 1000


def test_a_peer_that_took_no_part_leaves_its_column_empty() -> None:
    lines = campaigns.table(
        {campaigns.EAGER: result([8e3, 8e3, 8e3])}, ["particles float32: it did not run"]
    )
    assert any(
        line.startswith(f"| {campaigns.EAGER.label} | 8 (8-8) | 8 | - | - |") for line in lines
    )
    assert lines[-1] == "**Not the same work:** particles float32: it did not run."


WORKER = """
import json, sys
print(json.dumps({"versions": {}}))
for line in sys.stdin:
    print(json.dumps(int(line.split()[1])))
sum(range(10**7))
"""


def test_a_process_is_measured_to_its_end() -> None:
    spent = campaigns.one([sys.executable, "-c", WORKER], os.environ, turn=2)
    assert spent is not None
    cpu, wall, told = spent
    assert told == [
        {"versions": {}},
        13,
        14,
        15,
        16,
        17,
    ]  # the first of six campaigns is the one before it listens
    assert min(cpu, wall) > 20.0  # ms
    assert campaigns.one([sys.executable, "-c", "raise SystemExit(3)"], os.environ, turn=0) is None


@pytest.mark.slow
def test_fresh_processes_compute_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        campaigns, "CONTESTANTS", (campaigns.LOOPS, campaigns.EAGER, campaigns.PARTICLES)
    )
    monkeypatch.setattr(campaigns, "CAMPAIGNS", 3)
    work = {**workload.make(4, 10, 100)._asdict(), "kind": np.array("ins")}
    found = campaigns.race(work, {"own": sys.executable}, rounds=1)
    assert list(found) == [campaigns.LOOPS, campaigns.EAGER]
    told = {who: taken for who, taken in found.items() if taken is not None}
    assert len(told) == 2
    assert all(
        taken.qualities["evidence"].shape == (2, 4) and taken.cpu > 0.0 for taken in told.values()
    )
    first, second = (taken.qualities["evidence"] for taken in told.values())
    assert np.abs(first - second).max() < 0.5  # the same draws
