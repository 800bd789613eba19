"""Reader of NMEA 0183: GGA (position), RMC and VTG (velocity), GST (standard deviations)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from pfbench.judge.judge_options import SourceOptions
from pfbench.judge.readers.trajectory_table import GEODETIC, POSITION_SD, TrajectoryTable

_KNOT, _KM_H = 1852 / 3600, 1 / 3.6  # m/s
_DAY = 86400.0  # s
_HORIZONTAL = ("vn", "ve")
_Epoch = dict[str, float]


def read_nmea_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read sentences of one receiver; the time is the UTC second of the first day.

    The height is that above the ellipsoid: altitude plus geoid separation. NMEA states no vertical
    velocity.

    Args:
        file: File.
        options: Options.

    Returns:
        One table. Velocity and standard deviations are left out with a note unless all epochs have
        them.

    Raises:
        ValueError: If a checksum or a field is wrong, or no GGA sentence has a position.
    """
    epochs: list[_Epoch] = []
    lines: list[int] = []
    extras: dict[float, _Epoch] = {}
    counts: Counter[str] = Counter()
    last = math.nan
    for number, line in enumerate(
        file.read_text(encoding="ascii", errors="replace").split("\n"), 1
    ):
        kind, fields = _split_sentence(file, number, line.strip())
        reader = _SENTENCES.get(kind)
        if reader is None:
            counts["other sentences"] += bool(kind)
            continue
        try:
            last = _read_time(fields[1]) if kind != "VTG" and fields[1] else last
            values = reader(fields)
        except (ValueError, IndexError):
            raise _field_error(file, number, line) from None
        if values is None:
            counts[f"{kind} sentences without a fix"] += 1
        elif kind == "GGA":
            epochs.append({"t": last, **values})
            lines.append(number)
        else:
            extras.setdefault(last, {}).update(values)
    if not epochs:
        raise ValueError(
            f"{file.name} must have GGA sentences with a fix, got none in {number} lines. Log GGA."
        )
    merged = [{**epoch, **extras.get(epoch["t"], {})} for epoch in epochs]
    return [_make_table(file, merged, np.array(lines), counts)]


def _make_table(
    file: Path, epochs: list[_Epoch], lines: np.ndarray, counts: Counter[str]
) -> TrajectoryTable:
    """Collect the columns that all epochs have."""
    time = np.array([epoch["t"] for epoch in epochs])
    days = np.cumsum(np.diff(time, prepend=time[0]) < -_DAY / 2)  # midnight passed
    notes = [f"{count} {name}" for name, count in sorted(counts.items()) if count]
    values = {name: np.array([epoch[name] for epoch in epochs]) for name in GEODETIC}
    for group in (_HORIZONTAL, POSITION_SD):
        complete = sum(group[0] in epoch for epoch in epochs)
        if complete == len(epochs):
            values |= {name: np.array([epoch[name] for epoch in epochs]) for name in group}
        elif complete:
            notes.append(
                f"{', '.join(group)} not used: present in {complete} of {len(epochs)} epochs"
            )
    return TrajectoryTable(file.name, time + days * _DAY, values, lines, tuple(notes))


def _split_sentence(file: Path, number: int, line: str) -> tuple[str, list[str]]:
    """Return kind and fields of a sentence with a valid checksum; an empty kind for an empty line."""
    if not line.startswith("$"):
        if line:
            raise ValueError(
                f"{file.name}: line {number} must start with $, got {line[:60]!r}. Remove this line."
            )
        return "", []
    body, star, checksum = line[1:].partition("*")
    computed = reduce(xor, body.encode("ascii", "replace"), 0)
    if not star or checksum.upper() != f"{computed:02X}":
        raise ValueError(
            f"{file.name}: line {number} must have the checksum {computed:02X}, got "
            f"{checksum or 'none'} in {line[:60]!r}. Remove this line."
        )
    fields = body.split(",")
    return fields[0][-3:], fields


def _field_error(file: Path, number: int, line: str) -> ValueError:
    return ValueError(
        f"{file.name}: line {number} must have the fields of NMEA 0183, got {line[:80]!r}. "
        "Repair or remove this line."
    )


def _read_time(text: str) -> float:
    return 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:])


def _read_angle(text: str, side: str) -> float:
    """Convert degrees and minutes, as 4807.038, to degrees."""
    point = text.index(".")
    angle = float(text[: point - 2]) + float(text[point - 2 :]) / 60
    if side not in ("N", "S", "E", "W") or not side:
        raise ValueError(f"side must be N, S, E or W, got {side}")
    return -angle if side in ("S", "W") else angle


def _read_position(fields: list[str]) -> _Epoch | None:
    if fields[6] in ("", "0"):
        return None
    height = float(fields[9]) + float(fields[11])
    lat, lon = _read_angle(fields[2], fields[3]), _read_angle(fields[4], fields[5])
    return {"lat_deg": lat, "lon_deg": lon, "h_m": height}


def _read_minimum(fields: list[str]) -> _Epoch | None:
    if fields[2] != "A":
        return None
    return _velocity(_KNOT * float(fields[7]), fields[8])


def _read_ground_velocity(fields: list[str]) -> _Epoch | None:
    return _velocity(_KM_H * float(fields[7]), fields[1]) if fields[7] else None


def _velocity(speed: float, course: str) -> _Epoch:
    """Return the velocity; a receiver states no course at standstill."""
    if not course and speed > 0.5:
        raise ValueError(f"course must be present at a speed of {speed} m/s")
    angle = math.radians(float(course or 0.0))
    return {"vn": speed * math.cos(angle), "ve": speed * math.sin(angle)}


def _read_deviations(fields: list[str]) -> _Epoch | None:
    if not fields[6]:
        return None
    return dict(zip(POSITION_SD, map(float, fields[6:9]), strict=True))


_SENTENCES: dict[str, Callable[[list[str]], _Epoch | None]] = {
    "GGA": _read_position,
    "RMC": _read_minimum,
    "VTG": _read_ground_velocity,
    "GST": _read_deviations,
}
