"""Broadcast ephemerides from RINEX navigation files or tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import pandas as pd

from pfbench.nav import earth

GM_GPS = 3.986005e14  # [IS-GPS-200, table 20-IV], Galileo uses earth.GM [OS SIS ICD]
WEEK = 604800.0  # s
EPOCH = datetime(1980, 1, 6)
_ORBIT_SHAPE = ("crs", "deltan", "M0", "cuc", "e", "cus", "sqrtA", "toe")
ORBIT = (*_ORBIT_SHAPE, "cic", "Omega0", "cis", "i0", "crc", "omega", "Omegadot", "idot")
CLOCK = ("toc", "af0", "af1", "af2")
LINES = (
    *CLOCK,
    "iode",
    *ORBIT,
    "codes",
    "week",
    "l2p",
    "ura",
    "health",
    "tgd",
    "iodc",
    "ttx",
)  # record in RINEX order
_MAX_CHANGE = 0.01  # relative change of sqrtA, larger than any manoeuvre


def read_ephemeris(root: str | None, path: str) -> pd.DataFrame:
    """Read the ephemerides of a RINEX navigation file or a Parquet table, a row each.

    Args:
        root: Folder of all data sets (configuration key data.root).
        path: File in `root`. A Parquet table has the RINEX names as columns.

    Returns:
        Table of ephemerides.

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
    return pd.read_parquet(file) if file.suffix == ".parquet" else read_rinex(file)


def check_plausible(table: pd.DataFrame) -> pd.Series:
    """Return a mask of ephemerides near the median orbit size of their satellite.

    Merged files can contain records with reception errors. [ours]
    """
    usual = table.groupby("name")["sqrtA"].transform("median")
    return (table["sqrtA"] / usual - 1.0).abs() < _MAX_CHANGE


def parse_epochs(table: pd.DataFrame, epoch: float) -> pd.DataFrame:
    """Select healthy ephemerides, with `toe` and `toc` in seconds from an epoch.

    Rows are ordered by satellite and `toe`. Of each `toe` the last transmission is used. The week
    of `toe` is modulo 1024, as satellites send it. Without a week, the one nearest to the epoch is
    used.

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
    ordered = table[healthy].sort_values(["name", "toe", "ttx"], kind="stable")
    return ordered.drop_duplicates(["name", "toe"], keep="last").reset_index(drop=True)


def read_rinex(file: Path) -> pd.DataFrame:
    """Read GPS and Galileo (I/NAV) ephemerides from a RINEX 2 or 3 navigation file.

    One row per ephemeris, with `toc` in seconds of the week.

    Raises:
        ValueError: If the file is of another kind, or a record cannot be read (names the line).
    """
    lines = file.read_text(errors="replace").splitlines()
    version = lines[0][:9].strip() if lines and "RINEX VERSION" in lines[0] else ""
    if version[:1] not in ("2", "3") or lines[0][20:21] != "N":
        first = lines[0][:60] if lines else ""
        raise ValueError(
            f"the file {file.name} must be a RINEX 2 or 3 navigation file, "
            f"got first line {first!r}. Choose another file."
        )
    body = next((i + 1 for i, line in enumerate(lines) if "END OF HEADER" in line), len(lines))
    table = pd.DataFrame(list(_records(lines, body, 3 if version[0] == "3" else 2, file.name)))
    if table.empty:
        raise ValueError(
            f"the file {file.name} must contain ephemerides of GPS or Galileo, got none. "
            "Choose another file."
        )
    return table


def _records(
    lines: Sequence[str], body: int, version: int, name: str
) -> Iterator[dict[str, float | str]]:
    """Yield records from line `body` on. Numbers have columns of 19 after an indent."""
    indent = version + 1
    first_lines = [i for i in range(body, len(lines)) if lines[i][:indent].strip()]
    for begin, end in pairwise([*first_lines, len(lines)]):
        system = lines[begin][0] if version == 3 else "G"
        if system not in "GE":
            continue
        label = f"{name}: line {begin + 1}, {lines[begin][:23]!r}"
        try:
            prn, *date = lines[begin][version - 2 : 19 + indent].split()
            number = [_parse_number(lines[begin], 19 + indent + 19 * k) for k in range(3)]
            number += [
                _parse_number(line, indent + 19 * k)
                for line in lines[begin + 1 : end]
                for k in range(4)
            ]
            record = dict(zip(LINES, [_seconds_of_week(date), *number], strict=False))
            complete = "toe" in record and "ttx" in record
        except ValueError as error:
            raise ValueError(
                f"{label} is not a valid record: {error}. Repair or remove it."
            ) from None
        if not complete:
            raise ValueError(f"{label} is not a complete record. Remove it.")
        if (
            system == "E" and not int(record["codes"]) & 0b101
        ):  # F/NAV: clocks of another pair of frequencies
            continue
        if system == "E":
            record["tgd"] = record["iodc"]  # the group delay of E1 and E5b goes with I/NAV
        yield {**record, "sys": system, "prn": float(prn)}


def _parse_number(line: str, start: int) -> float:
    text = line[start : start + 19].strip()
    return float(text.replace("D", "e").replace("d", "e")) if text else 0.0


def _seconds_of_week(date: Sequence[str]) -> float:
    year, month, day, hour, minute = (int(field) for field in date[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    days = (datetime(year, month, day) - EPOCH).days % 7
    return days * 86400.0 + hour * 3600.0 + minute * 60.0 + float(date[5])
