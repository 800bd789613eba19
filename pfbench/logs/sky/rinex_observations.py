"""Pseudorange, Doppler and signal strength of one signal per satellite from RINEX 3 observation files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.files.limits import read_text
from pfbench.files.table_file import Array
from pfbench.logs.sky.ephemeris import parse_date

# signals on 1575.42 MHz in order of preference: GPS L1 C/A, Galileo E1
SIGNALS: Mapping[str, Sequence[str]] = {"G": ("1C",), "E": ("1C", "1X", "1B")}
_COMPRESSED, _HATANAKA = "\x1f\x8b", "CRINEX VERS"
_SCALES = ("", "GPS", "GAL")  # time systems that agree to nanoseconds
_WIDTH, _FIRST = 16, 3  # columns of an observation, and where the first begins
_WHOLE_EPOCH = "Write the file again, or remove this line and those of its epoch."


class RawEpochs(NamedTuple):
    """Observations of a RINEX file.

    Attributes:
        rows: A row per epoch and satellite: `time` (GPS time by the receiver's clock, s since 1980-01-06), `sys`, `svid`,
            `pr` m, `doppler` Hz, `cn0` dB-Hz. NaN where the receiver gives none. `t`, s after `start`.
        name: Name of the file.
        position: Position in the header, Earth-fixed, m, or None.
        notes: What was not read.
        start: GPS time of t = 0, s since 1980-01-06.
    """

    rows: pd.DataFrame
    name: str
    position: tuple[float, float, float] | None
    notes: tuple[str, ...]
    start: float = 0.0

    @property
    def time(self) -> Array:
        """Times of the epochs, s, [K]."""
        return np.unique(self.rows["t"].to_numpy())


def read_observations(file: Path, signals: Mapping[str, Sequence[str]]) -> RawEpochs:
    """Read a RINEX 3 observation file; of each system the first signal that the file has."""
    lines = read_text(file).removeprefix(b"\xef\xbb\xbf").decode("latin-1").splitlines()
    check_version(file.name, lines[0] if lines else "")
    types_of, position, end = _read_header(file.name, lines)
    codes_in_use = {
        s: next((code for code in codes if f"C{code}" in types_of[s]), "")
        for s, codes in signals.items()
        if s in types_of
    }
    codes_in_use = {system: code for system, code in codes_in_use.items() if code}
    readable = ", ".join(f"C{code} of {s}" for s, codes in signals.items() for code in codes)
    have = "; ".join(f"{s} {' '.join(types)}" for s, types in types_of.items())
    require(
        codes_in_use,
        f"{file.name}: the types of observations",
        f"include {readable}",
        have or "none",
        "Record these signals, or name others on 1575.42 MHz in scenario.rinex.signals.",
    )
    columns = {
        s: [
            _FIRST + _WIDTH * types_of[s].index(kind + code) if kind + code in types_of[s] else None
            for kind in "CDS"
        ]
        for s, code in codes_in_use.items()
    }  # fmt: skip
    others = ", ".join(sorted(set(types_of) - set(codes_in_use)))
    notes = [f"{file.name}: systems {others} are not read"] if others else []
    notes += [
        f"{file.name}: {'C' + code} of {system} is read" for system, code in codes_in_use.items()
    ]
    rows: list[tuple[object, ...]] = []
    for time, satellites in _epochs(file.name, lines, end, notes):
        rows += [
            (time, text[0], text[1:3], *_values(text, columns[text[0]]))
            for text in satellites
            if text[0] in columns
        ]
    names = ("time", "sys", "svid", "pr", "doppler", "cn0")
    table = pd.DataFrame(rows, columns=list(names))
    bad = int((~table["svid"].str.strip().str.isdigit()).sum())
    require(
        not bad, f"{file.name}: the satellites", "have numbers", f"{bad} without one", _WHOLE_EPOCH
    )
    table = table[table["pr"].notna()].reset_index(drop=True).astype({"svid": int})
    require(
        len(table), f"{file.name}", f"contain ranges of {readable}", "none", "Choose another file."
    )
    return RawEpochs(table, file.name, position, tuple(notes))


def check_version(name: str, first: str) -> None:
    """Check that the first line is that of a RINEX 3 observation file."""
    must = "be a RINEX 3 observation file"
    require(
        not first.startswith(_COMPRESSED),
        name,
        must,
        "a compressed file",
        "Unpack it with gunzip, or gzip -d.",
    )
    is_hatanaka = _HATANAKA in first
    require(
        not is_hatanaka,
        name,
        must,
        "one in Hatanaka's compression",
        f"Unpack it with crx2rnx: crx2rnx {name}",
    )
    require(
        "RINEX VERSION" in first, name, must, f"first line {first[:60]!r}", "Choose another file."
    )
    version, kind = first[:9].strip(), first[20:21]
    got = f"a file of RINEX {version}, type {kind!r}"
    require(kind == "O", name, must, got, "Choose the observation file, type O, of this receiver.")
    require(
        version[:1] == "3",
        name,
        must,
        got,
        "Let the receiver's program write RINEX 3, or convert it, for example by gfzrnx -vo 3.",
    )


def _read_header(
    name: str, lines: Sequence[str]
) -> tuple[dict[str, list[str]], tuple[float, float, float] | None, int]:
    """Return the types by system, the position, and the line after the header."""
    types: dict[str, list[str]] = {}
    position, system = None, ""
    for i, line in enumerate(lines):
        label = line[60:].strip()
        if label == "END OF HEADER":
            return types, position, i + 1
        if label == "SYS / # / OBS TYPES":
            system = line[0].strip() or system
            types.setdefault(system, []).extend(line[6:60].split())
        elif label == "APPROX POSITION XYZ":
            x, y, z = (float(text) for text in line[:60].split()[:3])
            position = (x, y, z) if math.hypot(x, y, z) > 1.0 else None
        elif label == "TIME OF FIRST OBS":
            scale, remedy = line[48:51].strip(), "Write the file with GPS time."
            require(scale in _SCALES, f"{name}: the times", "be GPS time", scale, remedy)
        elif label == "SYS / SCALE FACTOR":
            require(
                line[2:6].strip() in ("", "0", "1"),
                f"{name}: SYS / SCALE FACTOR",
                "be 1",
                line[2:6].strip(),
                "Write the file without scale factors.",
            )
    raise ValueError(f"{name} must have a line END OF HEADER, got none. Write the file again.")


def _values(text: str, columns: Sequence[int | None]) -> list[float]:
    """Return the observations of a satellite in some columns, NaN for blank or zero."""
    values = [
        float(text[c : c + 14].strip() or "nan") if c is not None else math.nan for c in columns
    ]
    return [value or math.nan for value in values]


def _epochs(
    name: str, lines: Sequence[str], start: int, notes: list[str]
) -> Iterator[tuple[float, Sequence[str]]]:
    """Yield the time of each epoch and the lines of its satellites."""
    i, events = start, 0
    while i < len(lines):
        head = lines[i]
        if not head.strip():
            i += 1
            continue
        try:
            flag, count = head[31:32].strip() or "0", int(head[32:35])
            time = parse_date(head[1:29].split()) if flag in "01" else 0.0
            if head[:1] != ">" or count < 0:
                raise ValueError("an epoch must begin with > and have a number of satellites")
        except ValueError as error:
            raise ValueError(
                f"{name}: line {i + 1} must be the first line of an epoch, got {head[:35]!r} ({error}). {_WHOLE_EPOCH}"
            ) from None
        body = lines[i + 1 : i + 1 + count]
        i += 1 + count
        if flag not in "01":
            events += 1
        elif len(body) < count or any(text[:1] in (">", "") for text in body):
            notes.append(f"{name}: the epoch before line {i + 1} lacks satellites and is dropped")
            i -= count - next((k for k, text in enumerate(body) if text[:1] == ">"), count)
        else:
            yield time, body
    if events:
        notes.append(f"{name}: {events} records of events are not read")
