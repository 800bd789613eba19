"""A current folder of another person: no child process and no library takes code or settings from it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

_Execute = Callable[[ModuleType], None]


def make_child_environment() -> dict[str, str]:
    """Return the environment of a child process: this one, in which Python does not look into the current folder.

    An empty entry of PYTHONPATH is the current folder, so it is left out.
    """
    folders = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(folders)}


def start_python(
    program: str, more: Mapping[str, str] | None = None, **options: Any
) -> subprocess.Popen[Any]:
    """Start a program in Python, which imports what this process can import and libraries first.

    Args:
        program: Source.
        more: Additional environment variables.
        options: Of `subprocess.Popen`, such as its streams.
    """
    here = os.getcwd()  # on the path of a notebook and of a script beside it
    folders = sorted(map(os.path.abspath, sys.path), key=lambda folder: folder == here)
    command = [sys.executable, "-P", "-c", f"import sys; sys.path[:] = {folders!r}; {program}"]
    return subprocess.Popen(command, env={**make_child_environment(), **(more or {})}, **options)


def describe_end(code: int) -> str:
    """Describe how a process ended and, for people, what that may mean."""
    if code == -signal.SIGKILL:
        return "was killed (SIGKILL), as the system does if memory is short"
    if code < 0:
        return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}, for the reason that its own lines above state"


# --------------------------------------------------------------------------------------------------
# Libraries that look into the current folder when they are imported.


def guard_imports() -> None:
    """Let libraries that are imported from now on leave the current folder out."""
    if _Guard not in sys.meta_path:
        sys.meta_path.insert(0, _Guard)


def _import_matplotlib(execute: _Execute, module: ModuleType) -> None:
    """Import matplotlib, which reads the file `matplotlibrc` of the current folder before that of the user."""
    exists = os.path.exists
    os.path.exists = lambda path: path != "matplotlibrc" and exists(path)
    try:
        execute(module)
    finally:
        os.path.exists = exists


def _import_ray_jobs(execute: _Execute, module: ModuleType) -> None:
    """Import Ray's settings of a job, which put the current folder before all libraries of a worker."""
    execute(module)
    module.JobConfig._runtime_env_has_working_dir = lambda self: True


_LOOKING = {"matplotlib": _import_matplotlib, "ray.job_config": _import_ray_jobs}


class _Guard:
    """Finder of the libraries in `_LOOKING`."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Find a library, whose import then leaves the current folder out."""
        spec = PathFinder.find_spec(name, path) if name in _LOOKING else None
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            execute = loader.exec_module
            loader.exec_module = lambda module: _LOOKING[name](execute, module)
        return spec
