"""Broadcast ephemerides from RINEX navigation files or tables."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.files.table_file import read_table_file
from pfbench.nav import earth
from pfbench.nav.gnss.rinex import CLOCK, LINES, ORBIT, WEEK, RinexFile, read_rinex

GM_GPS = 3.986005e14  # [IS-GPS-200, table 20-IV], Galileo uses earth.GM [OS SIS ICD]


def read_ephemeris(root: str | None, path: str) -> RinexFile:
    """Read the ephemerides of a RINEX navigation file or a Parquet table, a row each.

    Args:
        root: Folder of all data sets (configuration key data.root).
        path: File in `root`. A Parquet table has the RINEX names as columns.

    Returns:
        Table of ephemerides, and notes on what was not read.

    Raises:
        ValueError: If `root` is None, or the file is missing or faulty.
    """
    remedy = (
        f"Set the environment variable PFBENCH_DATA, or data.root=..., to the folder of {path}."
    )
    if root is None:
        raise ValueError(f"data.root is not set. Ephemerides are not part of the package. {remedy}")
    file = Path(root) / path
    if not file.is_file():
        raise ValueError(f"data.root must contain {path}, got {root} without {file}. {remedy}")
    if file.suffix == ".parquet":
        return RinexFile(check_numbers(read_table_file(file).rows, path), ())
    content = read_rinex(file)
    return content._replace(rows=check_numbers(content.rows, path))


def check_numbers(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """Convert the parameters to numbers.

    Args:
        table: Ephemerides with RINEX names.
        name: Name of the file, for the message.

    Returns:
        Table with numeric columns. `week`, `health` and `ttx` may be NaN.

    Raises:
        ValueError: If a parameter is blank, text, or infinite. The message names column and row.
    """
    table = table.copy()
    for column in ("prn", *CLOCK, *ORBIT, "tgd", "week", "health", "ttx"):
        if column not in table:
            continue
        values = pd.to_numeric(table[column], errors="coerce").to_numpy(float)
        blank_mask = (
            table[column].isna().to_numpy()
            if column in ("week", "health", "ttx")
            else np.zeros(len(values), bool)
        )
        bad = np.flatnonzero(~np.isfinite(values) & ~blank_mask)
        if bad.size:
            raise ValueError(
                f"{name}: column {column} must have finite numbers, got "
                f"{table[column].iloc[bad[0]]} in row {bad[0]} (from 0, {bad.size} such rows). "
                "Remove rows without data."
            )
        table[column] = values
    return table


def parse_epochs(table: pd.DataFrame, epoch: float) -> pd.DataFrame:
    """Select healthy ephemerides, with `toe` and `toc` in seconds from an epoch.

    Rows are ordered by satellite, `toe` and time of transmission. The week of `toe` is modulo 1024,
    as satellites send it. Without a week, the one nearest to the epoch is used.

    Args:
        table: Ephemerides with RINEX names.
        epoch: GPS time, seconds since 1980-01-06.

    Returns:
        Selected ephemerides.

    Raises:
        ValueError: If a column is missing.
    """
    table = table.copy()
    missing = [name for name in ("prn", *CLOCK, *ORBIT) if name not in table]
    if missing:
        raise ValueError(
            f"the columns of ephemerides must include {', '.join(missing)}. "
            f"Use the names of RINEX: {', '.join(LINES)}."
        )
    unknown, optional = pd.Series(math.nan, table.index), ("week", "health", "tgd", "ttx")
    column = {name: table.get(name, unknown) for name in optional}
    system = table["sys"] if "sys" in table else pd.Series("G", table.index)
    table["name"] = [f"{s}{int(prn):02d}" for s, prn in zip(system, table["prn"], strict=True)]
    table["gm"] = system.map({"G": GM_GPS, "E": earth.GM})
    table["tgd"] = column["tgd"].fillna(0.0)
    table["ttx"] = column["ttx"].fillna(0.0)
    table["sow"] = table["toe"] % WEEK
    since = column["week"].fillna(0.0) * WEEK + table["toe"] - epoch
    cycle = (1024 * WEEK) * column["week"].notna() + WEEK * column["week"].isna()
    offset = table["toc"] - table["toe"]
    table["toe"] = since - cycle * (since / cycle).round()
    table["toc"] = table["toe"] + offset - WEEK * (offset / WEEK).round()
    healthy = table["gm"].notna() & (column["health"].fillna(0.0) == 0.0)
    return table[healthy].sort_values(["name", "toe", "ttx"], kind="stable").reset_index(drop=True)


def describe_unhealthy(table: pd.DataFrame, path: str) -> tuple[str, ...]:
    """Describe the ephemerides that are not used because their satellite is marked unhealthy.

    Args:
        table: Ephemerides with RINEX names.
        path: Name of the file.

    Returns:
        One note, or none.
    """
    if "health" not in table:
        return ()
    unhealthy = table[table["health"].fillna(0.0) != 0.0]
    if unhealthy.empty:
        return ()
    system = unhealthy["sys"] if "sys" in unhealthy else pd.Series("G", unhealthy.index)
    names = sorted({f"{s}{int(prn):02d}" for s, prn in zip(system, unhealthy["prn"], strict=True)})
    return (
        f"{path}: {len(unhealthy)} ephemerides are ignored because their satellites are marked "
        f"unhealthy: {', '.join(names)}",
    )
