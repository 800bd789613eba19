"""README.md and docs/python.md run as scripts in empty folders: their classes are those of a script, as a reader's are."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from checkout import ROOT
from command_line import environment


def run_page(page: Path, tmp_path: Path) -> str:
    """Run all Python of a page as one script; return what it prints."""
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    script = tmp_path / "page.py"
    script.write_text("\n\n".join(blocks))
    env = os.environ | environment(tmp_path) | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_readme_runs_as_a_script_and_prints_its_leaderboard(tmp_path: Path) -> None:
    printed = run_page(ROOT / "README.md", tmp_path)
    assert printed.count(", 0 failed in") == 2
    sentence = "Of 3 filters, 3 are better than EKF in Growth model with nominal noise (first in the table: RPF, 0.25"
    assert sentence in printed
    readme = (ROOT / "README.md").read_text()
    assert sentence in readme
    for row in re.findall(r"^\d  .*$", readme, re.M):  # without the columns of tracks and times
        line = next(x for x in printed.splitlines() if x.startswith(row[:8]))
        assert set(re.split(" {2,}", row)) <= set(re.split(" {2,}", line)), line


@pytest.mark.slow
def test_the_examples_of_the_page_run_as_a_script(tmp_path: Path) -> None:
    printed = run_page(ROOT / "docs" / "python.md", tmp_path)
    assert "FAILS" not in printed
    assert printed.count(", 0 failed in") == 10  # studies of the page
    assert {path.name for path in (tmp_path / "results").iterdir()} == {
        "first",
        "settings",
        "mine",
        "resamplers",
        "inflated",
        "buoy",
        "public",
        "beside",
        "room",
        "road",
    }
    assert (tmp_path / "time.png").stat().st_size > 5000
