"""Tables and contents of a recorded log: named columns, axes, ranges and rates of change."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.files.limits import find_input
from pfbench.files.table_file import Array as Array, read_table_file
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, PlausibleLimits, Quantity
from pfbench.logs.units import UNIT_FACTORS
from pfbench.logs.worlds.time_order import check_time_order

# --------------------------------------------------------------------------------------------------
# Parquet and CSV tables with named columns.
#
# Error messages name the file, the column and the row. The file is long because of them.

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
    remedy = f"Set the environment variable PFBENCH_DATA or data.root to the folder with {folder}/; data.root=. is the current one."
    if root is None:
        raise ValueError(
            f"data.root is not set. Recorded data are not part of the package. {remedy}"
        )
    path = find_input(root, folder, is_data_set=True)
    require(path.is_dir(), "data.root", f"contain the folder {folder}", root, remedy)
    return path


_USUAL_INTERVAL = 10.0  # s
_DATA_REMEDY, _ROW_REMEDY = "Remove rows without data.", "Correct or remove this row."
_COLUMN_REMEDY = "Fill this column. Of fixes, vn, ve, vd and fix can be left out."
# largest satellite number of each system in its interface document; QZSS and SBAS count from 193 and 120, too
_LARGEST_NUMBERS = {"G": 63, "R": 32, "E": 36, "C": 63, "J": 202, "I": 14, "S": 158}


def list_tables(root: str | None, folder: str, names: Iterable[str | None]) -> list[Path]:
    """List the files of tables, which `read_table` would read.

    Returns the files that exist.
    """
    if root is None:
        return []
    data_folder = find_input(root, folder, is_data_set=True)
    paths = (
        find_input(data_folder, f"{name}{suffix}")
        for name in names
        for suffix in _SUFFIXES
        if name is not None
    )
    return [path for path in dict.fromkeys(paths) if path.is_file()]


def find_table(folder: Path, name: str | None) -> Path:
    """Return the file of a table."""
    require(
        name is not None,
        "scenario.files",
        "name each table",
        "none",
        "Without a reference use scenario=user_log_aligned.",
    )
    files = list_tables(str(folder), "", (name,))
    require(
        files,
        folder,
        f"contain {name}.parquet or {name}.csv",
        "none",
        "Store a log as a folder with imu, gnss and reference. Without a reference use scenario=user_log_aligned, or "
        "pfbench estimate.",
    )
    require(
        len(files) == 1,
        folder,
        "contain each table once",
        f"both {name}.parquet and {name}.csv",
        "Delete one of them.",
    )
    return files[0]


def read_table(
    folder: Path,
    name: str | None,
    select: dict[str, int | None],
    limits: PlausibleLimits | None = None,
) -> LogTable:
    """Read a table and select rows."""
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
    count = len(table.rows)
    require(count > 1, file.name, "have at least 2 rows", count, "Use a longer table.")
    return table


def _selected(table: LogTable, column: str, value: int | None) -> LogTable:
    numbers = parse_numbers(table, (column,))[:, 0]
    values = [int(number) for number in np.unique(numbers)]
    whole_mask, key = numbers == np.rint(numbers), f"{table.name}: column {column}"
    require(
        whole_mask.all(),
        key,
        "have whole numbers",
        f"{numbers[whole_mask.argmin()]:g}",
        "Correct or remove this row.",
    )
    require(
        value is not None or len(values) == 1,
        key,
        "have one value",
        values,
        f"Select one of them with {column}=...",
    )
    selected = values[0] if value is None else value
    require(
        selected in values,
        table.name,
        f"have rows with {column}={value}",
        values,
        "Select one of these.",
    )
    rows = table.rows[numbers == selected].reset_index(drop=True)
    return table._replace(rows=rows, name=f"{table.name} ({column} {selected})")


def parse_numbers(table: LogTable, columns: Sequence[str]) -> Array:
    """Convert columns to numbers, and check that they are finite and in the range of their quantity.

    Returns numbers, [n, k].
    """
    out = convert_columns(table, columns)
    for column, values in zip(columns, out.T, strict=True):
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ValueError(
                f"{table.name}: column {column} must have finite numbers, got "
                f"{table.rows[column].iloc[bad[0]]} in {table.row(int(bad[0]))} ({bad.size} such rows). "
                f"{_DATA_REMEDY if bad.size < len(values) else _COLUMN_REMEDY}"
            )
        check_range(table, column, values)
    return out


def convert_columns(table: LogTable, columns: Sequence[str]) -> Array:
    """Convert columns to numbers, [n, k], NaN where there is none."""
    missing = ", ".join(column for column in columns if column not in table.rows)
    require(
        not missing,
        table.name,
        f"have a column {missing}",
        ", ".join(map(str, table.rows.columns)),
        "Rename or add it (units: s, m, m/s, m/s^2, rad, rad/s), or map your columns with pfbench import.",
    )
    return np.stack([convert_column(table, column) for column in columns], -1)


def convert_column(table: LogTable, column: str) -> Array:
    """Convert a column to numbers.

    Returns numbers, [n]. NaN where the column does not contain one.
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

    Shapes: numbers [n].
    """
    systems = table.rows["sys"] if "sys" in table.rows else ["G"] * len(table.rows)
    for i, (system, number) in enumerate(zip(systems, numbers, strict=True)):
        where, must = f"in {table.row(i)}", f"be one of {', '.join(_LARGEST_NUMBERS)}"
        require(
            system in _LARGEST_NUMBERS,
            f"{table.name}: column sys",
            must,
            f"{system!r} {where}",
            _ROW_REMEDY,
        )
        require(
            1 <= number <= _LARGEST_NUMBERS[system] and number == int(number),
            f"{table.name}: column svid",
            f"be a whole number from 1 to {_LARGEST_NUMBERS[system]} for the system {system}",
            f"{number:g} {where}",
            _ROW_REMEDY,
        )
    return [f"{system}{int(number):02d}" for system, number in zip(systems, numbers, strict=True)]


def index_satellites(
    table: LogTable, row: NDArray[np.intp], names: Sequence[str] | NDArray[np.str_]
) -> tuple[list[str], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return the satellites, and row and column of each entry in a table of epochs and satellites.

    Shapes: row of the epoch [n], names [n].
    """
    satellites, slot = np.unique(names, return_inverse=True)
    require(
        len(set(zip(row, slot, strict=True))) == len(slot),
        table.name,
        "have one row for each satellite and epoch",
        "two",
        "Remove one.",
    )
    return satellites.tolist(), (row, slot)


def read_times(table: LogTable, longest: float) -> Array:
    """Read and check the column t."""
    time = parse_numbers(table, ("t",))[:, 0]
    check_time_order(table.name, time, table.row)
    check_seconds(table, time, longest)
    return time


def check_seconds(table: LogTable, time: Array, longest: float) -> None:
    """Check that times are in seconds.

    Shapes: time [n].
    """
    typical = float(np.median(np.diff(time)))
    if typical <= longest:
        return
    # the largest unit that gives a usual interval, else one that is accepted at all
    usual = [
        (u, f)
        for limit in (min(longest, _USUAL_INTERVAL), longest)
        for u, f in UNIT_FACTORS["time"].items()
        if typical * f <= limit
    ]
    remedy = f"Use a table with an interval of at most {longest:g} s."
    if usual:
        remedy = f"If it is in {usual[0][0]}, multiply by {usual[0][1]:g}."
    raise ValueError(
        f"{table.name}: column t must be in s, got a median interval of {typical:g}. {remedy}"
    )


# --------------------------------------------------------------------------------------------------
# Contents of a navigation log in right-forward-up and East-North-Up axes.


class ImuLog(NamedTuple):
    """IMU samples in body axes right, forward, up.

    Attributes:
        time: Times, s, [n].
        force: Specific force, m/s^2, [n, 3].
        rate: Angular rate, rad/s, [n, 3].
    """

    time: Array
    force: Array
    rate: Array


class GnssLog(NamedTuple):
    """Fixes in East, North, Up. Missing values are NaN.

    Attributes:
        time: Times, s, [m].
        position: Positions, m, [m, 3].
        velocity: Velocities, m/s, [m, 3]. All NaN if not recorded.
    """

    time: Array
    position: Array
    velocity: Array


class ReferenceLog(NamedTuple):
    """Reference motion in East, North, Up.

    Attributes:
        time: Times, s, [k].
        attitude: Quaternions from body to level axes, [k, 4].
        velocity: Velocities, m/s, [k, 3].
        position: Positions, m, [k, 3].
    """

    time: Array
    attitude: Array
    velocity: Array
    position: Array


@dataclass(frozen=True)
class NavigationLog:
    """Log that passed all checks.

    Attributes:
        imu: IMU samples.
        fixes: Fixes.
        reference: Reference motion.
        gravity: Normal gravity at the origin, m/s^2.
        notes: Corrections and assumptions of the reader, for the report.
        centre: lat_deg, lon_deg, h_m of the origin, None if the log does not contain it.
    """

    imu: ImuLog
    fixes: GnssLog
    reference: ReferenceLog
    gravity: float
    notes: tuple[str, ...] = ()
    centre: tuple[float, ...] | None = None


@dataclass(frozen=True)
class LogFiles:
    """Names of the three tables, without .parquet or .csv.

    Attributes:
        imu: Name of the IMU table.
        gnss: Name of the table of fixes. It can be the reference.
        reference: Name of the reference table. None without a reference.
    """

    imu: str = "imu"
    gnss: str = "gnss"
    reference: str | None = "reference"


def swap_frd_rfu(a: Array) -> Array:
    """Convert forward-right-down to right-forward-up vectors [..., 3].

    The function also converts North-East-Down to East-North-Up. It is its own inverse.
    """
    return np.stack([a[..., 1], a[..., 0], -a[..., 2]], axis=-1)


# --------------------------------------------------------------------------------------------------
# Table of a log with what messages state of it.


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


_MANY_ROWS = 4  # wrong rows that are not an accident
_FEW = 0.01  # share of rows that can be removed
_NEIGHBOUR = 0.1  # least share of a value that a neighbour has, unless the value is a single error
_LARGEST_WIDENING = 100.0  # times the limit


def check_range(table: LogTable, column: str, values: Array) -> None:
    """Check that values are in the range of their quantity.

    Shapes: values [n].
    """
    quantity = table.limits.select(LIMIT_COLUMNS[column])
    outside = np.flatnonzero((values < quantity.least) | (values > quantity.largest))
    if outside.size:
        i = int(outside[0])
        least, largest = quantity.least, quantity.largest
        remedies = [
            *_conversions(quantity, values, outside, lambda a: (a >= least) & (a <= largest)),
            *_removal(len(values), len(outside)),
        ]
        reached = float(np.abs(values[outside]).max())
        # the least height is the same for all platforms
        is_reached = quantity.key != "height_m" or values.min() >= least
        # a larger range does not accept a single jump, which the largest change excludes
        is_jump = math.isfinite(quantity.rate) and _is_single(values, outside)
        if quantity.key and is_reached and not (is_jump and quantity.key != "speed_m_s"):
            remedies.append(_widening(quantity.key, reached, getattr(table.limits, quantity.key)))
        raise ValueError(
            f"{table.name}: column {column} must be between {quantity.least:g} and "
            f"{quantity.largest:g} {quantity.unit}, got {values[i]:g} in {table.row(i)} "
            f"({outside.size} such rows). {_join(remedies)}"
        )


def _conversions(
    quantity: Quantity,
    values: Array,
    outside: NDArray[np.intp],
    accepts: Callable[[Array], NDArray[np.bool_]],
) -> list[str]:
    """Name the units whose conversion makes all values acceptable; none for a single wrong value."""
    if _is_single(values, outside):
        return []
    return [
        f"If in {unit}, multiply by {factor:.9g}."
        for unit, factor in quantity.units.items()
        if accepts(factor * values).all()
    ]


def _is_single(values: Array, outside: NDArray[np.intp]) -> bool:
    """Return whether the first value outside is an error of its own, far from its neighbours."""
    i = int(outside[0])
    near = np.sort(np.abs(values[max(i - 1, 0) : i + 2]))
    return len(outside) < _MANY_ROWS and bool(near[-2] < _NEIGHBOUR * near[-1])


def _removal(rows: int, wrong: int) -> list[str]:
    """Advise to remove some wrong rows; not most of a table."""
    if wrong > max(_MANY_ROWS, _FEW * rows):
        return []
    return [f"Correct or remove {'this row' if wrong == 1 else 'these rows'}."]


def _widening(key: str, reached: float, limit: float) -> str:
    """Name the key and value that accept what the platform reached; '' if no platform can."""
    if not reached <= _LARGEST_WIDENING * limit:
        return ""
    unit = 10.0 ** (math.floor(math.log10(reached)) - 2)
    return f"If the platform can reach it, set scenario.limits.{key}={math.ceil(reached / unit) * unit:g}."


def _join(remedies: Sequence[str]) -> str:
    return " ".join(filter(None, remedies)) or "Check the unit and the content of this column."


def check_changes(table: LogTable, columns: Sequence[str], time: Array, values: Array) -> None:
    """Check that columns do not change faster than their quantities can.

    Shapes: time [n], values [n, k].
    """
    for column, series in zip(columns, values.T, strict=True):
        quantity = table.limits.select(LIMIT_COLUMNS[column])
        step = np.diff(series)
        largest = quantity.rate * np.diff(time) + quantity.allowance
        outside = np.flatnonzero(np.abs(step) > largest)
        if outside.size:
            i = int(outside[0])
            raise ValueError(
                f"{table.name}: column {column} must change by at most {largest[i]:g} "
                f"{quantity.unit} in {time[i + 1] - time[i]:.4g} s, got {series[i + 1]:g} after "
                f"{series[i]:g} in {table.row(i + 1)} ({outside.size} such rows). "
                f"{_join(_change_remedies(table, column, time, series))}"
            )


def _change_remedies(table: LogTable, column: str, time: Array, series: Array) -> list[str]:
    """Find what makes a column change slowly enough."""
    quantity = table.limits.select(LIMIT_COLUMNS[column])

    def is_slow(values: Array, at: Array = time) -> NDArray[np.bool_]:
        return np.abs(np.diff(values)) <= quantity.rate * np.diff(at) + quantity.allowance

    outside = np.flatnonzero(~is_slow(series))
    remedies = _conversions(quantity, series, outside, is_slow) if len(outside) > 2 else []
    wrong = outside[1:][np.diff(outside) == 1]  # rows with a jump before and after
    if len(wrong) and is_slow(np.delete(series, wrong), np.delete(time, wrong)).all():
        remedies += _removal(len(series), len(wrong))
    if len(outside) == 1:
        remedies.append(
            f"Keep the rows on one side of the jump before {table.row(int(outside[0]) + 1)}."
        )
    if LIMIT_COLUMNS[column] == "velocity":
        change = (np.abs(np.diff(series)) - quantity.allowance) / np.diff(time)
        limit = table.limits.acceleration_m_s2
        remedies.append(_widening("acceleration_m_s2", float(change.max()), limit))
    return remedies
