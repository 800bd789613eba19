"""Findings on the units of one trajectory by itself: time, positions, velocities and yaw must fit together.

A unit that all files have in common is not shown by a comparison with the reference. Velocities show it against
the change of positions, and yaw against the direction of motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from pfbench.logs.doctor.finding import REFUSE, TELL, Finding
from pfbench.logs.judge.trajectory_table import (
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
    to_north_east_down,
)
from pfbench.logs.units import DEGREE, UNIT_FACTORS
from pfbench.stats.error_measures import Array

_LATEST, _SINCE_1970 = 1e11, (1e8, 1e10)  # s: above GPS and Unix times; from 1973 to 2286
_CLOSE, _NO_UNIT = (
    0.03,
    (0.8, 1.25),
)  # relative difference from a factor; ratios that errors of a program explain
_LEAST_ROWS, _WINDOWS, _SHORTEST_STEP = 20, 10, 1e-3  # s
_EXPLAINED = 0.9  # share of the change of positions that the velocities explain
_LEAST_SPEED, _LEAST_MOVE = 1.0, 3.0  # m/s, m: the direction of motion is clear
_SLOW, _FAST, _LONG, _USUAL = 0.05, 2000.0, 100.0, (0.5, 500.0)  # m/s, m/s, m, m/s
_SCATTER, _SHARE, _STRAIGHT = 0.05, 0.1, 0.2  # circular variance; share of another one; rad
_BEYOND, _EQUATOR = 2.1 * math.pi, 0.02  # rad, above a turn; deg, where simulations start


def settle(table: TrajectoryTable, findings: Iterable[Finding]) -> TrajectoryTable:
    """Raise the first finding that refuses a trajectory, and add the others to its notes."""
    notes = []
    for finding in findings:
        if finding.level == REFUSE:
            raise ValueError(finding.text)
        notes.append(finding.text.removesuffix("."))
    return replace(table, notes=(*table.notes, *notes))


def check_consistent_units(table: TrajectoryTable) -> TrajectoryTable:
    """Check that time, positions, velocities and yaw of a trajectory have units that fit together.

    Returns the trajectory, with notes on what looks like another unit and cannot be decided.
    """
    return settle(table, _inspect_units(table))


def _inspect_units(table: TrajectoryTable) -> Iterator[Finding]:
    """Yield what the units of a trajectory contradict, and then what they leave in doubt."""
    yield from _check_largest_time(table)
    position = _horizontal(table)
    ratio = _velocity_ratio(table, position)
    yield from _check_velocities(table, ratio)
    yield from _check_yaw(table, position)
    yield from _list_doubts(table, position)
    if not _NO_UNIT[0] < ratio < _NO_UNIT[1]:
        text = f"positions change by {ratio:.4g} times what the velocities say, as in no unit"
        yield Finding("unit of velocity", TELL, ratio, 1.0, "1", text)


def find_angle_factor(mine: Array, theirs: Array) -> tuple[float, bool]:
    """Find the factor that turns an angle to another one: that of a unit, 180 / pi, or 1.

    The factor is certain if it leaves a tenth of the circular variance without it, and of that without an
    angle. It is certain for a constant angle beyond a turn too, as 63 for 1.1 rad. A constant angle within a
    turn is a doubt, since it can be wrong in rad.

    Shapes: mine [T], theirs [T].
    """
    scatter, zero = _scatter(mine - theirs)
    nothing, _ = _scatter(theirs)
    factors = (*UNIT_FACTORS["angle"].values(), *UNIT_FACTORS["rare angle"].values(), 1 / DEGREE)
    (rest, offset), factor = min((_scatter(factor * mine - theirs), factor) for factor in factors)
    if rest < _SCATTER and max(rest, 1e-4) < _SHARE * min(scatter, nothing):
        return factor, True
    rest, offset = _scatter(DEGREE * mine - theirs)
    if rest < _SCATTER and abs(offset) < min(_STRAIGHT, _SHARE * abs(zero)) and abs(zero) > _STRAIGHT:  # fmt: skip
        return DEGREE, bool(np.median(np.abs(mine)) > _BEYOND)
    return 1.0, True


def _scatter(angle: Array) -> tuple[float, float]:
    """Return circular variance and mean of angles in rad."""
    mean = np.exp(1j * angle).mean()
    return 1 - float(np.abs(mean)), float(np.angle(mean))


def _check_largest_time(table: TrajectoryTable) -> Iterator[Finding]:
    """Refuse a count of ms, us or ns since 1970."""
    largest = float(np.abs(table.time).max())
    if largest > _LATEST:
        fits = [(u, f) for u, f in UNIT_FACTORS["time"].items() if _SINCE_1970[0] < f * largest < _SINCE_1970[1]]  # fmt: skip
        texts = [f"It is in {u} since 1970: set NAME.scale=t:{f:g}" for u, f in fits]
        remedy = next(iter(texts), "Set NAME.scale=t:FACTOR, so that it is in s")
        evidence = f"{table.file}: column t must be in s, got {largest:.10g}"
        yield Finding("unit of time", REFUSE, largest, _LATEST, "s", evidence, remedy)


def _horizontal(table: TrajectoryTable) -> Array:
    """Return North and East, [T, 2], m."""
    if table.has(LOCAL):
        return table.select(LOCAL)[:, :2]
    geodetic = table.select(GEODETIC)
    return to_north_east_down(geodetic, geodetic[0])[:, :2]


def _velocity_ratio(table: TrajectoryTable, position: Array) -> float:
    """Return the change of positions over the integral of velocities; 1 if they do not agree in form."""
    count = len(table.time)
    if not table.has(VELOCITY_COLUMNS) or count < _LEAST_ROWS:
        return 1.0
    velocity = table.select(VELOCITY_COLUMNS[:2])
    steps = (velocity[1:] + velocity[:-1]) / 2 * np.diff(table.time)[:, None]
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    lag = count // _WINDOWS
    change, integral = position[lag:] - position[:-lag], path[lag:] - path[:-lag]
    common = float((change * integral).sum())
    sizes = float((change**2).sum()), float((integral**2).sum())
    if not (min(sizes) > 0 and common > 0 and common**2 > _EXPLAINED * sizes[0] * sizes[1]):
        return 1.0
    return common / sizes[1]


def _check_velocities(table: TrajectoryTable, ratio: float) -> Iterator[Finding]:
    """Refuse positions that change by a known factor more or less than velocities say."""
    if abs(ratio - 1) < _CLOSE:
        return
    remedies = []
    for unit, factors in _list_units(table):
        scaled = table.scale_columns(factors)
        is_step = float(np.median(np.diff(scaled.time))) >= _SHORTEST_STEP or "t" not in factors
        if is_step and abs(_velocity_ratio(scaled, _horizontal(scaled)) - 1) < _CLOSE:
            word = ",".join(f"{name}:{factor:.6g}" for name, factor in factors.items())
            remedies.append(f"{', '.join(factors)} in {unit}: set NAME.scale={word}")
    if remedies:
        evidence = (
            f"{table.file}: positions must change by the velocities, got {ratio:.4g} times as much"
        )
        yield Finding("unit of velocity", REFUSE, ratio, 1.0, "1", evidence, "; or ".join(remedies))


def _list_units(table: TrajectoryTable) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield units with the factors of their columns that may explain other velocities."""
    columns = {"time": ["t"]}
    if table.has(LOCAL):
        columns["length"] = list(LOCAL)
    elif (np.abs(table.select(GEODETIC[:2])) <= [math.pi / 2, math.pi]).all():
        columns["place"] = list(GEODETIC[:2])
    columns["velocity"] = [name for name in VELOCITY_COLUMNS if name in table.values]
    for dimension, names in columns.items():
        yield from ((unit, dict.fromkeys(names, f)) for unit, f in UNIT_FACTORS[dimension].items())


def _check_yaw(table: TrajectoryTable, position: Array) -> Iterator[Finding]:
    """Refuse a yaw that has the direction of motion in another unit."""
    yaw = table.values.get("yaw")
    direction, is_moving = _course(table, position)
    if yaw is None or is_moving.sum() < _LEAST_ROWS:
        return
    factor, is_certain = find_angle_factor(yaw[is_moving], direction[is_moving])
    if factor != 1 and is_certain:
        units = {**UNIT_FACTORS["angle"], **UNIT_FACTORS["rare angle"]}
        unit = next((u for u, f in units.items() if f == factor), "rad, converted twice")
        if table.angle_unit == "deg":  # the reader has converted it
            unit = "rad" if factor > 1 else "degrees, in 1/57.3 of its unit"
        level = float(np.median(np.abs(yaw[is_moving])))
        evidence = (
            f"{table.file}: column yaw must be in {table.angle_unit}, got a median size of {level:.4g} rad, which "
            f"agrees with the direction of motion in {unit}"
        )
        remedy = f"Set NAME.scale=yaw:{factor:.6g}, and the same for roll and pitch if they have this unit"
        yield Finding("unit of attitude", REFUSE, 1 / factor, 1.0, "1", evidence, remedy)


def _course(table: TrajectoryTable, position: Array) -> tuple[Array, np.ndarray]:
    """Return the direction of motion from North, [T], rad, and where it is clear."""
    if table.has(VELOCITY_COLUMNS):
        north, east = table.select(VELOCITY_COLUMNS[:2]).T
        speed = np.hypot(north, east)
        return np.arctan2(east, north), speed > max(_LEAST_SPEED, 0.3 * float(speed.max()))
    count, lag = len(position), 1
    rows = np.arange(count)
    while True:
        move = position[np.minimum(rows + lag, count - 1)] - position[np.maximum(rows - lag, 0)]
        size = np.linalg.norm(move, axis=1)
        if np.median(size) > _LEAST_MOVE or 2 * lag > count // _WINDOWS:
            return np.arctan2(move[:, 1], move[:, 0]), size > _LEAST_MOVE
        lag *= 2


def _list_doubts(table: TrajectoryTable, position: Array) -> Iterator[Finding]:
    """Yield speeds and places that another unit would explain."""
    lag = max(1, len(position) // _WINDOWS)
    move = np.linalg.norm(position[lag:] - position[:-lag], axis=1)
    speed = float((move / (table.time[lag:] - table.time[:-lag])).max())
    if table.has(GEODETIC) and not table.has(LOCAL):
        lat, lon = np.abs(table.select(GEODETIC[:2])).max(0)
        if _EQUATOR < lat <= math.pi / 2 and _EQUATOR < lon <= math.pi:
            factor = UNIT_FACTORS["place"]["radians"]
            text = (
                "latitude and longitude may be in rad, since they are within a quarter and half a turn. "
                f"NAME.scale=lat_deg:{factor:.6g},lon_deg:{factor:.6g} converts them"
            )
            yield Finding("unit of place", TELL, lat, math.pi / 2, "deg", text)
    text = f"the largest speed is {speed:.4g} m/s. Check the units of t and of the positions"
    if speed < _SLOW:
        fits = [
            (u, f) for u, f in UNIT_FACTORS["time"].items() if _USUAL[0] < speed / f < _USUAL[1]
        ]
        hints = [f". If t is in {u}, set NAME.scale=t:{f:g}" for u, f in fits]
        text = f"the largest speed is {speed:.3g} m/s{''.join(hints) or '. Check the unit of t'}"
    if speed > _FAST or (speed < _SLOW and np.ptp(position, axis=0).max() > _LONG):
        yield Finding("unit of time", TELL, speed, _FAST, "m/s", text)
