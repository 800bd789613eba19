"""Parquet and CSV tables with named columns.

Error messages name the file, the column and the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]


def find_dataset(root: str | None, folder: str) -> Path:
    """Return the folder of a data set.

    Args:
        root: Folder of all data sets.
        folder: Name of the data set.

    Returns:
        The folder.

    Raises:
        ValueError: If data.root is not set, or does not contain the folder.
    """
    remedy = f"Set the environment variable PFBENCH_DATA or data.root to the folder with {folder}/."
    if root is None:
        raise ValueError(
            f"data.root is not set. Recorded data are not part of the package. {remedy}"
        )
    path = Path(root) / folder
    if not path.is_dir():
        raise ValueError(f"data.root must contain the folder {folder}, got {root}. {remedy}")
    return path


class LogTable(NamedTuple):
    """Rows of a table file.

    Attributes:
        rows: Rows.
        name: Name of the file, for messages.
        lines: Whether messages count lines (CSV) instead of rows.
        stated: Metadata of a Parquet file.
    """

    rows: pd.DataFrame
    name: str
    lines: bool
    stated: dict[str, str]

    def has(self, columns: Sequence[str]) -> bool:
        """Return whether the table has all of these columns."""
        return all(column in self.rows for column in columns)

    def row(self, i: int) -> str:
        """Describe the position of row i in the file."""
        return f"line {i + 2}" if self.lines else f"row {i} (from 0)"


def read_table(folder: Path, name: str, select: dict[str, int | None]) -> LogTable:
    """Read a table and select rows.

    Args:
        folder: Folder of the table.
        name: File name without .parquet or .csv.
        select: Required value by column, for columns in the table. None accepts a single value.

    Returns:
        The selected rows.

    Raises:
        ValueError: If the file does not exist or is ambiguous, a selection is missing or not in the
            file, or the table has fewer than two rows.
    """
    files = [
        file for suffix in (".parquet", ".csv") if (file := folder / f"{name}{suffix}").is_file()
    ]
    if not files:
        raise ValueError(
            f"{folder} must contain {name}.parquet or {name}.csv. "
            "Store a log as a folder with imu, gnss and reference."
        )
    if len(files) > 1:
        raise ValueError(
            f"{folder} must not contain both {name}.parquet and {name}.csv. Delete one of them."
        )
    file = files[0]
    if file.suffix == ".csv":
        table = LogTable(
            pd.read_csv(file, skip_blank_lines=False, skipinitialspace=True), file.name, True, {}
        )
    else:
        table = _parquet(file)
    for column, value in select.items():
        if column in table.rows:
            table = _selected(table, column, value)
    if len(table.rows) < 2:
        raise ValueError(
            f"{file.name} must have at least 2 rows, got {len(table.rows)}. Use a longer table."
        )
    return table


def _parquet(file: Path) -> LogTable:
    try:
        from pyarrow import parquet  # required only for Parquet logs
    except ImportError as error:
        raise ValueError(
            f"{file.name} needs pyarrow. Run pip install 'pfbench[data]', or store the log as CSV."
        ) from error
    table = parquet.read_table(file)
    stated = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    return LogTable(table.to_pandas(), file.name, False, stated)


def _selected(table: LogTable, column: str, value: int | None) -> LogTable:
    values = sorted(set(table.rows[column].tolist()))
    if value is None and len(values) > 1:
        raise ValueError(
            f"{table.name}: column {column} must have one value, got {values}. "
            f"Select one of them with {column}=..."
        )
    if value is not None and value not in values:
        raise ValueError(
            f"{table.name} must have rows with {column}={value}, got {values}. Select one of these."
        )
    selected = values[0] if value is None else value
    rows = table.rows[table.rows[column] == selected].reset_index(drop=True)
    return table._replace(rows=rows, name=f"{table.name} ({column} {selected})")


def parse_numbers(table: LogTable, columns: Sequence[str]) -> Array:
    """Convert columns to numbers.

    Args:
        table: Table.
        columns: Names of k columns.

    Returns:
        Numbers, [n, k].

    Raises:
        ValueError: If a column is missing, or contains text, NaN or infinity.
    """
    missing = [column for column in columns if column not in table.rows]
    if missing:
        available = ", ".join(map(str, table.rows.columns))
        pronoun = "it" if len(missing) == 1 else "them"
        raise ValueError(
            f"{table.name} must have a column {', '.join(missing)}, got {available}. "
            f"Rename or add {pronoun} (units: s, m, m/s, m/s^2, rad, rad/s)."
        )
    out = np.empty((len(table.rows), len(columns)))
    for i, column in enumerate(columns):
        values = pd.to_numeric(table.rows[column], errors="coerce").to_numpy(dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ValueError(
                f"{table.name}: column {column} must have finite numbers, got "
                f"{table.rows[column].iloc[bad[0]]} in {table.row(int(bad[0]))} ({bad.size} such rows). "
                "Remove rows without data."
            )
        out[:, i] = values
    return out


def read_times(table: LogTable, longest: float) -> Array:
    """Read and check the column t.

    Args:
        table: Table.
        longest: Longest plausible median interval, s.

    Returns:
        Increasing times, s, [n].

    Raises:
        ValueError: As `parse_numbers`, `check_increasing` and `check_seconds`.
    """
    time = parse_numbers(table, ("t",))[:, 0]
    check_increasing(table, time)
    check_seconds(table, time, longest)
    return time


def check_increasing(table: LogTable, time: Array) -> None:
    """Check that times increase.

    Args:
        table: Table, for the message.
        time: Times, s, [n].

    Raises:
        ValueError: At the first time that is not later than the previous one.
    """
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = int(back[0]) + 1
        problem = "repeats the previous time" if time[i] == time[i - 1] else "goes back in time"
        raise ValueError(
            f"{table.name}: column t must increase, got {time[i]} after {time[i - 1]} in "
            f"{table.row(i)}, which {problem} ({back.size} such rows). "
            "Sort the rows by t and keep one row for each time."
        )


def check_seconds(table: LogTable, time: Array, longest: float) -> None:
    """Check that times are in seconds.

    Args:
        table: Table, for the message.
        time: Times, [n].
        longest: Longest plausible median interval, s.

    Raises:
        ValueError: If the median interval is longer. The message suggests a unit.
    """
    typical = float(np.median(np.diff(time)))
    if typical <= longest:
        return
    units = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
    unit, scale = next(((u, s) for u, s in units if typical * s <= longest), units[-1])
    raise ValueError(
        f"{table.name}: column t must be in s, got a median interval of {typical:g}. "
        f"If it is in {unit}, multiply by {scale:g}."
    )
