"""Broadcast ephemerides from RINEX navigation files or tables."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.files.limits import find_input, read_text
from pfbench.files.table_file import read_table_file
from pfbench.logs.units import WEEK
from pfbench.nav import earth
from pfbench.nav.orbits import GPS_OMEGA, OrbitalElements, eccentric_anomaly

GM_GPS = 3.986005e14  # [IS-GPS-200, table 20-IV], Galileo uses earth.GM [OS SIS ICD]


def read_ephemeris(root: str | None, path: str) -> RinexFile:
    """Read the ephemerides of a RINEX navigation file or a Parquet table, a row each."""
    remedy = (
        f"Set the environment variable PFBENCH_DATA, or data.root=..., to the folder of {path}."
    )
    if root is None:
        raise ValueError(f"data.root is not set. Ephemerides are not part of the package. {remedy}")
    file = find_input(root, path, is_data_set=True)
    require(file.is_file(), "data.root", f"contain {path}", f"{root} without {file}", remedy)
    if file.suffix == ".parquet":
        return RinexFile(check_numbers(read_table_file(file).rows, path), ())
    content = read_rinex(file)
    return content._replace(rows=check_numbers(content.rows, path))


def check_numbers(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """Convert the parameters to numbers.

    Returns table with numeric columns. `week`, `health` and `ttx` may be NaN.
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

    Returns selected ephemerides.
    """
    table = table.copy()
    missing = [name for name in ("prn", *CLOCK, *ORBIT) if name not in table]
    require(
        not missing,
        "the columns of ephemerides",
        f"include {', '.join(missing)}",
        ", ".join(map(str, table.columns)),
        f"Use the names of RINEX: {', '.join(LINES)}.",
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

    Returns one note, or none.
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


# --------------------------------------------------------------------------------------------------
# Orbital elements of broadcast ephemerides [IS-GPS-200, table 20-IV].


def mean_motion(eph: Mapping[str, Tensor]) -> Tensor:
    """Compute the corrected mean motion of ephemerides, rad/s, [...]."""
    return torch.sqrt(eph["gm"]) / eph["sqrtA"] ** 3 + eph["deltan"]


def broadcast_elements(eph: Mapping[str, Tensor]) -> OrbitalElements:
    """Evaluate the user algorithm and its derivatives.

    Returns the elements, [...] each. Shapes: eph [...].
    """
    e, tk, n = eph["e"], eph["tk"], mean_motion(eph)
    anomaly, near = eccentric_anomaly(eph["M0"] + n * tk, e)
    anomaly1, root = n / near, torch.sqrt(1 - e * e)
    turn = torch.atan2(root * torch.sin(anomaly), torch.cos(anomaly) - e) + eph["omega"]
    turn1 = root * anomaly1 / near
    s2, c2 = torch.sin(2 * turn), torch.cos(2 * turn)

    def harmonic(sine: str, cosine: str) -> tuple[Tensor, Tensor]:
        derivative = 2 * turn1 * (eph[sine] * c2 - eph[cosine] * s2)
        return eph[sine] * s2 + eph[cosine] * c2, derivative

    du, du1 = harmonic("cus", "cuc")
    dr, dr1 = harmonic("crs", "crc")
    di, di1 = harmonic("cis", "cic")
    size, node1 = eph["sqrtA"] ** 2, eph["Omegadot"] - GPS_OMEGA
    node = eph["Omega0"] + node1 * tk - GPS_OMEGA * eph["sow"]
    radius1 = size * e * torch.sin(anomaly) * anomaly1 + dr1
    inclination = eph["i0"] + eph["idot"] * tk + di
    rates = (radius1, turn1 + du1, eph["idot"] + di1, node1)
    return OrbitalElements(size * near + dr, turn + du, inclination, node, *rates)


# --------------------------------------------------------------------------------------------------
# Ephemerides from RINEX 2, 3 and 4 navigation files. A record that cannot be read is dropped with a note.

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
_REQUIRED = {*CLOCK, *ORBIT, "week", "health", "ttx"}
_BY_SYSTEM = {"G": {"tgd"}, "E": {"codes", "iodc"}}  # other fields that are used
_RECORD_LINES = 8
_READ = ("LNAV", "INAV", "FNAV")  # messages of RINEX 4 with the records of RINEX 3
_SYSTEMS = {
    "G": "GPS", "R": "GLONASS", "E": "Galileo", "C": "BeiDou", "J": "QZSS", "I": "NavIC", "S": "SBAS",
}  # fmt: skip
_KINDS = {
    "N": "GPS navigation", "G": "GLONASS navigation", "H": "SBAS navigation", "L": "Galileo navigation",
    "O": "observation", "M": "meteorological", "C": "clock", "B": "SBAS broadcast",
}  # fmt: skip
# some programs write an exponent of three digits without its letter
_NUMBER = re.compile(r"([-+]?\d*\.\d{1,14})(?:[DdEe]([-+]\d{2,3})|([-+]\d{3}))")
_SAME_DATE = 3 * 7200.0  # s; longest time between clock and orbit


class RinexFile(NamedTuple):
    """Ephemerides of a RINEX file.

    Attributes:
        rows: One row per ephemeris, with `toc` in seconds of the week, and `line`.
        notes: Records and systems that were not read.
        ionosphere: Coefficients of the broadcast ionosphere of GPS, alpha and beta, [8]. Empty without them.
    """

    rows: pd.DataFrame
    notes: tuple[str, ...]
    ionosphere: tuple[float, ...] = ()


def read_rinex(file: Path) -> RinexFile:
    """Read GPS and Galileo (I/NAV) ephemerides from a RINEX 2, 3 or 4 navigation file.

    A record that cannot be read is dropped, and a note names its line.
    """
    # names and comments contain other letters, which are read but not used
    text = read_text(file).removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    lines = [line.rstrip() for line in text.split("\n")]
    version = lines[0][:9].strip() if lines and "RINEX VERSION" in lines[0] else ""
    if version[:1] not in ("2", "3", "4") or lines[0][20:21] != "N":
        raise ValueError(
            f"the file {file.name} must be a RINEX 2, 3 or 4 navigation file, {_describe_kind(lines)}"
        )
    body = next((i + 1 for i, line in enumerate(lines) if "END OF HEADER" in line), len(lines))
    ionosphere, skipped = find_ionosphere(lines, body), tuple[str, ...]()
    if version[0] == "4":
        (lines, skipped), version = unfold_blocks(lines, body), "3"
    records = list(_records(lines, body, int(version[0])))
    rows = [record for record in records if isinstance(record, dict)]
    dropped = [f"{file.name}: {record}" for record in records if isinstance(record, str)]
    if len(dropped) > len(rows):
        raise ValueError(
            f"{dropped[0]}, and so {len(dropped)} of {len(dropped) + len(rows)} records of the file cannot "
            "be read. Choose another file of this day."
        )
    if not rows:
        others = "".join(_describe_others(lines, body, version[0]))
        raise ValueError(
            f"the file {file.name} must contain ephemerides of GPS or Galileo, got none{others and ' but '}"
            f"{others}. Choose another file."
        )
    systems = [*skipped, *_describe_others(lines, body, version[0])]
    unread = (f"{file.name}: not read: {text}" for text in systems)
    return RinexFile(pd.DataFrame(rows), (*dropped, *unread), ionosphere)


def _describe_kind(lines: Sequence[str]) -> str:
    """Describe a file that is not a navigation file of RINEX 2, 3 or 4, and its remedy."""
    first = lines[0] if lines else ""
    if first.startswith("\x1f"):
        return "got a compressed file. Unpack it with gunzip, or gzip -d."
    if "RINEX VERSION" not in first:
        return f"got first line {first[:60]!r}. Choose another file."
    version, kind = first[:9].strip(), _KINDS.get(first[20:21], "unknown")
    same_day = (
        "Choose the GPS or mixed navigation file (type N) of RINEX 2, 3 or 4 of the same day."
    )
    return f"got a {kind} file of RINEX {version}. {same_day}"


def _first_lines(lines: Sequence[str], body: int, version: int) -> list[int]:
    """Return the first line of each record, and the end of the text."""
    end_of_text = len(lines)
    while end_of_text > body and not lines[end_of_text - 1]:
        end_of_text -= 1
    return [*(i for i in range(body, end_of_text) if lines[i][: version + 1].strip()), end_of_text]


def _describe_others(lines: Sequence[str], body: int, version: str) -> list[str]:
    """Describe the satellites of other systems, in one text, or none."""
    if version != "3":
        return []
    letters = Counter(lines[i][0] for i in _first_lines(lines, body, 3)[:-1])
    texts = [
        f"{count} of {_SYSTEMS.get(letter, f'the unknown system {letter!r}')}"
        for letter, count in sorted(letters.items())
        if letter not in "GE"
    ]
    return [f"records {', '.join(texts)}"] if texts else []


def _records(
    lines: Sequence[str], body: int, version: int
) -> Iterator[dict[str, float | str] | str]:
    """Yield records from line `body` on, or why one is dropped. Numbers have columns of 19 after an indent."""
    indent = version + 1
    borders = _first_lines(lines, body, version)
    if any(lines[body : borders[0]]):
        yield f"line {body + 1}, {lines[body][:23]!r} is not the first line of a record"
    for begin, end in pairwise(borders):
        system = lines[begin][0] if version == 3 else "G"
        if system not in "GE":
            continue
        while not lines[end - 1]:
            end -= 1
        try:
            prn = lines[begin][version - 2 : indent].strip()
            require(prn.isascii() and prn.isdigit(), "it", "begin with a satellite", f"{prn!r}")
            require(end - begin == _RECORD_LINES, "it", f"have {_RECORD_LINES} lines", end - begin)
            record = _parse_record(lines[begin:end], system, version)
        except ValueError as error:
            yield f"the record in line {begin + 1}, {lines[begin][:23]!r}, is dropped: {error}"
            continue
        if (
            system == "E" and not int(record["codes"]) & 0b101
        ):  # F/NAV: clocks of another pair of frequencies
            continue
        if system == "E":
            record["tgd"] = record["iodc"]  # the group delay of E1 and E5b goes with I/NAV
        yield {**record, "sys": system, "prn": float(prn), "line": begin + 1.0}


def _parse_record(lines: Sequence[str], system: str, version: int) -> dict[str, float]:
    """Parse the fields of a GPS or Galileo record."""
    indent = version + 1
    date = parse_date(lines[0][indent : 19 + indent].split())
    for line in lines:
        if line[indent + 76 :].strip():
            raise ValueError(f"expected no text after the last number, got {line[indent + 76 :]!r}")
    fields = [lines[0][19 + indent + 19 * k :][:19] for k in range(3)]
    fields += [line[indent + 19 * k :][:19] for line in lines[1:] for k in range(4)]
    required = _REQUIRED | _BY_SYSTEM[system]
    # a field that is not used does not decide about a record
    record = {
        name: _parse_number(text) if name in required else math.nan
        for name, text in zip(LINES[1:], fields, strict=False)
    }
    record["toc"] = date % WEEK
    blank = [field for field in LINES if field in required and math.isnan(record[field])]
    if blank:
        raise ValueError(f"expected numbers, got blank fields {', '.join(blank)}")
    difference = record["week"] * WEEK + record["toe"] - date
    if abs(difference - 1024 * WEEK * round(difference / (1024 * WEEK))) > _SAME_DATE:
        raise ValueError(
            f"week and toe must be near the date, got {record['week']:g} and {record['toe']:g}"
        )
    return record


def _parse_number(field: str) -> float:
    """Parse a field of 19 characters. A blank field is NaN."""
    text = field.strip()
    if not text:
        return math.nan
    match = _NUMBER.fullmatch(text)
    if not match:
        raise ValueError(f"expected a number like 0.123456789012D-04, got {text!r}")
    digits, exponent, bare = match.groups()
    return float(f"{digits}e{exponent or bare}")


def parse_date(fields: Sequence[str]) -> float:
    """Return the GPS time of a date, s since 1980-01-06."""
    if len(fields) != 6 or not all(f.isascii() and f.isdigit() for f in fields[:5]):
        raise ValueError(f"expected year, month, day, hour, minute and second, got {fields}")
    year, month, day, hour, minute = (int(field) for field in fields[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    second = float(fields[5])
    require(0.0 <= second < 60.0, "the second", "be at least 0 and less than 60", f"{second:g}")
    return (datetime(year, month, day, hour, minute) - EPOCH).total_seconds() + second


def unfold_blocks(lines: Sequence[str], body: int) -> tuple[list[str], tuple[str, ...]]:
    """Return a RINEX 4 file with the records of RINEX 3 alone, other lines blank, and a note on messages left out."""
    records, skipped = [*lines[:body], *[""] * (len(lines) - body)], set()
    for begin, block in _blocks(lines, body):
        kind, satellite, message = (*lines[begin][1:].split(), "", "", "")[:3]
        if kind == "EPH" and (satellite[:1] not in ("G", "E") or message in _READ):
            records[begin + 1 : begin + 1 + len(block)] = block
        elif kind == "EPH":
            skipped.add(message)
    note = f"messages {', '.join(sorted(skipped))} of GPS and Galileo: LNAV, INAV and FNAV are read"
    return records, (note,) if skipped else ()


def find_ionosphere(lines: Sequence[str], body: int) -> tuple[float, ...]:
    """Return the eight coefficients of the broadcast ionosphere of GPS, none without them."""
    for begin, block in _blocks(lines, body):
        if lines[begin][2:7] == "ION G" and "LNAV" in lines[begin]:
            numbers = [
                *_fields(block[0], 23, 19)[:3],
                *_fields(block[1], 4, 19)[:4],
                *_fields(block[2], 4, 19)[:1],
            ]
            return tuple(numbers) if len(numbers) == 8 else ()
    fields = {}
    for line in lines[:body]:
        label = line[60:].strip()
        if label in ("ION ALPHA", "ION BETA"):
            fields[label[4]] = _fields(line[:60], 2, 12)[:4]
        elif label == "IONOSPHERIC CORR" and line[:4] in ("GPSA", "GPSB"):
            fields[line[3]] = _fields(line[:60], 5, 12)[:4]
    numbers = [*fields.get("A", ()), *fields.get("B", ())]
    return tuple(numbers) if len(numbers) == 8 else ()


def _blocks(lines: Sequence[str], body: int) -> Iterator[tuple[int, Sequence[str]]]:
    """Yield the first line of each block of RINEX 4 and the lines after it."""
    heads = [i for i in range(body, len(lines)) if lines[i][:1] == ">"]
    for begin, end in pairwise([*heads, len(lines)]):
        yield begin, lines[begin + 1 : end]


def _fields(line: str, first: int, width: int) -> list[float]:
    """Return the numbers of fields of a width up to the first blank one."""
    texts = [line[k : k + width].strip() for k in range(first, len(line), width)]
    return [float(text.upper().replace("D", "E")) for text in texts if text]
