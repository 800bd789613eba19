"""Ephemerides from RINEX 2 and 3 navigation files. A field that cannot be read is an error."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import Path

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
_RECORD_LINES = {"G": 8, "E": 8, "C": 8, "J": 8, "I": 8, "R": (4, 5), "S": 4}
_NUMBER = re.compile(r"[-+]?\d*\.\d{1,14}[DdEe][-+]\d\d")
_SAME_DATE = 3 * 7200.0  # s; longest time between clock and orbit


def read_rinex(file: Path) -> pd.DataFrame:
    """Read GPS and Galileo (I/NAV) ephemerides from a RINEX 2 or 3 navigation file.

    One row per ephemeris, with `toc` in seconds of the week, and `line`.

    Raises:
        ValueError: If the file is of another kind, or a record cannot be read (names the line).
    """
    lines = _lines(file)
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


def _lines(file: Path) -> list[str]:
    content = file.read_bytes()
    try:
        text = content.decode("ascii")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(
            f"the file {file.name} must be ASCII text, got the byte {content[error.start]:#04x} in "
            f"line {line}. Repair or remove the record."
        ) from None
    return [line.rstrip() for line in text.split("\n")]


def _records(
    lines: Sequence[str], body: int, version: int, name: str
) -> Iterator[dict[str, float | str]]:
    """Yield records from line `body` on. Numbers have columns of 19 after an indent."""
    indent = version + 1
    end_of_text = len(lines)
    while end_of_text > body and not lines[end_of_text - 1]:
        end_of_text -= 1
    first_lines = [i for i in range(body, end_of_text) if lines[i][:indent].strip()]
    if end_of_text > body and (not first_lines or first_lines[0] != body):
        raise ValueError(
            f"{name}: line {body + 1}, {lines[body][:23]!r} is not the first line of a record. "
            "Repair or remove it."
        )
    for begin, end in pairwise([*first_lines, end_of_text]):
        label = f"{name}: line {begin + 1}, {lines[begin][:23]!r}"
        system = lines[begin][0] if version == 3 else "G"
        try:
            _check_size(system, end - begin)
            if system not in "GE":
                continue
            record = _parse_record(lines[begin:end], system, version)
        except ValueError as error:
            raise ValueError(
                f"{label} is not a valid record: {error}. Repair or remove it."
            ) from None
        if (
            system == "E" and not int(record["codes"]) & 0b101
        ):  # F/NAV: clocks of another pair of frequencies
            continue
        if system == "E":
            record["tgd"] = record["iodc"]  # the group delay of E1 and E5b goes with I/NAV
        prn = lines[begin][version - 2 : indent].strip()
        if not prn.isdigit():
            raise ValueError(f"{label} must begin with a satellite, got {prn!r}. Remove it.")
        yield {**record, "sys": system, "prn": float(prn), "line": begin + 1.0}


def _check_size(system: str, size: int) -> None:
    expected = _RECORD_LINES.get(system)
    if expected is None:
        raise ValueError(f"the system must be one of {', '.join(_RECORD_LINES)}, got {system!r}")
    if size not in (expected if isinstance(expected, tuple) else (expected,)):
        raise ValueError(f"not a complete record, expected {expected} lines, got {size}")


def _parse_record(lines: Sequence[str], system: str, version: int) -> dict[str, float]:
    """Parse the fields of a GPS or Galileo record."""
    indent = version + 1
    date = _parse_date(lines[0][indent : 19 + indent].split())
    numbers = [_parse_number(lines[0], 19 + indent + 19 * k) for k in range(3)]
    numbers += [_parse_number(line, indent + 19 * k) for line in lines[1:] for k in range(4)]
    for line, fields in ((lines[0], 4), *((line, 4) for line in lines[1:])):
        if line[indent + 19 * fields :].strip():
            raise ValueError(
                f"expected no text after the last number, got {line[indent + 19 * fields :]!r}"
            )
    record = dict(zip(LINES, [date % WEEK, *numbers], strict=False))
    required = _REQUIRED | ({"codes", "iodc"} if system == "E" else {"tgd"})
    blank = [field for field in LINES if field in required and math.isnan(record[field])]
    if blank:
        raise ValueError(f"expected numbers, got blank fields {', '.join(blank)}")
    difference = record["week"] * WEEK + record["toe"] - date
    if abs(difference - 1024 * WEEK * round(difference / (1024 * WEEK))) > _SAME_DATE:
        raise ValueError(
            f"week and toe must be near the date, got {record['week']:g} and {record['toe']:g}"
        )
    return record


def _parse_number(line: str, start: int) -> float:
    """Parse a field of 19 characters. A blank field is NaN."""
    text = line[start : start + 19].strip()
    if not text:
        return math.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"expected a number like 0.123456789012D-04, got {text!r}")
    return float(text.replace("D", "e").replace("d", "e"))


def _parse_date(fields: Sequence[str]) -> float:
    """Return the GPS time of a date, s since 1980-01-06."""
    if len(fields) != 6 or not all(field.isdigit() for field in fields[:5]):
        raise ValueError(f"expected year, month, day, hour, minute and second, got {fields}")
    year, month, day, hour, minute = (int(field) for field in fields[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    second = float(fields[5])
    if not 0.0 <= second < 60.0:
        raise ValueError(f"the second must be at least 0 and less than 60, got {second:g}")
    return (datetime(year, month, day, hour, minute) - EPOCH).total_seconds() + second
