"""A sweep over several processes: the numbers of one, and a lost worker or node costs its own cell only, which is done again."""

from __future__ import annotations

import os
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
from hydra import compose, initialize_config_dir

from pfbench import job
from pfbench.cli.messages import format_error
from pfbench.cli.run import run_with_retries
from pfbench.results import store

FILTERS = ("sir", "rpf", "apf", "gpf")
SWEEP = (
    "run",
    "-m",
    "scenario=linear_walk",
    "scenario.steps=150",
    "runs=10",
    "particles=200",
    f"filter={','.join(FILTERS)}",
)
QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "disabled", "PYTHONUNBUFFERED": "1"}


def launcher(name: str, *words: str) -> Any:
    with initialize_config_dir(str(job.conf_dir()), version_base="1.3"):
        composed = compose("config", [f"hydra/launcher={name}", *words], return_hydra_config=True)
    return composed.hydra.launcher


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


# presets


def test_every_core_gets_a_cell_by_joblib() -> None:
    preset = launcher("cores")
    assert (preset.n_jobs, preset.batch_size) == (-1, "1")


def test_slurm_gets_what_the_job_needs() -> None:
    pytest.importorskip(
        "hydra_plugins.hydra_submitit_launcher",
        reason='needs submitit: pip install "pfbench[slurm]"',
    )
    preset = launcher("slurm", "threads=4", "hydra.launcher.partition=short")
    assert (preset.cpus_per_task, preset.partition, preset.additional_parameters.requeue) == (
        4,
        "short",
        True,
    )


def test_the_script_for_slurm_is_one_array_that_is_queued_again(tmp_path: Path) -> None:
    """What submitit would hand to sbatch, without a cluster."""
    slurm = pytest.importorskip(
        "submitit.slurm.slurm", reason='needs submitit: pip install "pfbench[slurm]"'
    )
    preset = launcher("slurm", "threads=2", "hydra.launcher.setup=[module load python]")
    more = (
        "partition",
        "account",
        "qos",
        "constraint",
        "exclude",
        "gres",
        "additional_parameters",
        "array_parallelism",
        "setup",
    )
    given = {name: preset[name] for name in more if preset[name] is not None}
    given |= {
        "additional_parameters": dict(preset.additional_parameters),
        "setup": list(preset.setup),
    }
    script = slurm._make_sbatch_string(
        command="run", folder=tmp_path, job_name=preset.name, time=preset.timeout_min, mem=f"{preset.mem_gb}GB",
        cpus_per_task=preset.cpus_per_task, map_count=12, **given,
    )  # fmt: skip
    lines = script.splitlines()
    assert any(line.startswith("#SBATCH --array=0-11") for line in lines)
    wanted = ("--requeue", "--cpus-per-task=2", "--mem=4GB", "--time=240", "--job-name=pfbench")
    assert [option for option in wanted if f"#SBATCH {option}" not in lines] == []
    assert "module load python" in lines


def test_ray_retries_a_cell_and_never_joins_a_cluster_by_accident() -> None:
    pytest.importorskip(
        "hydra_plugins.hydra_ray_launcher", reason='needs Ray: pip install "pfbench[ray]"'
    )
    local, cluster = (launcher(name, "threads=2").ray for name in ("ray_local", "ray_cluster"))
    assert (local.init.address, cluster.init.address, cluster.init.object_store_memory) == (
        "local",
        "auto",
        None,
    )
    for preset in (local, cluster):
        assert (preset.remote.max_retries, preset.remote.num_cpus) == (3, 2)


def test_a_launcher_that_is_not_installed_is_told_with_the_remedy() -> None:
    absent = Exception(
        "In 'hydra/launcher/ray_local': Could not find 'hydra/launcher/ray'\n\nAvailable options:\n\tbasic\n"
    )
    assert 'pip install "pfbench[ray]"' in format_error(absent, ["hydra/launcher=ray_local"])


# a process that joblib lost takes the whole sweep with it


class TerminatedWorkerError(Exception):
    """Called as joblib's own is."""


class LocalRayletDiedError(Exception):
    """Called as Ray's own is."""


def test_a_sweep_that_lost_a_process_goes_on_and_gives_up_in_the_end(
    capsys: pytest.CaptureFixture[str],
) -> None:
    answers: list[Exception | None] = [TerminatedWorkerError(), LocalRayletDiedError(), None]

    def sweep() -> None:
        answer = answers.pop(0)
        if answer is not None:
            raise answer

    run_with_retries(sweep)
    assert answers == []
    assert (
        capsys.readouterr().err.count(
            "a process of the sweep was killed. Running the remaining jobs"
        )
        == 2
    )
    answers += [TerminatedWorkerError()] * 9
    words = ["pfbench run", "-m", "filter=sir,rpf", "scenario=a b"]
    again = r"killed 4 times.*n_jobs=2.*: pfbench run -m filter=sir,rpf 'scenario=a b'$"
    with mock.patch.object(sys, "argv", words), pytest.raises(RuntimeError, match=again):
        run_with_retries(sweep)
    assert len(answers) == 5
    answers[:] = [ValueError("a bad cell")] * 2
    with pytest.raises(ValueError, match="a bad cell"):
        run_with_retries(sweep)
    assert len(answers) == 1


# real processes


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, np.ndarray]]:
    """The sweep in one process."""
    home = tmp_path_factory.mktemp("alone")
    said = pfbench(*SWEEP, home=home)
    assert said.code == 0, said.err
    return numbers(home)


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


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="workers are looked up in /proc"
)
def test_a_killed_worker_of_ray_costs_its_own_cell_which_is_done_again(
    tmp_path: Path, alone: dict[str, dict[str, np.ndarray]]
) -> None:
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    words = ("hydra/launcher=ray_local", "hydra.launcher.ray.init.num_cpus=2")
    with started(tmp_path, *words) as sweep:
        wait(lambda: numbers(tmp_path), sweep)
        done = {
            file: file.stat().st_mtime_ns for file in (tmp_path / "results" / "adhoc").glob("*.npz")
        }
        victim = wait(lambda: processes_of(tmp_path, "ray::_run_job"), sweep)[0]
        os.kill(victim, signal.SIGKILL)
        _, err = sweep.communicate(timeout=120)
    assert sweep.returncode == 0, err
    assert_same(numbers(tmp_path), alone)
    assert {file: file.stat().st_mtime_ns for file in done} == done


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="workers are looked up in /proc"
)
def test_a_killed_scheduler_of_ray_is_started_again(
    tmp_path: Path, alone: dict[str, dict[str, np.ndarray]]
) -> None:
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    words = ("hydra/launcher=ray_local", "hydra.launcher.ray.init.num_cpus=2")
    with started(tmp_path, *words) as sweep:
        wait(lambda: numbers(tmp_path), sweep)
        victim = wait(lambda: processes_of(tmp_path, "raylet/raylet"), sweep)[0]
        os.kill(victim, signal.SIGKILL)
        _, err = sweep.communicate(timeout=180)
    assert sweep.returncode == 0, err
    assert "a process of the sweep was killed" in err
    assert_same(numbers(tmp_path), alone)


@pytest.mark.slow
def test_a_lost_node_costs_its_own_cell_which_is_done_again(
    tmp_path: Path, alone: dict[str, dict[str, np.ndarray]]
) -> None:
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    from ray.cluster_utils import Cluster

    with mock.patch.dict(os.environ, QUIET):
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
        try:
            with started(
                tmp_path, "hydra/launcher=ray_cluster", RAY_ADDRESS=cluster.address
            ) as sweep:
                wait(lambda: numbers(tmp_path), sweep)
                time.sleep(0.3)  # well into the next cells
                cluster.remove_node(nodes[0], allow_graceful=False)
                _, err = sweep.communicate(timeout=120)
        finally:
            cluster.shutdown()
    assert sweep.returncode == 0, err
    assert_same(numbers(tmp_path), alone)
