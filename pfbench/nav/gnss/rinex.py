"""Ephemerides from RINEX 2 and 3 navigation files. A record that cannot be read is dropped with a note."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pandas as pd

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
_REQUIRED = {*CLOCK, *ORBIT, "week", "health", "ttx"}
_BY_SYSTEM = {"G": {"tgd"}, "E": {"codes", "iodc"}}  # other fields that are used
_RECORD_LINES = 8
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
    """

    rows: pd.DataFrame
    notes: tuple[str, ...]


def read_rinex(file: Path) -> RinexFile:
    """Read GPS and Galileo (I/NAV) ephemerides from a RINEX 2 or 3 navigation file.

    A record that cannot be read is dropped, and a note names its line.

    Raises:
        ValueError: If the file is of another kind, or most of its records cannot be read.
    """
    lines = _lines(file)
    version = lines[0][:9].strip() if lines and "RINEX VERSION" in lines[0] else ""
    if version[:1] not in ("2", "3") or lines[0][20:21] != "N":
        raise ValueError(
            f"the file {file.name} must be a RINEX 2 or 3 navigation file, {_describe_kind(lines)}"
        )
    body = next((i + 1 for i, line in enumerate(lines) if "END OF HEADER" in line), len(lines))
    records = list(_records(lines, body, 3 if version[0] == "3" else 2))
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
    systems = _describe_others(lines, body, version[0])
    unread = (f"{file.name}: not read: {text}" for text in systems)
    return RinexFile(pd.DataFrame(rows), (*dropped, *unread))


def _describe_kind(lines: Sequence[str]) -> str:
    """Describe a file that is not a navigation file of RINEX 2 or 3, and its remedy."""
    first = lines[0] if lines else ""
    if first.startswith("\x1f"):
        return "got a compressed file. Unpack it with gunzip, or gzip -d."
    if "RINEX VERSION" not in first:
        return f"got first line {first[:60]!r}. Choose another file."
    version, kind = first[:9].strip(), _KINDS.get(first[20:21], "unknown")
    same_day = "Choose the GPS or mixed navigation file (type N) of RINEX 2 or 3 of the same day."
    return f"got a {kind} file of RINEX {version}. {same_day}"


def _lines(file: Path) -> list[str]:
    # names and comments contain other letters, which are read but not used
    text = file.read_bytes().removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    return [line.rstrip() for line in text.split("\n")]


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
    if borders[0] > body:
        yield f"line {body + 1}, {lines[body][:23]!r} is not the first line of a record"
    for begin, end in pairwise(borders):
        system = lines[begin][0] if version == 3 else "G"
        if system not in "GE":
            continue
        try:
            prn = lines[begin][version - 2 : indent].strip()
            if not (prn.isascii() and prn.isdigit()):
                raise ValueError(f"it must begin with a satellite, got {prn!r}")
            if end - begin != _RECORD_LINES:
                raise ValueError(f"it must have {_RECORD_LINES} lines, got {end - begin}")
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
    date = _parse_date(lines[0][indent : 19 + indent].split())
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


def _parse_date(fields: Sequence[str]) -> float:
    """Return the GPS time of a date, s since 1980-01-06."""
    if len(fields) != 6 or not all(f.isascii() and f.isdigit() for f in fields[:5]):
        raise ValueError(f"expected year, month, day, hour, minute and second, got {fields}")
    year, month, day, hour, minute = (int(field) for field in fields[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    second = float(fields[5])
    if not 0.0 <= second < 60.0:
        raise ValueError(f"the second must be at least 0 and less than 60, got {second:g}")
    return (datetime(year, month, day, hour, minute) - EPOCH).total_seconds() + second
