"""The GPU benchmark, on the CPU: what it counts, what it reports, and what it says where there is no GPU."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import gpu
import workload

CPU = torch.device("cpu")
compiles = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no C++ compiler"
)


def counted(what: Callable[[], object]) -> int:
    with gpu.Traffic() as traffic:
        what()
    return traffic.bytes


def test_operations_move_their_arguments_and_results() -> None:
    a, b, column = torch.ones(10, 20), torch.ones(10, 20, dtype=torch.float64), torch.ones(10, 1)
    assert counted(lambda: a + a) == 3 * 800
    assert counted(lambda: a.add_(1.0)) == 2 * 800
    assert counted(lambda: a + column.expand(10, 20)) == 2 * 800 + 40
    assert counted(lambda: a @ torch.empty(20, 5)) == 800 + 400 + 200
    assert counted(lambda: b.float()) == 1600 + 800
    assert counted(lambda: a.T.unsqueeze(0)[:, 3:].reshape(1, 17, 10)) == 0
    assert counted(lambda: torch.empty(1000)) == 0


def test_a_step_moves_more_than_it_needs() -> None:
    model, record = gpu.model_and_record(workload.make(4, 10, 300), torch.float32)
    found = gpu.moved(model, record, 300)
    assert found.whole > found.noise > gpu.NEEDED == 144


@compiles
def test_engines_agree_and_are_reported() -> None:
    work = workload.make(6, 10, 60)
    found = [gpu.measure(engine, work, CPU, rounds=2) for engine in ("kernels", "eager")]
    assert gpu.disagreements(found) == []
    assert [len(one.seconds) for one in found] == [2, 2]
    page = gpu.page(found, [], 1e10, CPU)
    assert "All engines agree." in page
    assert page.count("| 6 x 60 x 10 |") == 2
    off = found[1]._replace(evidence=found[1].evidence + 0.1)
    assert len(gpu.disagreements([found[0], off])) == 1
    lost = found[1]._replace(evidence=np.full(6, -np.inf))
    assert len(gpu.disagreements([found[0], lost])) == 1


def test_goals_are_those_of_the_first_size() -> None:
    one = gpu.Measured(
        "compiled",
        *gpu.SIZES[0],
        1000,
        9.0,
        [0.3, 0.4, 0.5],
        2**30,
        None,
        np.linspace(-0.1, 0.1, 1000),
    )
    rate = 144 * 1000 * 10_000 * 200 / 0.4 / 0.6  # of which 0.6 is put to use
    assert "| seconds | 0.4 | 0.5, met | 0.2, missed |" in gpu.goals([one], rate)
    assert "| bytes needed, share of the copy rate | 0.6 | 0.5, met | - |" in gpu.goals([one], rate)
    assert gpu.goals([one._replace(runs=999)], rate) == []


def test_a_device_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--device", "cuda:99"])
    with pytest.raises(SystemExit, match="--device cpu --scale"):
        gpu.main()


@compiles
@pytest.mark.slow
def test_the_whole_of_it_runs_on_the_cpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    # at this scale the two sizes are one, which is compiled once
    words = [
        "gpu.py",
        "--device",
        "cpu",
        "--scale",
        "0.001",
        "--rounds",
        "1",
        "--out",
        str(tmp_path),
    ]
    monkeypatch.setattr(sys, "argv", words)
    monkeypatch.setattr(gpu, "copy_rate", partial(gpu.copy_rate, rounds=1, copies=1))
    with pytest.raises(SystemExit) as end:
        gpu.main()
    assert end.value.code == 0
    assert "| compiled |" in (tmp_path / "gpu.md").read_text()
