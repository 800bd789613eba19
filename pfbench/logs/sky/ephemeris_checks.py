"""Plausibility of broadcast ephemerides: ranges, agreement of neighbours, clocks and gravity."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.logs.sky.ephemeris import CLOCK, ORBIT, broadcast_elements
from pfbench.logs.units import WEEK
from pfbench.nav import earth

# Merged files contain records with reception errors. Such a record is ignored, and a note names it.

_TURN = 2 * math.pi
# parameter: least, largest, unit. Widths of the fields [IS-GPS-200, tables 20-I and 20-III;
# OS SIS ICD, tables 60 and 62], and ranges of the orbits in use [ours]
RANGES = {
    "prn": (1.0, 63.0, "1"),
    "toe": (0.0, WEEK, "s"),
    "i0": (0.8, 1.2, "rad"),
    "M0": (-_TURN, _TURN, "rad"),
    "Omega0": (-_TURN, _TURN, "rad"),
    "omega": (-_TURN, _TURN, "rad"),
    "deltan": (-1.2e-8, 1.2e-8, "rad/s"),
    "Omegadot": (-2e-8, 2e-8, "rad/s"),
    "idot": (-3e-9, 3e-9, "rad/s"),
    **dict.fromkeys(("cuc", "cus"), (-3e-5, 3e-5, "rad")),  # the Earth's oblateness: 1.3e-5
    **dict.fromkeys(("cic", "cis"), (-5e-6, 5e-6, "rad")),  # 0.8e-6, and 2.5e-6 for E14
    **dict.fromkeys(("crc", "crs"), (-1024.0, 1024.0, "m")),
    "af0": (-2e-2, 2e-2, "s"),
    "af1": (-3.8e-9, 3.8e-9, "s/s"),
    "af2": (-3.6e-15, 3.6e-15, "s/s^2"),
    "tgd": (-1.3e-7, 1.3e-7, "s"),
    "health": (0.0, 511.0, "1"),
    "week": (0.0, 1e4, "1"),
}
# least and largest root of the semi-major axis, m^(1/2), and eccentricity. E14 and E18 missed their orbit
ORBITS = {
    "G": ((5100.0, 5200.0, 0.0, 0.04),),
    "E": ((5200.0, 5350.0, 0.1, 0.2), (5350.0, 5500.0, 0.0, 0.01)),
}
LARGEST_PRN = {"G": 63, "E": 36}  # [IS-GPS-200, 3.2.1; OS SIS ICD, 3.6]
TOE_STEP = {"G": 16.0, "E": 60.0}  # s; scale of the field
_LONGEST = 14400.0  # s between compared neighbours
POSITION_TOLERANCE = 30.0  # m; over one day of IGS files neighbours agree to 4.5 m
CLOCK_TOLERANCE = 1e-7  # s, 30 m; over one day of IGS files neighbours agree to 9.3 ns
DELAY_TOLERANCE = 1e-8  # s, 3 m; group delay
_CLOCK_AGE = 7200.0  # s; longest time between toc and toe
_LARGEST_SHARE = 0.2  # of records out of range in a merged file


def check_ephemerides(table: pd.DataFrame, name: str) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Select ephemerides with plausible parameters that agree with their neighbours.

    Returns plausible ephemerides, and notes on ignored ones and on changes of orbit.
    """
    reasons = [_reason(row) for row in table.to_dict("records")]
    share = sum(map(bool, reasons)) / max(len(reasons), 1)
    if len(reasons) > 1 and share > _LARGEST_SHARE:
        text = next(filter(None, reasons))
        raise ValueError(
            f"{name} must contain plausible ephemerides, got {share:.0%} out of range, "
            f"the first with {text}. Check the units: rad, s, m."
        )
    notes = [
        f"{name}: {_label(table, i)} is ignored because its {reason}"
        for i, reason in enumerate(reasons)
        if reason
    ]
    mask = np.array([not reason for reason in reasons], dtype=bool)
    alone: list[str] = []
    for satellite in sorted(set(table["name"][mask])):
        rows = np.flatnonzero(mask & (table["name"] == satellite).to_numpy())
        dropped, group_notes, compared = _compare(table, rows, name)
        mask[dropped] = False
        notes += group_notes
        alone += [] if compared else [satellite]
    if alone:
        notes.append(f"{name}: ephemerides without a neighbour to compare with: {', '.join(alone)}")
    clean = table[mask]
    notes += [*describe_unexplained(clean, name), *describe_clock_scale(clean, name)]
    return clean, tuple(notes)


def _reason(row: Mapping[Any, Any]) -> str:
    """Describe the first parameter that is out of range, or return ''."""
    root, eccentricity = float(row["sqrtA"]), float(row["e"])
    orbits = [orbit for orbit in ORBITS[str(row["name"])[0]] if orbit[0] <= root <= orbit[1]]
    if not orbits:
        return f"semi-major axis is {root * root:.0f} m"
    if not orbits[0][2] <= eccentricity <= orbits[0][3]:
        low, high = orbits[0][2:]
        return f"e is {eccentricity:g}, not between {low:g} and {high:g} for its semi-major axis"
    number = float(row["prn"])
    if number != round(number) or number > LARGEST_PRN[str(row["name"])[0]]:
        return f"prn is {number:g}"
    for parameter, (low, high, unit) in RANGES.items():
        value = float(row["sow" if parameter == "toe" else parameter]) if parameter in row else 0.0
        if not (low <= value <= high or (math.isnan(value) and parameter in ("week", "health"))):
            return f"{parameter} is {value:g} {unit}, not between {low:g} and {high:g}"
    if float(row["sow"]) % TOE_STEP[str(row["name"])[0]]:
        return f"toe is {row['sow']} s, not a multiple of {TOE_STEP[str(row['name'])[0]]:.0f} s"
    if abs(float(row["toc"]) - float(row["toe"])) > _CLOCK_AGE:
        return f"toc is {float(row['toc']) - float(row['toe']):.0f} s from toe"
    return ""


def _label(table: pd.DataFrame, i: int) -> str:
    row = table.iloc[i]
    line = f" (line {row['line']:.0f})" if "line" in table else ""
    return f"an ephemeris of {row['name']} at t = {row['toe']:.0f} s{line}"


def _compare(
    table: pd.DataFrame, rows: NDArray[np.intp], name: str
) -> tuple[list[int], list[str], bool]:
    """Compare the ephemerides of a satellite with up to two neighbours on each side.

    Returns rows to ignore, notes, and whether all rows have a neighbour.
    """
    toe = table["toe"].to_numpy()[rows]
    pairs = [
        (i, j)
        for i in range(len(rows))
        for j in range(i + 1, min(i + 3, len(rows)))
        if toe[j] - toe[i] <= _LONGEST
    ]
    distances = _distances(table.iloc[rows], pairs)
    agreeing, contradicted = np.zeros(len(rows), int), np.zeros(len(rows), int)
    for (i, j), (distance, _) in zip(pairs, distances, strict=True):
        agreeing[[i, j]] += distance <= 1.0
        contradicted[[i, j]] += distance > 1.0
    unconfirmed = (contradicted > 0) & (agreeing == 0)
    notes, reason = [], {}
    for (i, j), (distance, text) in zip(pairs, distances, strict=True):
        if distance <= 1.0:
            continue
        reason[i], reason[j] = text, text
        if not (unconfirmed[i] or unconfirmed[j]) and j == i + 1:
            notes.append(f"{name}: {_label(table, rows[j])} changes the orbit or clock: {text}")
    dropped = np.flatnonzero(unconfirmed)
    notes += [
        f"{name}: {_label(table, rows[i])} is ignored because its neighbours contradict it: {reason[int(i)]}"
        for i in dropped
    ]
    return [int(rows[i]) for i in dropped], notes, bool((agreeing + contradicted > 0).all())


def _distances(table: pd.DataFrame, pairs: Sequence[tuple[int, int]]) -> list[tuple[float, str]]:
    """Compute the largest difference of each pair, relative to its tolerance, and describe it.

    Orbits and clocks are compared at both times of ephemeris and half way between. The tolerance
    grows with the time beyond two hours, since an ephemeris is fitted to four hours.
    """
    if not pairs:
        return []
    columns = [*dict.fromkeys([*CLOCK, *ORBIT, "tgd", "sow", "gm"])]
    values = {c: torch.from_numpy(table[c].to_numpy(float, copy=True)) for c in columns}
    first, second = (torch.tensor(side) for side in zip(*pairs, strict=True))
    times = torch.stack(
        [(1 - f) * values["toe"][first] + f * values["toe"][second] for f in (0.0, 0.5, 1.0)]
    )
    positions, clocks = [], []
    for side in (first, second):
        eph = {c: v[side] for c, v in values.items()}
        eph["tk"] = times - eph["toe"]
        positions.append(broadcast_elements(eph).earth_fixed()[0])
        age = times - eph["toc"]
        clocks.append(eph["af0"] + (eph["af1"] + eph["af2"] * age) * age)
    span = values["toe"][second] - values["toe"][first]
    slack = 1.0 + 3.0 * (span / 7200.0 - 1.0).clamp(min=0.0)
    far = (positions[0] - positions[1]).norm(dim=-1).amax(0)
    off = (clocks[0] - clocks[1]).abs().amax(0)
    delay = (values["tgd"][first] - values["tgd"][second]).abs()
    worst = torch.stack(
        [
            far / (POSITION_TOLERANCE * slack),
            off / (CLOCK_TOLERANCE * slack),
            delay / DELAY_TOLERANCE,
        ]
    ).amax(0)
    return [
        (
            float(w),
            f"positions {d:.0f} m, clocks {1e9 * c:.0f} ns and group delays {1e9 * g:.1f} ns apart",
        )
        for w, d, c, g in zip(
            worst.tolist(), far.tolist(), off.tolist(), delay.tolist(), strict=True
        )
    ]


# --------------------------------------------------------------------------------------------------
# Agreement of the clock offsets of broadcast ephemerides with their drifts.
#
# Clock offsets that are in another unit in all records leave neighbours within the tolerance. The
# offsets of all satellites together then do not change as the drifts state.

CLOCK_SCALES = (0.8, 1.25)  # least and largest ratio of changes of offset and drift [ours]
CHANGE_NOISE = 2e-9  # s; a day of 372 changes of GPS clocks leaves 1.1 ns [ours]
_SIGNIFICANT = 5.0  # standard deviations
_LONGEST_CLOCK = 14400.0  # s between compared ephemerides


def describe_clock_scale(table: pd.DataFrame, name: str) -> tuple[str, ...]:
    """Describe clock offsets that do not change as their drifts state.

    Returns one note, or none.
    """
    first, second = table.iloc[:-1], table.iloc[1:]
    span = second["toc"].to_numpy() - first["toc"].to_numpy()
    is_pair = (first["name"].to_numpy() == second["name"].to_numpy()) & (span > 0.0)
    is_pair &= span <= _LONGEST_CLOCK
    drift = 0.5 * (first["af1"].to_numpy() + second["af1"].to_numpy())
    expected = (drift * span)[is_pair]
    change = (second["af0"].to_numpy() - first["af0"].to_numpy())[is_pair]
    reach = float(np.sqrt((expected * expected).sum()))
    if not reach > 0.0:
        return ()
    scale = float((expected * change).sum()) / reach**2
    # one step of a clock must not decide
    noise = max(CHANGE_NOISE, float(np.sqrt(np.mean((change - scale * expected) ** 2))))
    if CLOCK_SCALES[0] < scale < CLOCK_SCALES[1] or abs(scale - 1.0) * reach < _SIGNIFICANT * noise:
        return ()
    return (
        f"{name}: clock offsets change {scale:.3g} times as fast as their drifts state, between "
        f"{int(is_pair.sum())} pairs of ephemerides. Check the units of af0 and af1",
    )


# --------------------------------------------------------------------------------------------------
# Agreement of broadcast orbits with the gravity of the Earth.
#
# A parameter that is in another unit in all records leaves neighbours in agreement. The orbit then
# has an acceleration that gravity does not explain.

J2 = 1.08262982e-3  # oblateness of the Earth [WGS 84]
# m/s^2; Sun and Moon: 0.3e-5 to 0.6e-5. A day of 404 GPS records leaves at most 0.97e-5 [ours]
ACCELERATION_TOLERANCE = 2e-5
_AGES = (-3600.0, -1800.0, 0.0, 1800.0, 3600.0)  # s from toe, within the interval of the fit
_STEP = 30.0  # s of the second difference; its error is below 1e-6 m/s^2


def compute_gravity(position: Tensor) -> Tensor:
    """Compute the gravitation of the oblate Earth.

    Returns gravitation, m/s^2, [..., 3]. Shapes: position [..., 3].
    """
    radius = position.norm(dim=-1, keepdim=True)
    polar = 5.0 * (position[..., 2:] / radius) ** 2
    oblateness = 1.5 * J2 * (earth.A / radius) ** 2
    terms = polar.new_tensor([1.0, 1.0, 3.0]) - polar
    return -earth.GM * position / radius**3 * (1.0 + oblateness * terms)


def compute_unexplained_acceleration(table: pd.DataFrame) -> Tensor:
    """Compute the acceleration of broadcast orbits that gravity does not explain."""
    columns = dict.fromkeys([*CLOCK, *ORBIT, "sow", "gm"])
    eph = {c: torch.from_numpy(table[c].to_numpy(float, copy=True))[:, None, None] for c in columns}
    age = torch.tensor(_AGES, dtype=torch.float64)[:, None]
    eph["tk"] = age + torch.tensor([-_STEP, 0.0, _STEP], dtype=torch.float64)
    fixed = broadcast_elements(eph).earth_fixed()[0]
    angle = earth.OMEGA * (eph["tk"] - age)
    c, s = torch.cos(angle), torch.sin(angle)
    x, y, z = fixed.unbind(-1)
    position = torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)
    before, middle, after = position.unbind(-2)
    acceleration = (before - 2.0 * middle + after) / _STEP**2
    return (acceleration - compute_gravity(middle)).norm(dim=-1).amax(-1)


def describe_unexplained(table: pd.DataFrame, name: str) -> tuple[str, ...]:
    """Describe ephemerides whose orbit contradicts gravity.

    Returns one note, or none.
    """
    acceleration = compute_unexplained_acceleration(table).numpy()
    count = int((~(acceleration <= ACCELERATION_TOLERANCE)).sum())
    if not count:
        return ()
    worst = int(acceleration.argmax())
    return (
        f"{name}: {count} of {len(table)} ephemerides contradict gravity by more than "
        f"{ACCELERATION_TOLERANCE:g} m/s^2, at most {acceleration[worst]:.2g} m/s^2 for "
        f"{table['name'].iloc[worst]}. Check the units of all columns",
    )
