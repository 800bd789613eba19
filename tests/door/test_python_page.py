"""The page docs/python.md runs as one script in an empty folder: its classes are those of a script, as a reader's are."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from checkout import ROOT
from command_line import environment


@pytest.mark.slow
def test_the_examples_of_the_page_run_as_a_script(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "python.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    script = tmp_path / "page.py"
    script.write_text("\n\n".join(blocks))
    env = os.environ | environment(tmp_path) | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "FAILS" not in done.stdout
    assert done.stdout.count(", 0 failed in") == 4  # studies of the page
    assert {path.name for path in (tmp_path / "results").iterdir()} == {
        "first",
        "settings",
        "mine",
        "room",
    }
    assert (tmp_path / "time.png").stat().st_size > 5000
