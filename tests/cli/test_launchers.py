"""Presets of launchers, and what a sweep does if a launcher loses a process."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hydra import compose, initialize_config_dir

from pfbench import job
from pfbench.cli.messages import format_error
from pfbench.cli.run import run_with_retries


def launcher(name: str, *words: str) -> Any:
    with initialize_config_dir(str(job.conf_dir()), version_base="1.3"):
        composed = compose("config", [f"hydra/launcher={name}", *words], return_hydra_config=True)
    return composed.hydra.launcher


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
