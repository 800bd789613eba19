"""A sweep by Ray: the numbers of one process, and a lost worker or node costs its own cell only, which is done again."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from command_line import GONE, environment, pfbench, processes_of

from pfbench.results import store

FILTERS = ("sir", "apf", "gpf")
SWEEP = (
    "run",
    "-m",
    "scenario=linear_walk",
    "scenario.steps=600",  # a cell takes half a second or so, many times the interval at which the tests look
    "runs=10",
    "particles=200",
    f"filter={','.join(FILTERS)}",
)
QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "PYTHONUNBUFFERED": "1",
    # a dead node is seen after 1.5 s, not 15 s; each check may still take 10 s, so that a busy machine loses none
    "RAY_health_check_initial_delay_ms": "500", "RAY_health_check_period_ms": "500",
    "RAY_health_check_failure_threshold": "3",
}  # fmt: skip
LOST = "the sweep lost a process"


def numbers(home: Path) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of all finished cells, by filter."""
    found = map(store.read_result, sorted((home / "results" / "adhoc").glob("*.npz")))
    return {result.meta["label"]: result.data for result in found}


def assert_same(
    ours: dict[str, dict[str, np.ndarray]], theirs: dict[str, dict[str, np.ndarray]]
) -> None:
    assert set(ours) == set(theirs) == set(FILTERS)
    for name in FILTERS:
        assert ours[name].keys() == theirs[name].keys()
        for part, values in ours[name].items():
            np.testing.assert_array_equal(values, theirs[name][part], err_msg=f"{name}: {part}")


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The home of the sweep in one process."""
    home = tmp_path_factory.mktemp("alone")
    said = pfbench(*SWEEP, home=home)
    assert said.code == 0, said.err
    return home


@contextmanager
def started(home: Path, *words: str, **more: str) -> Iterator[subprocess.Popen[str]]:
    """The sweep as a process of its own; whatever it left behind is gone afterwards."""
    env = os.environ | environment(home) | QUIET | more
    command = [sys.executable, "-m", "pfbench", *SWEEP, *words]
    pipe = subprocess.PIPE
    sweep = subprocess.Popen(
        command, env=env, cwd=home, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )
    try:
        yield sweep
    finally:
        for process in (*processes_of(home, ""), sweep.pid):
            with suppress(*GONE):
                os.kill(process, signal.SIGKILL)
        sweep.communicate()


def wait(what: Callable[[], Any], sweep: subprocess.Popen[str], seconds: float = 300.0) -> Any:
    """The first true answer."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if found := what():
            return found
        assert sweep.poll() is None, sweep.communicate()[1]
        time.sleep(0.02)
    raise AssertionError("nothing happened")


def is_below(process: int, parent: int) -> bool:
    """Return whether a process was started by another."""
    with suppress(*GONE):
        return f"PPid:\t{parent}\n" in Path(f"/proc/{process}/status").read_text()
    return False


def finish(sweep: subprocess.Popen[str], home: Path) -> str:
    """Return what a sweep wrote to stderr, after results that it does not change any more."""
    done = {file: file.stat().st_mtime_ns for file in (home / "results" / "adhoc").glob("*.npz")}
    _, err = sweep.communicate(timeout=400)
    assert sweep.returncode == 0, err
    assert {file: file.stat().st_mtime_ns for file in done} == done
    return err


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="workers are looked up in /proc"
)


@pytest.mark.slow
@needs_proc
def test_a_killed_scheduler_of_ray_is_started_again(tmp_path: Path, alone: Path) -> None:
    """One worker, since each starts in seconds. A cell that is done already is left as it is."""
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    folder = tmp_path / "results" / "adhoc"
    folder.mkdir(parents=True)
    shutil.copy(next((alone / "results" / "adhoc").glob("*.npz")), folder)
    words = ("hydra/launcher=ray_local", "hydra.launcher.ray.init.num_cpus=1")
    with started(tmp_path, *words) as sweep:
        # a worker in its first cell still has to import torch, so that the sweep cannot end before the kill
        wait(lambda: processes_of(tmp_path, "ray::_run_job"), sweep)
        os.kill(wait(lambda: processes_of(tmp_path, "raylet/raylet"), sweep)[0], signal.SIGKILL)
        assert finish(sweep, tmp_path).count(LOST) == 1
    assert_same(numbers(tmp_path), numbers(alone))


@pytest.mark.slow
@needs_proc
def test_a_lost_node_and_a_killed_worker_cost_their_own_cells_which_are_done_again(
    tmp_path: Path, alone: Path
) -> None:
    """A node dies in its first cell, then the only other worker dies in a later one; Ray repeats these cells alone."""
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    from ray.cluster_utils import Cluster

    def at_work(node: Any) -> list[int]:
        raylet = node.all_processes["raylet"][0].process.pid
        return [p for p in processes_of(tmp_path, "ray::_run_job") if is_below(p, raylet)]

    with mock.patch.dict(os.environ, QUIET):
        cluster = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False}
        )
        node = cluster.add_node(num_cpus=1)
        try:
            with started(
                tmp_path, "hydra/launcher=ray_cluster", RAY_ADDRESS=cluster.address
            ) as sweep:
                wait(lambda: at_work(node), sweep)
                cluster.remove_node(node, allow_graceful=False)
                wait(lambda: numbers(tmp_path), sweep)
                victim = wait(lambda: at_work(cluster.head_node), sweep)[0]
                os.kill(victim, signal.SIGKILL)
                assert LOST not in finish(sweep, tmp_path)
        finally:
            cluster.shutdown()
    assert_same(numbers(tmp_path), numbers(alone))
