"""Benchmarks and probabilistic programming of particle filters in integrated navigation."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

try:
    __version__ = version("pfbench")
except PackageNotFoundError:  # a checkout on the path that is not installed
    __version__ = "0.0.0"


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
