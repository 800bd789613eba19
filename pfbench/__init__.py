"""pfbench: probabilistic programming and benchmarking of particle filters in integrated navigation."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

try:
    __version__ = version("pfbench")
except PackageNotFoundError:  # a checkout on the path, not installed
    __version__ = "0+unknown"


def load(study: str, results: str | Path = "results", mixed: bool = False) -> pd.DataFrame:
    """All results of a study as one tidy table: a row per run, component and metric; see `pfbench.report.frame.frame`."""
    from pfbench.report.frame import frame  # a report needs neither torch nor hydra, and `import pfbench` needs nothing

    return frame(study, results, mixed=mixed)
