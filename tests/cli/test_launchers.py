"""Presets of launchers, and what a sweep does if a launcher loses a process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from command_line import environment

from pfbench import job
from pfbench.cli.messages import format_error
from pfbench.cli.run import run_with_retries
from pfbench.door import worker
from pfbench.files.foreign_folder import start_python
from pfbench.job.config import compose_tree


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
