"""Presets of launchers, and what a sweep does if a launcher loses a process."""

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

from pfbench import job
from pfbench.cli.messages import format_error
from pfbench.cli.run import run_with_retries
from pfbench.door import worker
from pfbench.files.foreign_folder import start_python
from pfbench.job.config import compose_tree
from pfbench.results import store


def launcher(name: str, *words: str) -> Any:
    return compose_tree([f"hydra/launcher={name}", *words]).hydra.launcher


# presets


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
    wanted = (
        "--requeue",
        "--cpus-per-task=2",
        "--mem=4GB",
        "--time=240",
        "--export=ALL,PYTHONSAFEPATH=1",
        "--job-name=pfbench",
    )
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
            "the sweep lost a process (TerminatedWorkerError). Running the remaining jobs"
        )
        == 1
    )
    ended = "worker stopped.\nThe exit codes of the workers are {EXIT(1), SIGKILL(-9)}"
    answers += [TerminatedWorkerError(ended)] * 9
    words = ["pfbench run", "-m", "filter=sir,rpf", "scenario=a b"]
    again = r"4 times \(.*\{EXIT\(1\), SIGKILL\(-9\)\}\).*n_jobs=2.*: pfbench run -m filter=sir,rpf 'scenario=a b'$"
    with mock.patch.object(sys, "argv", words), pytest.raises(RuntimeError, match=again):
        run_with_retries(sweep)
    assert len(answers) == 5
    answers[:] = [ValueError("a bad cell")] * 2
    with pytest.raises(ValueError, match="a bad cell"):
        run_with_retries(sweep)
    assert len(answers) == 1


# no child takes code or settings of the current folder

LIBRARIES = ("cloudpickle", "copy", "csv", "json", "pickle", "queue", "random")
AT_START = ("sitecustomize", "usercustomize")


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with modules that leave a file when they are imported, on the empty entry of PYTHONPATH too."""
    for name in (*LIBRARIES, *AT_START):
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'ran')!r}, 'a').write(__name__)"
        )
    (tmp_path / "mylab.py").write_text("NAME = 'trusted'")
    (tmp_path / "matplotlibrc").write_text("figure.facecolor: red")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep)
    return tmp_path


def ask(program: str, **more: str) -> str:
    with mock.patch.dict(os.environ, more):
        return str(
            start_python(program, stdout=subprocess.PIPE, text=True).communicate()[0]
        ).strip()


@pytest.mark.parametrize("before", [[], [""]])  # a notebook has the current folder first
def test_a_child_imports_libraries_and_trusted_packages(
    hostile: Path, monkeypatch: pytest.MonkeyPatch, before: list[str]
) -> None:
    program = (
        f"import {', '.join(LIBRARIES)}; from pfbench.job.trust import split_trust; "
        "split_trust(['trust=[mylab]']); import mylab; print(mylab.NAME)"
    )
    with monkeypatch.context() as patch:
        patch.setattr(sys, "path", [*before, *sys.path])
        said = ask(program)
    assert (said, (hostile / "ran").exists()) == ("trusted", False)


def test_figures_have_the_settings_of_the_user_and_not_of_the_current_folder(
    hostile: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    own = tmp_path_factory.mktemp("own") / "matplotlibrc"
    own.write_text("figure.facecolor: blue")
    show = "import matplotlib; print(matplotlib.rcParams['figure.facecolor'])"
    guard = "from pfbench import cli; cli.main(['--version']); "
    assert [ask(text).split()[-1] for text in (show, guard + show)] == ["red", "white"]
    assert ask(guard + show, MATPLOTLIBRC=str(own)).endswith("blue")


@pytest.mark.parametrize(
    ("end", "said"),
    [("os._exit(3)", "exit code 3"), ("os.kill(os.getpid(), 9)", "SIGKILL"), ("os.abort()", "SIGABRT")],
)  # fmt: skip
def test_a_worker_that_ends_says_how(monkeypatch: pytest.MonkeyPatch, end: str, said: str) -> None:
    monkeypatch.setattr(worker, "_PROGRAM", f"import os; sys.stdin.readline(); {end}")
    config = job.compose(["scenario=linear_walk", "filter=ekf"])
    with worker.WorkerPool(1) as pool:
        (_, reply), *_ = pool.run([config])
    assert f"ended with {said}." in reply.message


def test_a_pool_that_is_left_early_starts_no_worker_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """As after an interrupt, when the other jobs wait and a worker is at one."""
    monkeypatch.setattr(worker, "_PROGRAM", "import time; time.sleep(60)")
    config = job.compose(["scenario=linear_walk", "filter=ekf"])
    with worker.WorkerPool(1) as pool:
        (first,) = pool._processes
        replies = [pool._threads.submit(pool._ask, config) for _ in range(3)]
    pool._threads.shutdown()
    assert (pool._processes, first.poll()) == ([first], -signal.SIGKILL)
    assert [reply.cancelled() for reply in replies[1:]] == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["cores", "ray_local"])
def test_a_study_in_a_hostile_folder_runs_and_is_reported(hostile: Path, launcher: str) -> None:
    """The whole commands, with children of children."""
    pytest.importorskip("ray", reason='needs Ray: pip install "pfbench[ray]"')
    limit = (
        "hydra.launcher.n_jobs=2" if launcher == "cores" else "hydra.launcher.ray.init.num_cpus=2"
    )
    study = ("run", "-m", "scenario=linear_walk", "filter=sir,ekf", "runs=10", "study=mine")
    patient = {"RAY_raylet_start_wait_time_s": "300", "RAY_AUTH_MODE": "disabled"}
    for words in ((*study, f"hydra/launcher={launcher}", limit), ("report", "study=mine")):
        command = [sys.executable, "-P", "-m", "pfbench", *words]
        env = os.environ | environment(hostile) | patient | {"PYTHONPATH": ""}
        done = subprocess.run(command, env=env, cwd=hostile, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    assert not (hostile / "ran").exists()
    assert "#ff0000" not in (hostile / "reports" / "mine" / "headline.svg").read_text()


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
