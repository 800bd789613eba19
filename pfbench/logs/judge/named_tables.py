"""Reader of CSV and Parquet tables with named columns, for trajectories and for the tables of an own log."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.files.table_file import read_table_file
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import (
    COVARIANCE_COLUMNS,
    GEODETIC,
    POSITION_SD,
    SD_GROUPS,
    TrajectoryTable,
)
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES
from pfbench.logs.units import ALIASES

_STATED_UNIT = re.compile(r"[\[(]\s*([^\[(\])]+?)\s*[\])]\s*$")  # at the end of a name


def read_named_table(
    accepted: Sequence[str], file: Path, options: SourceOptions
) -> list[TrajectoryTable]:
    """Read the columns of a table that have known names, or are given them by the options."""
    content = read_table_file(file)
    rows = content.rows.rename(columns=str)
    lines = np.arange(len(rows)) + (1 if file.suffix == ".parquet" else 2)
    rows = _rename_columns(file, rows, options, accepted)
    columns = list(map(str, rows))
    require(
        "t" in rows,
        file.name,
        "have the column t (time, s)",
        ", ".join(columns),
        f"Rename it with NAME.columns=t:NAME_IN_FILE.{_similar('time', columns)}",
    )
    lacking = [group for group in SD_GROUPS if not set(group) <= set(rows)]
    incomplete = [name for group in lacking for name in group]
    names = [name for name in accepted if name in rows and name not in incomplete]
    values = {name: _numbers(file, rows[name], name, lines) for name in names}
    unused = [str(name) for name in rows if name not in names]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    if COVARIANCE_COLUMNS[0] in values and POSITION_SD[0] in values:
        notes = (*notes, "the covariance is used in place of sd_pn, sd_pe and sd_pd")
    time = values.pop("t")
    origin = _stated_origin(content.stated)
    table_notes = (*content.notes, *notes)
    return [TrajectoryTable(file.name, time, values, lines, table_notes, origin=origin)]


def _rename_columns(
    file: Path, rows: pd.DataFrame, options: SourceOptions, accepted: Sequence[str]
) -> pd.DataFrame:
    """Return the rows with the names of pfbench."""
    for name, in_file in options.columns.items():
        remedy = "Choose from {}. Write a name with commas in quotes."
        require(in_file in rows, f"{file.name}: columns", "exist", in_file, remedy.format(", ".join(map(str, rows))))  # fmt: skip
        require(name in accepted, f"{file.name}: columns", "exist", name, remedy.format(", ".join(accepted)))  # fmt: skip
    _check_stated_units(file, options)
    used = options.columns.items()
    hidden = [name for name in options.columns if name in rows]
    rows = rows.drop(columns=[name for name in hidden if name not in options.columns.values()])
    return rows.rename(columns={in_file: name for name, in_file in used})


def _check_stated_units(file: Path, options: SourceOptions) -> None:
    """Refuse names that state other units, as time [ms], that no factor converts."""
    factors: dict[str, float] = {}
    for name, in_file in options.columns.items():
        match = _STATED_UNIT.search(in_file)
        stated = match[1] if match else ""
        units = QUANTITIES[LIMIT_COLUMNS[name]].units if name in LIMIT_COLUMNS else {}
        factor = units.get(ALIASES.get(stated, stated), 1.0)
        if factor != 1 and name not in options.factors:
            factors[name] = factor
    names = ", ".join(f"{name} from {options.columns[name]}" for name in factors)
    word = ",".join(f"{name}:{factor:.8g}" for name, factor in {**options.scale, **factors}.items())
    require(
        not factors,
        f"{file.name}: columns",
        "be in s, m, m/s and rad, latitude and longitude in deg",
        names,
        f"Set NAME.scale={word}.",
    )


def _stated_origin(stated: Mapping[str, str]) -> tuple[float, ...]:
    """Return the origin that a Parquet file states in deg, deg, m, or an empty tuple."""
    try:
        return tuple(float(stated[f"origin_{name}"]) for name in GEODETIC)
    except (KeyError, ValueError):
        return ()


def _numbers(file: Path, column: pd.Series, name: str, lines: np.ndarray) -> np.ndarray:
    """Convert a column to numbers; NaN where a cell is empty."""
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
