"""The start of a command imports what it needs: no torch for a version or a finished job, no tables for a job."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from pfbench.job.inputs import READERS
from pfbench.job.trust import FOLDERS

ROOT = Path(__file__).parents[2]
JOB = ("run", "scenario=linear_walk", "scenario.steps=5", "runs=1", "particles=20", "filter=sir")
TABLES = {"pandas", "pyarrow", "scipy.stats", "scoringrules", "matplotlib"}


def list_imports(folder: Path, *words: str) -> set[str]:
    code = (
        f"import sys; from pfbench.cli import main; main({list(words)!r}); "
        "print(*sys.modules, file=sys.stderr)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True, text=True, check=True, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    return set(run.stderr.split())


def test_a_start_imports_what_it_needs(tmp_path: Path) -> None:
    assert not {"numpy", "torch", "hydra"} & list_imports(tmp_path, "--version")
    computed = list_imports(tmp_path, *JOB)
    assert "torch" in computed
    assert not TABLES & computed
    assert not {"torch", *TABLES} & list_imports(tmp_path, *JOB)  # it is finished


def test_the_readers_are_the_public_classes_that_name_files() -> None:
    doors = {folder: import_module(f"pfbench.{folder}") for folder in FOLDERS}
    readers = {
        folder: tuple(n for n in sorted(door.__all__) if hasattr(getattr(door, n), "input_files"))
        for folder, door in doors.items()
    }
    assert {folder: names for folder, names in readers.items() if names} == READERS
