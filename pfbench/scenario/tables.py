"""Tables with named columns, Parquet or CSV, and messages that name the file, the column and the row."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Table(NamedTuple):
    """A file's rows, its name for messages, whether it has lines, and the metadata of a Parquet file."""

    rows: pd.DataFrame
    name: str
    lines: bool
    stated: dict[str, str]

    def has(self, columns: Sequence[str]) -> bool:
        """Whether all of these columns are there."""
        return all(column in self.rows for column in columns)

    def row(self, i: int) -> str:
        """Where a reader of the file finds row i."""
        return f"line {i + 2}" if self.lines else f"row {i} (from 0)"


def read_table(folder: Path, name: str, select: dict[str, int | None]) -> Table:
    """The table of this name in a folder; of its rows, those with the selected value in each selecting column.

    Raises:
        ValueError: no such file or two, fewer than two rows, a selection that is missing or not in the file.
    """
    found = [file for suffix in (".parquet", ".csv") if (file := folder / f"{name}{suffix}").is_file()]
    if not found:
        raise ValueError(f"{folder}: no {name}.parquet and no {name}.csv; a log is a folder with imu, gnss and reference")
    if len(found) > 1:
        raise ValueError(f"{folder}: both {name}.parquet and {name}.csv; delete one of them, or name the files otherwise")
    file = found[0]
    if file.suffix == ".csv":
        table = Table(pd.read_csv(file, skip_blank_lines=False, skipinitialspace=True), file.name, True, {})
    else:
        table = _parquet(file)
    for column, value in select.items():
        if column in table.rows:
            table = _selected(table, column, value)
    if len(table.rows) < 2:
        raise ValueError(f"{file.name}: {len(table.rows)} rows; give at least 2")
    return table


def _parquet(file: Path) -> Table:
    try:
        from pyarrow import parquet  # only logs in Parquet need it
    except ImportError as error:
        raise ValueError(f"{file.name} needs pyarrow: pip install 'pfbench[data]', or store the log as CSV") from error
    table = parquet.read_table(file)
    stated = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
    return Table(table.to_pandas(), file.name, False, stated)


def _selected(table: Table, column: str, value: int | None) -> Table:
    there = sorted(set(table.rows[column].tolist()))
    if value is None and len(there) > 1:
        raise ValueError(f"{table.name}: column {column} tells {there} apart; choose one of them with {column}=...")
    if value is not None and value not in there:
        raise ValueError(f"{table.name}: {column}={value} is not in the file; it has {there}")
    chosen = there[0] if value is None else value
    rows = table.rows[table.rows[column] == chosen].reset_index(drop=True)
    return table._replace(rows=rows, name=f"{table.name} ({column} {chosen})")


def numbers(table: Table, columns: Sequence[str]) -> Array:
    """Columns as numbers [n, k].

    Raises:
        ValueError: a column that is missing or holds text, NaN or infinity; names file, column and row.
    """
    missing = [column for column in columns if column not in table.rows]
    if missing:
        there, them = ", ".join(map(str, table.rows.columns)), "it" if len(missing) == 1 else "them"
        raise ValueError(
            f"{table.name}: no column {', '.join(missing)}; it has {there}. "
            f"Rename or add {them} (units: s, m, m/s, m/s^2, rad, rad/s)"
        )
    out = np.empty((len(table.rows), len(columns)))
    for i, column in enumerate(columns):
        values = pd.to_numeric(table.rows[column], errors="coerce").to_numpy(dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ValueError(
                f"{table.name}: column {column}, {table.row(int(bad[0]))} is {table.rows[column].iloc[bad[0]]} "
                f"({bad.size} such); give numbers, and leave out rows without data"
            )
        out[:, i] = values
    return out


def times(table: Table, longest: float) -> Array:
    """Column t [n], increasing; `longest` is the median interval above which it cannot be in seconds.

    Raises:
        ValueError: as `numbers`, `check_increasing` and `check_seconds`.
    """
    time = numbers(table, ("t",))[:, 0]
    check_increasing(table, time)
    check_seconds(table, time, longest)
    return time


def check_increasing(table: Table, time: Array) -> None:
    """Raises a ValueError at the first time that repeats or goes back."""
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        i = int(back[0]) + 1
        what = "repeats the time before" if time[i] == time[i - 1] else "goes back in time"
        raise ValueError(
            f"{table.name}: column t, {table.row(i)} is {time[i]} after {time[i - 1]}: it {what} ({back.size} such); "
            "sort the rows by t and keep one row for each time"
        )


def check_seconds(table: Table, time: Array, longest: float) -> None:
    """Raises a ValueError where the median interval is longer than `longest` seconds, with a guess of the unit."""
    typical = float(np.median(np.diff(time)))
    if typical <= longest:
        return
    units = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
    unit, scale = next(((u, s) for u, s in units if typical * s <= longest), units[-1])
    raise ValueError(
        f"{table.name}: column t has a median interval of {typical:g}, too long for seconds; if in {unit}, multiply by {scale:g}"
    )
