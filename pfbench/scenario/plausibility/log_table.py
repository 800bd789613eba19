"""Table of a log with what messages state of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from pfbench.nav.plausible_limits import PlausibleLimits


class LogTable(NamedTuple):
    """Rows of a table file.

    Attributes:
        rows: Rows.
        name: Name of the file, for messages.
        lines: Whether messages count lines (CSV) instead of rows.
        stated: Metadata of a Parquet file.
        limits: Limits of the platform.
        notes: Rows that the reader dropped.
    """

    rows: pd.DataFrame
    name: str
    lines: bool
    stated: dict[str, str]
    limits: PlausibleLimits = PlausibleLimits()
    notes: tuple[str, ...] = ()

    def has(self, columns: Sequence[str]) -> bool:
        """Return whether the table has all of these columns."""
        return all(column in self.rows for column in columns)

    def row(self, i: int) -> str:
        """Describe the position of row i in the file."""
        return f"line {i + 2}" if self.lines else f"row {i} (from 0)"
