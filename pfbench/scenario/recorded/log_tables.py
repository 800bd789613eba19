"""Parquet and CSV tables with named columns.

Error messages name the file, the column and the row. The file is long because of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.files.table_file import Array as Array, read_table_file
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.scenario.plausibility.column_checks import check_range
from pfbench.scenario.plausibility.log_table import LogTable
from pfbench.scenario.plausibility.time_order import find_order_remedy

_SUFFIXES = (".parquet", ".csv")


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


_USUAL_INTERVAL = 10.0  # s
_DATA_REMEDY = "Remove rows without data."
_COLUMN_REMEDY = "Fill this column. Of fixes, vn, ve, vd and fix can be left out."
# largest satellite number of each system in its interface document; QZSS and SBAS count from 193 and 120, too
_LARGEST_NUMBERS = {"G": 63, "R": 32, "E": 36, "C": 63, "J": 202, "I": 14, "S": 158}


def list_tables(root: str | None, folder: str, names: Iterable[str]) -> list[Path]:
    """List the files of tables, which `read_table` would read.

    Args:
        root: Folder of all data sets. None gives no files.
        folder: Name of the data set.
        names: File names without .parquet or .csv.

    Returns:
        The files that exist.
    """
    paths = (
        Path(root or "") / folder / f"{name}{suffix}" for name in names for suffix in _SUFFIXES
    )
    return [path for path in dict.fromkeys(paths) if root is not None and path.is_file()]


def find_table(folder: Path, name: str) -> Path:
    """Return the file of a table.

    Args:
        folder: Folder of the table.
        name: File name without .parquet or .csv.

    Raises:
        ValueError: If the file does not exist, or there is one of each kind.
    """
    files = list_tables(str(folder), "", (name,))
    if not files:
        raise ValueError(
            f"{folder} must contain {name}.parquet or {name}.csv. "
            "Store a log as a folder with imu, gnss and reference."
        )
    if len(files) > 1:
        raise ValueError(
            f"{folder} must not contain both {name}.parquet and {name}.csv. Delete one of them."
        )
    return files[0]


def read_table(
    folder: Path,
    name: str,
    select: dict[str, int | None],
    limits: PlausibleLimits | None = None,
) -> LogTable:
    """Read a table and select rows.

    Args:
        folder: Folder of the table.
        name: File name without .parquet or .csv.
        select: Required value by column, for columns in the table. None accepts a single value.
        limits: Limits of the platform. None for the default limits.

    Returns:
        The selected rows.

    Raises:
        ValueError: If the file does not exist, is ambiguous or damaged, a selection is missing or not in the
            file, or the table has fewer than two rows.
    """
    file = find_table(folder, name)
    content = read_table_file(file)
    table = LogTable(
        content.rows,
        file.name,
        file.suffix == ".csv",
        content.stated,
        limits or PlausibleLimits(),
        content.notes,
    )
    for column, value in select.items():
        if column in table.rows:
            table = _selected(table, column, value)
    if len(table.rows) < 2:
        raise ValueError(
            f"{file.name} must have at least 2 rows, got {len(table.rows)}. Use a longer table."
        )
    return table


def _selected(table: LogTable, column: str, value: int | None) -> LogTable:
    numbers = parse_numbers(table, (column,))[:, 0]
    values = [int(number) for number in np.unique(numbers)]
    if np.any(numbers != np.rint(numbers)):
        raise ValueError(
            f"{table.name}: column {column} must have whole numbers, got "
            f"{numbers[numbers != np.rint(numbers)][0]:g}. Correct or remove this row."
        )
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
    rows = table.rows[numbers == selected].reset_index(drop=True)
    return table._replace(rows=rows, name=f"{table.name} ({column} {selected})")


def parse_numbers(table: LogTable, columns: Sequence[str]) -> Array:
    """Convert columns to numbers.

    Args:
        table: Table.
        columns: Names of k columns.

    Returns:
        Numbers, [n, k].

    Raises:
        ValueError: If a column is missing, contains text, NaN or infinity, or leaves the range of
            its quantity in `plausible_limits`.
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
        values = convert_column(table, column)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ValueError(
                f"{table.name}: column {column} must have finite numbers, got "
                f"{table.rows[column].iloc[bad[0]]} in {table.row(int(bad[0]))} ({bad.size} such rows). "
                f"{_DATA_REMEDY if bad.size < len(values) else _COLUMN_REMEDY}"
            )
        check_range(table, column, values)
        out[:, i] = values
    return out


def convert_column(table: LogTable, column: str) -> Array:
    """Convert a column to numbers.

    Args:
        table: Table.
        column: Name of the column.

    Returns:
        Numbers, [n]. NaN where the column does not contain one.

    Raises:
        ValueError: If the column cannot be converted.
    """
    try:
        return pd.to_numeric(table.rows[column], errors="coerce").to_numpy(dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{table.name}: column {column} must have numbers, got {table.rows[column].dtype} "
            f"({error}). Convert this column to numbers."
        ) from error


def parse_satellites(table: LogTable, numbers: Array) -> list[str]:
    """Return the name of the satellite of each row, such as G07.

    Args:
        table: Table. Without a column `sys` all satellites are of GPS.
        numbers: Satellite numbers, [n].

    Raises:
        ValueError: If a value is not the letter of a system or not a number of this system.
    """
    systems = table.rows["sys"] if "sys" in table.rows else ["G"] * len(table.rows)
    for i, (system, number) in enumerate(zip(systems, numbers, strict=True)):
        if system not in _LARGEST_NUMBERS:
            raise ValueError(
                f"{table.name}: column sys must be one of {', '.join(_LARGEST_NUMBERS)}, got "
                f"{system!r} in {table.row(i)}. Correct or remove this row."
            )
        if not (1 <= number <= _LARGEST_NUMBERS[system] and number == int(number)):
            raise ValueError(
                f"{table.name}: column svid must be a whole number from 1 to "
                f"{_LARGEST_NUMBERS[system]} for the system {system}, got {number:g} in "
                f"{table.row(i)}. Correct or remove this row."
            )
    return [f"{system}{int(number):02d}" for system, number in zip(systems, numbers, strict=True)]


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
            f"{find_order_remedy(time, table.row)}"
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
    # the largest unit that gives a usual interval, else one that is accepted at all
    usual = [
        (u, f)
        for limit in (min(longest, _USUAL_INTERVAL), longest)
        for u, f in units
        if typical * f <= limit
    ]
    remedy = f"Use a table with an interval of at most {longest:g} s."
    if usual:
        remedy = f"If it is in {usual[0][0]}, multiply by {usual[0][1]:g}."
    raise ValueError(
        f"{table.name}: column t must be in s, got a median interval of {typical:g}. {remedy}"
    )
