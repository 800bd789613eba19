"""Reader of CSV and Parquet tables with named columns."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.files.table_file import read_table_file
from pfbench.judge.judge_options import SourceOptions
from pfbench.judge.readers.trajectory_table import (
    ALL_COLUMNS,
    COVARIANCE_COLUMNS,
    GEODETIC,
    POSITION_SD,
    SD_GROUPS,
    TrajectoryTable,
)
from pfbench.nav.plausible_limits import LIMIT_COLUMNS

_STATED_UNIT = re.compile(r"[\[(]\s*([^\[(\])]+?)\s*[\])]\s*$")  # at the end of a name
_RADIAN = {"rad": 57.29577951, "radians": 57.29577951}
_DEGREE = dict.fromkeys(("deg", "degrees", "°"), 0.01745329252)
_FACTORS: dict[str, dict[str, float]] = {  # of units in names of columns, by quantity
    "time": {
        "ms": 1e-3,
        "msec": 1e-3,
        "us": 1e-6,
        "µs": 1e-6,
        "ns": 1e-9,
        "min": 60.0,
        "h": 3600.0,
    },
    "local position": {"km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048},
    "height": {"km": 1e3, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048},
    "velocity": {"km/h": 1 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3, "ft/s": 0.3048, "kn": 1852 / 3600},
    "latitude": _RADIAN,
    "longitude": _RADIAN,
    "roll": _DEGREE,
    "pitch": _DEGREE,
    "yaw": _DEGREE,
}


def read_csv_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read a table whose columns have the names of `ALL_COLUMNS`.

    Args:
        file: File with suffix .csv or .parquet.
        options: Options with names of columns, as wanted:in_file, and the value of `path`.

    Returns:
        One table.

    Raises:
        ValueError: If the file is damaged, or the time or the position has another name.
    """
    content = read_table_file(file)
    rows = content.rows.rename(columns=str)
    lines = np.arange(len(rows)) + (1 if file.suffix == ".parquet" else 2)
    rows = _rename_columns(file, rows, options)
    if "t" not in rows:
        raise ValueError(
            f"{file.name} must have the column t (time, s), got {', '.join(map(str, rows))}."
            f"{_similar('time', list(map(str, rows)))} Rename it with NAME.columns=t:NAME_IN_FILE."
        )
    incomplete = [name for group in SD_GROUPS for name in _incomplete(group, rows)]
    names = [name for name in ALL_COLUMNS if name in rows and name not in incomplete]
    values = {name: _numbers(file, rows[name], name, lines) for name in names}
    unused = [str(name) for name in rows if name not in names]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    if COVARIANCE_COLUMNS[0] in values and POSITION_SD[0] in values:
        notes = (*notes, "the covariance is used in place of sd_pn, sd_pe and sd_pd")
    time = values.pop("t")
    origin = _stated_origin(content.stated)
    table_notes = (*content.notes, *notes)
    return [TrajectoryTable(file.name, time, values, lines, table_notes, origin=origin)]


def _rename_columns(file: Path, rows: pd.DataFrame, options: SourceOptions) -> pd.DataFrame:
    """Return the rows with the names of pfbench."""
    for name, in_file in options.columns.items():
        if in_file not in rows or name not in ALL_COLUMNS:
            absent = in_file not in rows
            wrong, choices = (in_file, map(str, rows)) if absent else (name, ALL_COLUMNS)
            raise ValueError(
                f"{file.name}: columns must exist, got {wrong}. Choose from {', '.join(choices)}. Write a name "
                "with commas in quotes."
            )
    _check_stated_units(file, options)
    used = options.columns.items()
    hidden = [name for name in options.columns if name in rows]
    rows = rows.drop(columns=[name for name in hidden if name not in options.columns.values()])
    return rows.rename(columns={in_file: name for name, in_file in used})


def _check_stated_units(file: Path, options: SourceOptions) -> None:
    """Raise ValueError if names state other units, as time [ms], that no factor converts."""
    factors: dict[str, float] = {}
    for name, in_file in options.columns.items():
        match = _STATED_UNIT.search(in_file)
        factor = _FACTORS.get(LIMIT_COLUMNS.get(name, ""), {}).get(match[1] if match else "", 1.0)
        if factor != 1 and name not in options.scale:
            factors[name] = factor
    if factors:
        names = ", ".join(f"{name} from {options.columns[name]}" for name in factors)
        word = ",".join(
            f"{name}:{factor:.8g}" for name, factor in {**options.scale, **factors}.items()
        )
        raise ValueError(
            f"{file.name}: columns must be in s, m, m/s and rad, latitude and longitude in deg, got {names}. "
            f"Set NAME.scale={word}."
        )


def _stated_origin(stated: Mapping[str, str]) -> tuple[float, ...]:
    """Return the origin that a Parquet file states in deg, deg, m, or an empty tuple."""
    try:
        return tuple(float(stated[f"origin_{name}"]) for name in GEODETIC)
    except (KeyError, ValueError):
        return ()


def _incomplete(group: tuple[str, ...], rows: pd.DataFrame) -> list[str]:
    """Return the columns of a group that lacks others."""
    present = [name for name in group if name in rows]
    return present if len(present) < len(group) else []


def _numbers(file: Path, column: pd.Series, name: str, lines: np.ndarray) -> np.ndarray:
    numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64)
    bad = np.isnan(numbers) & column.notna().to_numpy()
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{file.name}: line {lines[row]}, column {name} must be a number, got "
            f"{str(column.iloc[row])[:40]!r}. Repair or remove this line."
        )
    return numbers


def _similar(name: str, names: list[str]) -> str:
    close = difflib.get_close_matches(name, names, 1, 0.5)
    return f" Similar: {close[0]}." if close else ""
