"""A current folder of another person: no child process takes code from it."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any


def make_child_environment() -> dict[str, str]:
    """Return the environment of a child process: this one, in which Python does not look into the current folder.

    An empty entry of PYTHONPATH is the current folder, so it is left out.
    """
    folders = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(folders)}


def start_python(program: str, **options: Any) -> subprocess.Popen[Any]:
    """Start a program in Python, which imports what this process can import and libraries first.

    Args:
        program: Source.
        options: Of `subprocess.Popen`, such as its streams.
    """
    current = os.getcwd()  # on the path of a notebook and of a script in this folder
    folders = sorted(map(os.path.abspath, sys.path), key=lambda folder: folder == current)
    command = [sys.executable, "-P", "-c", f"import sys; sys.path[:] = {folders!r}; {program}"]
    return subprocess.Popen(command, env=make_child_environment(), **options)
