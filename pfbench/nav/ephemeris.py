"""Broadcast ephemerides from files: RINEX navigation files, or a table of their records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import pandas as pd

from pfbench.nav import earth

GM_GPS = 3.986005e14  # of GPS ephemerides [IS-GPS-200, table 20-IV]; Galileo's are made with earth.GM [Galileo OS SIS ICD]
WEEK = 604800.0  # s
EPOCH = datetime(1980, 1, 6)
_SHAPE = ("crs", "deltan", "M0", "cuc", "e", "cus", "sqrtA", "toe")
ORBIT = (*_SHAPE, "cic", "Omega0", "cis", "i0", "crc", "omega", "Omegadot", "idot")
CLOCK = ("toc", "af0", "af1", "af2")
LINES = (*CLOCK, "iode", *ORBIT, "codes", "week", "l2p", "ura", "health", "tgd", "iodc", "ttx")  # a record in RINEX's order
_LEAP = 0.01  # relative change of a satellite's sqrtA that no manoeuvre makes


def read(root: str | None, path: str) -> pd.DataFrame:
    """The ephemerides of a RINEX navigation file, or of a Parquet table with the same names, one row each.

    Raises:
        ValueError: no root (configuration key data.root), no such file in it, or a faulty file.
    """
    remedy = f"set the environment variable PFBENCH_DATA, or data.root=..., to the folder that holds {path}"
    if root is None:
        raise ValueError(f"data.root is not set, and ephemerides are not part of the package: {remedy}")
    file = Path(root) / path
    if not file.is_file():
        raise ValueError(f"data.root={root}: no file {file}; {remedy}")
    return pd.read_parquet(file) if file.suffix == ".parquet" else read_rinex(file)


def plausible(table: pd.DataFrame) -> pd.Series:
    """Ephemerides near the usual size of their satellite's orbit: merged files hold records that were received wrongly. [ours]"""
    usual = table.groupby("name")["sqrtA"].transform("median")
    return (table["sqrtA"] / usual - 1.0).abs() < _LEAP


def dated(table: pd.DataFrame, epoch: float) -> pd.DataFrame:
    """Healthy ephemerides with `toe` and `toc` in seconds from an epoch, in order; the last sent of each toe.

    Weeks, those of `toe`, count modulo 1024, as satellites send them; where none is told, it is the one nearest to the epoch.
    """
    table = table.copy()
    missing = [name for name in ("prn", *CLOCK, *ORBIT) if name not in table]
    if missing:
        raise ValueError(f"the ephemerides have no {', '.join(missing)}; name the columns as RINEX does: {', '.join(LINES)}")
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
    """Ephemerides of GPS and Galileo (I/NAV) in a RINEX 2 or 3 navigation file, one row each; toc in seconds of the week.

    Raises:
        ValueError: not such a file, or a record that cannot be read; names the line.
    """
    lines = file.read_text(errors="replace").splitlines()
    version = lines[0][:9].strip() if lines and "RINEX VERSION" in lines[0] else ""
    if version[:1] not in ("2", "3") or lines[0][20:21] != "N":
        raise ValueError(f"{file.name}: no RINEX 2 or 3 navigation file; its first line says {lines[0][:60] if lines else ''!r}")
    body = next((i + 1 for i, line in enumerate(lines) if "END OF HEADER" in line), len(lines))
    table = pd.DataFrame(list(_records(lines, body, 3 if version[0] == "3" else 2, file.name)))
    if table.empty:
        raise ValueError(f"{file.name}: no ephemeris of GPS or Galileo in it")
    return table


def _records(lines: Sequence[str], body: int, version: int, name: str) -> Iterator[dict[str, float | str]]:
    """Records from line `body` on; numbers stand in columns of 19 after an indent of 3 (RINEX 2) or 4."""
    indent = version + 1
    starts = [i for i in range(body, len(lines)) if lines[i][:indent].strip()]
    for begin, end in pairwise([*starts, len(lines)]):
        system = lines[begin][0] if version == 3 else "G"
        if system not in "GE":
            continue
        where = f"{name}: line {begin + 1}, {lines[begin][:23]!r}"
        try:
            prn, *date = lines[begin][version - 2 : 19 + indent].split()
            number = [_number(lines[begin], 19 + indent + 19 * k) for k in range(3)]
            number += [_number(line, indent + 19 * k) for line in lines[begin + 1 : end] for k in range(4)]
            record = dict(zip(LINES, [_seconds_of_week(date), *number], strict=False))
            complete = "toe" in record and "ttx" in record
        except ValueError as error:
            raise ValueError(f"{where}: {error}; repair or leave out the record") from None
        if not complete:
            raise ValueError(f"{where}: the record is cut short; leave it out")
        if system == "E" and not int(record["codes"]) & 0b101:  # F/NAV: clocks of another pair of frequencies
            continue
        if system == "E":
            record["tgd"] = record["iodc"]  # the group delay of E1 and E5b goes with I/NAV
        yield {**record, "sys": system, "prn": float(prn)}


def _number(line: str, place: int) -> float:
    text = line[place : place + 19].strip()
    return float(text.replace("D", "e").replace("d", "e")) if text else 0.0


def _seconds_of_week(date: Sequence[str]) -> float:
    year, month, day, hour, minute = (int(part) for part in date[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    days = (datetime(year, month, day) - EPOCH).days % 7
    return days * 86400.0 + hour * 3600.0 + minute * 60.0 + float(date[5])
