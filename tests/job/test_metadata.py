"""The commit in the provenance of results: marked as changed only by what can change a result."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from command_line import plant_programs, run_git as git

from pfbench.job import trust
from pfbench.job.plan import describe_commit

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def test_only_files_that_decide_results_mark_a_commit(tmp_path: Path) -> None:
    decide = ("pfbench/a.py", "conf/b.yaml", "experiments/e.yaml", "setup.py")
    others = ("reports/x/report.md", "docs/c.md", "experiments/analyses/d.json")
    assert describe_commit(tmp_path) == ""
    for name in decide + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    commit = git(tmp_path, "rev-parse", "--short", "HEAD")
    (tmp_path / "pfbench" / "a.py").touch()
    for name in others:
        (tmp_path / name).write_text("new")
    assert describe_commit(tmp_path) == commit
    for name in decide:
        (tmp_path / name).write_text("new")
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "add", name)
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "reset", "-q", "--hard")


def test_the_repository_of_another_project_is_not_that_of_pfbench(tmp_path: Path) -> None:
    """As of an environment in the folder of a user's project."""
    inside = tmp_path / "env" / "site-packages"
    inside.mkdir(parents=True)
    (tmp_path / "a.txt").write_text("theirs")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    assert describe_commit(tmp_path) != ""
    assert describe_commit(inside) == ""
    ran = plant_programs(tmp_path)
    subprocess.run(["git", "-C", str(tmp_path), "diff", "HEAD"], capture_output=True)
    assert ran.exists()  # the programs do run
    ran.unlink()
    assert describe_commit(tmp_path) == git(tmp_path, "rev-parse", "--short", "HEAD")
    assert describe_commit(inside) == ""
    assert not ran.exists()


@pytest.mark.parametrize(
    ("name", "text", "is_same"),
    [
        ("a.py", "x = 1\n", True),  # written again
        ("__pycache__/a.pyc", "other", True),
        ("kernels/operators_avx2.so", "other", True),
        ("a.py", "x = 2\n", False),
        ("kernels/b.cpp", "int x;", False),
        ("conf/noise/n.yaml", "sd: 2", True),
        ("experiments/e.yaml", "runs: 2", True),
    ],
)
def test_two_wheels_of_other_sources_are_other_builds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str, is_same: bool
) -> None:
    """Without git, whatever the times and the compiled files are."""
    files = {"a.py": "x = 1\n", "conf/noise/n.yaml": "sd: 1", "experiments/e.yaml": "runs: 1"}

    def build(folder: Path, files: dict[str, str]) -> str:
        for file, content in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(content)
        monkeypatch.setattr(trust, "PACKAGE", folder)
        monkeypatch.setattr(trust, "conf_dir", lambda: folder / "conf")
        monkeypatch.setattr(trust, "experiments_dir", lambda: folder / "experiments")
        return trust.hash_package.__wrapped__()

    first = build(tmp_path / "one", files)
    assert (build(tmp_path / "two", {**files, name: text}) == first) == is_same
