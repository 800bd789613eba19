"""Benchmarks and probabilistic programming of particle filters in integrated navigation."""

from __future__ import annotations

import os
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from pfbench import (
        claims as claims,
        core as core,
        files as files,
        filter as filter,  # noqa: A004
        job as job,
        judge as judge,
        learn as learn,
        model as model,
        nav as nav,
        noise as noise,
        ppl as ppl,
        report as report,
        results as results,
        scenario as scenario,
        testing as testing,
    )
    from pfbench.door import (
        Part as Part,
        Study as Study,
        check_laws as check,
        get_part as get,
        list_names as names,
        make_log as log,
        make_own as own,
        open_study as study,
        run_filters as run,
        train_filter as train,
    )
    from pfbench.job import estimate_track as estimate_track
    from pfbench.scenario import inspect_log as inspect_log

# torch reads this before its first tensor: blocks above 2 MB then lie at the start of a page and in large pages. Else glibc
# before 2.38 cannot use a freed block for another of the same size: memory grew to 1.7 GB, and a step took 1.3 times as long.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")

try:
    __version__ = version("pfbench")
except PackageNotFoundError:  # a checkout on the path that is not installed
    __version__ = "0.0.0"

__all__ = [
    "Part",
    "Study",
    "__version__",
    "check",
    "claims",
    "core",
    "estimate_track",
    "files",
    "filter",
    "get",
    "inspect_log",
    "job",
    "judge",
    "learn",
    "load",
    "log",
    "model",
    "names",
    "nav",
    "noise",
    "own",
    "ppl",
    "report",
    "results",
    "run",
    "scenario",
    "study",
    "testing",
    "train",
]

# short names of the door, by the names that `pfbench.door` gives them
_DOOR = {
    "Part": "Part",
    "Study": "Study",
    "check": "check_laws",
    "get": "get_part",
    "log": "make_log",
    "names": "list_names",
    "own": "make_own",
    "run": "run_filters",
    "study": "open_study",
    "train": "train_filter",
}
_ROOMS = {"estimate_track": "job", "inspect_log": "scenario"}  # of other names


def __getattr__(name: str) -> Any:
    """Import a folder or a name of the door on first use, so that `import pfbench` stays fast."""
    if name not in __all__:
        raise AttributeError(f"pfbench does not define {name!r}. Choose a name of pfbench.__all__.")
    if name in _DOOR:
        value = getattr(import_module("pfbench.door"), _DOOR[name])
        if name != value.__name__:  # so that `help` shows the name that was asked for
            value.__name__, value.__qualname__, value.__module__ = name, name, __name__
        return value
    if name in _ROOMS:
        return getattr(import_module(f"pfbench.{_ROOMS[name]}"), name)
    return import_module(f"pfbench.{name}")


def __dir__() -> list[str]:
    return sorted(__all__)


def load(
    study: str, results: str | Path = "results", allow_mixed_versions: bool = False
) -> pd.DataFrame:
    """Load the results of a study as one long table.

    Args:
        study: Name of the study.
        results: Folder of all results.
        allow_mixed_versions: Whether results of several versions are accepted.

    Returns:
        A row per run, component and metric, see `pfbench.results.frame.load_frame`.
    """
    from pfbench.results.frame import load_frame  # on use, so that `import pfbench` stays fast

    return load_frame(study, results, allow_mixed_versions=allow_mixed_versions)
