"""The commit in the provenance of results: marked as changed only by what can change a result."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from pfbench.job.metadata import describe_commit

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder: Path, *words: str) -> str:
    names = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", "-C", str(folder), *names, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_only_files_that_decide_results_mark_a_commit(tmp_path: Path) -> None:
    files = ("pfbench/a.py", "conf/b.yaml", "setup.py", "reports/x/report.md", "docs/c.md")
    assert describe_commit(tmp_path) == ""
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("old")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    commit = git(tmp_path, "rev-parse", "--short", "HEAD")
    (tmp_path / "pfbench" / "a.py").touch()
    for name in files[3:]:
        (tmp_path / name).write_text("new")
    assert describe_commit(tmp_path) == commit
    for name in files[:3]:
        (tmp_path / name).write_text("new")
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "add", name)
        assert describe_commit(tmp_path) == f"{commit}-dirty", name
        git(tmp_path, "reset", "-q", "--hard")
