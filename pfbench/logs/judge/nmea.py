"""Reader of NMEA 0183: GGA or GNS (position), RMC and VTG (velocity), GST (standard deviations)."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.files.limits import read_text
from pfbench.files.table_file import split_lines
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import GEODETIC, POSITION_SD, TrajectoryTable

_KNOT, _KM_H = 1852 / 3600, 1 / 3.6  # m/s
_DAY, _HOUR = 86400.0, 3600.0  # s
_POSITIONS = ("GGA", "GNS")
_SENTENCE = re.compile(  # of a talker of two letters: proprietary ones start with P
    r"(?P<sign>[$!])(?P<body>(?:[A-OQ-Z][A-Z0-9](?P<kind>[A-Z]{3})|[A-Z][A-Z0-9]+),[^$*!]*)"
    r"(?P<star>\*(?P<checksum>[0-9A-Fa-f]{2})?)?"
)
_WITHOUT_SIGN = re.compile(r"^[^$]*\b[A-Z]{2}(?:GGA|GNS|RMC|VTG|GST),")
_HORIZONTAL = ("vn", "ve")
_Epoch = dict[str, float]


class _Sentence(NamedTuple):
    line: int
    kind: str  # as GGA
    body: str
    checksum: str  # "valid", "wrong" or "none"

    @property
    def fields(self) -> list[str]:
        """Fields of the sentence; a log has millions, so that they are not kept."""
        return self.body.split(",")


def read_nmea_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read sentences of one receiver; the time is the UTC second of the first day.

    Positions are those of GGA, or of GNS without GGA. The height is that above the ellipsoid: altitude plus
    geoid separation, where the receiver states it. NMEA states no vertical velocity. Other sentences and
    other lines are skipped and counted in a note. A receiver can leave out checksums, in all sentences.
    """
    counts: Counter[str] = Counter()
    sentences = _read_sentences(file, counts)
    notes = _check_checksums(file, sentences)
    kinds = Counter(f"{s.kind} sentences" for s in sentences if s.kind)
    extras: dict[float, _Epoch] = {}
    positions = _read_positions(file, sentences, extras, counts)
    require(
        positions,
        file.name,
        "have GGA or GNS sentences with a fix and a height",
        ", ".join(f"{n} {name}" for name, n in sorted((kinds + counts).items())) or "none",
        "Let the receiver write GGA.",
    )
    merged = [{**epoch, **extras.get(epoch["t"], {})} for _, epoch in positions]
    lines = np.array([line for line, _ in positions])
    return [_make_table(file, merged, lines, counts, notes)]


def _read_positions(
    file: Path, sentences: list[_Sentence], extras: dict[float, _Epoch], counts: Counter[str]
) -> list[tuple[int, _Epoch]]:
    """Return line and position of all epochs; velocities and deviations by time are added to `extras`."""
    positions: dict[str, list[tuple[int, _Epoch]]] = {kind: [] for kind in _POSITIONS}
    previous: dict[str, _Sentence] = {}
    clock = _Clock()
    for sentence in (s for s in sentences if s.kind):
        values, problem = _read_values(file, sentence, clock)
        before = previous.get(sentence.kind)
        if problem:
            counts[f"{sentence.kind} sentences {problem}"] += 1
        elif sentence.kind not in _POSITIONS:
            extras.setdefault(clock.time, {}).update(values)
        elif (
            before
            and sentence.fields[1] == before.fields[1]
            and (sentence.fields[0] != before.fields[0] or sentence.fields == before.fields)
        ):  # the same time, from another talker or word for word
            counts[f"{sentence.kind} sentences of another talker or twice"] += 1
        else:
            positions[sentence.kind].append((sentence.line, {"t": clock.time, **values}))
            previous[sentence.kind] = sentence
    return next((p for p in positions.values() if p), [])


class _Clock:
    """UTC second since the start of the first day, at the last sentence that states a time."""

    def __init__(self) -> None:
        self.time, self.days = math.nan, 0

    def read(self, text: str) -> None:
        """Read hhmmss.ss; the sentences around midnight can be out of order."""
        second = 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:])
        time = second + _DAY * self.days
        if time < self.time - _DAY / 2:
            self.days += 1
            time += _DAY
        elif max(abs(time - _DAY - self.time), abs(_DAY * self.days - self.time)) < _HOUR:
            time -= _DAY
        self.time = time


def _read_values(file: Path, sentence: _Sentence, clock: _Clock) -> tuple[_Epoch, str]:
    """Return the values of a sentence, or why it has none."""
    fields = sentence.fields
    try:
        if sentence.kind != "VTG" and fields[1]:
            clock.read(fields[1])
        elif sentence.kind in _POSITIONS:
            return {}, "without a time"
        values = _READERS[sentence.kind](fields)
    except (ValueError, IndexError):
        raise ValueError(
            f"{file.name}: line {sentence.line} must have the fields of NMEA 0183, got "
            f"{sentence.body[:80]!r}. Repair or remove this line."
        ) from None
    return values, "" if values else "without a fix or a value"


def _make_table(
    file: Path,
    epochs: list[_Epoch],
    lines: np.ndarray,
    counts: Counter[str],
    notes: list[str],
) -> TrajectoryTable:
    """Collect the columns that all epochs have."""
    time = np.array([epoch["t"] for epoch in epochs])
    notes = [*notes, *(f"{count} {name}" for name, count in sorted(counts.items()) if count)]
    values = {name: np.array([epoch[name] for epoch in epochs]) for name in GEODETIC}
    values["h_m"] = values["h_m"] + _fill_separation(epochs, notes)
    for group in (_HORIZONTAL, POSITION_SD):
        complete = sum(group[0] in epoch for epoch in epochs)
        if complete == len(epochs):
            values |= {name: np.array([epoch[name] for epoch in epochs]) for name in group}
        elif complete:
            notes.append(
                f"{', '.join(group)} not used: present in {complete} of {len(epochs)} epochs"
            )
    return TrajectoryTable(file.name, time, values, lines, tuple(notes))


def _fill_separation(epochs: list[_Epoch], notes: list[str]) -> np.ndarray:
    """Return the geoid separation of each epoch, [T], m; the nearest one in time where it is not stated."""
    separation = np.array([epoch["separation"] for epoch in epochs])
    missing = np.isnan(separation)
    if missing.all():
        notes.append("no geoid separation: heights are above the geoid, not above the ellipsoid")
        return np.zeros(len(epochs))
    if missing.any():
        notes.append(f"{int(missing.sum())} epochs have the geoid separation of the nearest one")
        rows = np.arange(len(epochs))
        separation = np.interp(rows, rows[~missing], separation[~missing])
    return separation


def _read_sentences(file: Path, counts: Counter[str]) -> list[_Sentence]:
    """Return the sentences that are read; others and other lines are counted."""
    sentences = []
    *lines, last = split_lines(read_text(file).decode("ascii", "replace"))
    for number, line in enumerate(map(str.strip, (*lines, last)), 1):
        require(
            not _WITHOUT_SIGN.search(line),
            f"{file.name}: line {number}",
            "start with $",
            repr(line[:60]),
            "Remove this line.",
        )
        matches = list(_SENTENCE.finditer(line))
        counts["other lines"] += bool(line) and not matches
        for match in matches:
            checksum = "none" if match["star"] is None else "wrong"
            if (match["checksum"] or "").upper() == _compute_checksum(match["body"]):
                checksum = "valid"
            kind = match["kind"] if match["kind"] in _READERS else ""
            if match["sign"] == "!":  # of other systems, as AIS
                kind, checksum = "", "none"
            sentences.append(_Sentence(number, kind, match["body"], checksum))
    while sentences and sentences[-1].line > len(lines) and sentences[-1].checksum != "valid":
        counts["damaged sentences in the last line, which has no end"] += 1
        sentences.pop()
    counts["other sentences"] = sum(not sentence.kind for sentence in sentences)
    return sentences


def _compute_checksum(body: str) -> str:
    return f"{reduce(xor, body.encode('ascii', 'replace'), 0):02X}"


def _check_checksums(file: Path, sentences: list[_Sentence]) -> list[str]:
    """Raise ValueError for a wrong checksum, or a missing one among others; return notes."""
    read = [sentence for sentence in sentences if sentence.kind]
    wrong = [sentence for sentence in read if sentence.checksum == "wrong"]
    none = [sentence for sentence in read if sentence.checksum == "none"]
    bad = wrong or (none if len(none) < len(read) else [])
    if bad:
        body = bad[0].body
        remedy = (
            "Remove these lines." if wrong else "Remove these lines, or all checksums with their *."
        )
        if len(wrong) > len(sentences) / 2:
            remedy = "If a program changed the sentences, remove all checksums with their *."
        raise ValueError(
            f"{file.name}: line {bad[0].line} must have the checksum {_compute_checksum(body)}, got "
            f"{'another one' if wrong else 'none'} in {body[:60]!r} ({len(bad)} of {len(sentences)} "
            f"sentences). {remedy}"
        )
    damaged = sum(not sentence.kind and sentence.checksum == "wrong" for sentence in sentences)
    notes = [f"{damaged} damaged sentences of kinds that are not read"] if damaged else []
    return [*notes, *(["no checksums: damaged lines cannot be told from valid ones"] if none else [])]  # fmt: skip


def _read_angle(text: str, side: str) -> float:
    """Convert degrees and minutes, as 4807.038, to degrees."""
    degrees, minutes = divmod(float(text), 100)
    require(
        side in ("N", "S", "E", "W") and side and (not minutes >= 60),
        "angle",
        "be degrees and minutes with N, S, E or W",
        f"{text} {side}",
    )
    angle = degrees + minutes / 60
    return -angle if side in ("S", "W") else angle


def _read_fix(fields: list[str]) -> _Epoch:
    """Return the position of GGA or GNS; empty without a fix: quality 0, or mode N of all systems."""
    needed = (*fields[2:6], fields[9])
    if not fields[6].strip("0N") or not all(needed):
        return {}
    lat, lon = _read_angle(fields[2], fields[3]), _read_angle(fields[4], fields[5])
    return {
        "lat_deg": lat,
        "lon_deg": lon,
        "h_m": float(fields[9]),
        "separation": float(fields[11] or "nan"),
    }


def _read_gga(fields: list[str]) -> _Epoch:
    if fields[10] not in ("M", "") or fields[12:13] not in (["M"], [""], []):
        raise ValueError(f"unit of heights must be M, got {fields[10:13]}")
    return _read_fix(fields)


def _read_minimum(fields: list[str]) -> _Epoch:
    if fields[2] != "A" or not fields[7]:
        return {}
    return _velocity(_KNOT * float(fields[7]), fields[8])


def _read_ground_velocity(fields: list[str]) -> _Epoch:
    """Return the velocity of VTG; before NMEA 2.0 without letters of units."""
    if len(fields) == 5:
        course, knots, speed = fields[1], fields[3], fields[4]
    else:
        course, knots, speed = fields[1], fields[5], fields[7]
    if not (speed or knots):
        return {}
    return _velocity(_KM_H * float(speed) if speed else _KNOT * float(knots), course)


def _velocity(speed: float, course: str) -> _Epoch:
    """Return the velocity; a receiver states no course at standstill."""
    if not course and speed > 0.5:
        return {}
    angle = math.radians(float(course or 0.0))
    return {"vn": speed * math.cos(angle), "ve": speed * math.sin(angle)}


def _read_deviations(fields: list[str]) -> _Epoch:
    if not all(fields[6:9]):
        return {}
    return dict(zip(POSITION_SD, map(float, fields[6:9]), strict=True))


_READERS: dict[str, Callable[[list[str]], _Epoch]] = {
    "GGA": _read_gga,
    # whose geoid separation lies one field nearer, without units
    "GNS": lambda fields: _read_fix([*fields[:10], "M", *fields[10:]]),
    "RMC": _read_minimum,
    "VTG": _read_ground_velocity,
    "GST": _read_deviations,
}
