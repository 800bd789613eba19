"""Checks of a trajectory against the reference: overlap, clock and units of each column."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pfbench.judge.readers.trajectory_table import (
    ATTITUDE_COLUMNS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
)
from pfbench.judge.reference_track import ReferenceTrack
from pfbench.results.error_measures import Array

CLOCK_LIMIT = 0.5  # s, offset above which clocks are refused
_FACTORS = {  # ratio of two units: the unit of the column, for positions, velocities and angles
    "m": {3.28084: "feet", 1e3: "mm", 1e-3: "km", 0.3048: "m while the reference is in feet"},
    "m/s": {3.28084: "feet/s", 3.6: "km/h", 1.943844: "knots", 0.277778: "m/s and the reference in km/h"},
    "rad": {57.29578: "degrees", 0.01745329: "rad while the reference is in degrees"},
    "deg": {0.01745329: "radians", 57.29578: "degrees while the reference is in radians"},
}  # fmt: skip
_CLOSE = 0.045  # relative difference from a factor
_USUAL = 0.97  # share of the increments of an angle that are compared
_TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
_EXPLAINED = 0.2  # share of the differences that remain at the offset of a wrong clock
_NEAR = 1000.0  # m, smallest distance of a trajectory of the same place
_SAMPLE = 1500  # epochs of the search for the clock


def check_common_time(table: TrajectoryTable, reference: ReferenceTrack, name: str) -> None:
    """Check that a trajectory and the reference share time.

    Args:
        table: Trajectory.
        reference: Reference.
        name: Name of the program, for the remedy.

    Raises:
        ValueError: If they do not overlap. The message proposes a unit or a shift.
    """
    (first, last), clock = (table.time[0], table.time[-1]), reference.table.time
    if last > clock[0] and first < clock[-1]:
        return
    length, span = last - first, clock[-1] - clock[0]
    unit = next((u for f, u in _TIME_UNITS.items() if 0.5 < length / f / span < 2), "")
    remedy = (
        f"The column is in {unit}: convert it to s."
        if unit
        else f"If both start together, set {name}.shift={clock[0] - first:.10g}."
    )
    raise ValueError(
        f"{table.file}: column t must overlap {reference.file} ({clock[0]:.10g} to {clock[-1]:.10g} "
        f"s), got {first:.10g} to {last:.10g} s. {remedy}"
    )


def check_distance(table: TrajectoryTable, reference: ReferenceTrack) -> None:
    """Check that a trajectory comes near the reference at any epoch, even if it diverges later.

    Args:
        table: Trajectory.
        reference: Reference.

    Raises:
        ValueError: If the smallest distance exceeds 1 km and the extent of the reference.
    """
    rows = (table.time >= reference.table.time[0]) & (table.time <= reference.table.time[-1])
    difference = reference.locate(table)[rows] - reference.interpolate_position(table.time[rows])
    least = float(np.linalg.norm(difference, axis=1).min())
    limit = max(_NEAR, float(np.ptp(reference.position, axis=0).max()))
    if least > limit:
        raise ValueError(
            f"{table.file}: positions must come within {limit:.4g} m of {reference.file}, got a "
            f"distance of {least:.4g} m at least. Check order, unit and origin of the columns."
        )


def check_clock(table: TrajectoryTable, reference: ReferenceTrack, name: str) -> float:
    """Estimate the offset of the clock from the motion, and refuse a large one.

    The offset minimises the median distance of the positions from the reference, after removal of
    the median difference.

    Args:
        table: Trajectory.
        reference: Reference.
        name: Name of the program, for the remedy.

    Returns:
        Time to add to the clock of the trajectory, s; NaN if the motion does not show it.

    Raises:
        ValueError: If the offset exceeds 0.5 s and leaves less than 20 % of the
            differences.
    """
    clock = reference.table.time
    used = (table.time >= clock[0]) & (table.time <= clock[-1])
    rows = np.flatnonzero(used)[:: max(1, int(used.sum()) // _SAMPLE)]
    time, position = table.time[rows], reference.locate(table)[rows]
    if len(time) < 20:
        return np.nan

    def spread(shift: float) -> float:
        inside = (time + shift >= clock[0]) & (time + shift <= clock[-1])
        if inside.sum() < max(20, len(time) // 2):
            return np.inf
        e = position[inside] - reference.interpolate_position(time[inside] + shift)
        return float(np.median(np.linalg.norm(e - np.median(e, axis=0), axis=1)))

    shift = 0.0
    for half, step in ((25.0, 0.25), (0.5, 0.02), (0.03, 0.001)):
        grid = shift + np.arange(-half, half + step / 2, step)
        shift = float(grid[np.argmin([spread(s) for s in grid])])
    at_zero, best = spread(0.0), spread(shift)
    if abs(shift) > CLOCK_LIMIT and best < _EXPLAINED * at_zero:
        raise ValueError(
            f"{table.file}: column t must have the clock of {reference.file}, got an offset of "
            f"{shift:.2f} s: with it the median difference falls from {at_zero:.3g} to {best:.3g} m. "
            f"Set {name}.shift={shift:.2f}. GPS time is 18 s ahead of UTC since 2017."
        )
    return shift if best < 0.9 * at_zero or abs(shift) < 0.02 else np.nan


def check_units(table: TrajectoryTable, reference: ReferenceTrack) -> None:
    """Compare each column with that of the reference, and refuse a ratio of two units.

    Args:
        table: Trajectory.
        reference: Reference.

    Raises:
        ValueError: If a column is a constant times that of the reference, as feet for metres.
    """
    rows = reference.is_bridged(table.time)
    if rows.sum() < 10:
        return
    time = table.time[rows]
    for column, unit, mine, theirs in _common_columns(table.keep_rows(rows), reference, time):
        ratio = _ratio(mine, theirs, unit, column)
        for factor, wrong in _FACTORS[unit].items():
            if abs(ratio / factor - 1) < _CLOSE:
                raise ValueError(
                    f"{table.file}: column {column} must be in {unit}, got values {ratio:.4g} times "
                    f"those of {reference.file}: {wrong}. Multiply the column by {1 / factor:.6g}."
                )


def _common_columns(
    table: TrajectoryTable, reference: ReferenceTrack, time: Array
) -> Iterator[tuple[str, str, Array, Array]]:
    """Yield column, unit, values of the program and of the reference at the same times."""
    units = {
        **dict.fromkeys((*LOCAL, "h_m"), "m"),
        **dict.fromkeys(GEODETIC[:2], "deg"),
        **dict.fromkeys(VELOCITY_COLUMNS, "m/s"),
        **dict.fromkeys(ATTITUDE_COLUMNS, "rad"),
    }
    for column, unit in units.items():
        if column not in table.values:
            continue
        if column in reference.table.values:
            theirs = np.interp(time, reference.table.time, reference.table.values[column])
            yield column, unit, table.values[column], theirs
        elif column in GEODETIC and reference.origin:
            level = np.full(len(time), reference.origin[GEODETIC.index(column)])
            yield column, unit, table.values[column], level


def _ratio(mine: Array, theirs: Array, unit: str, column: str) -> float:
    """Return the ratio of two columns: of medians, or the slope if they correlate; else 1.

    Angles are compared by their increments without the largest, which pass half a turn.
    """
    if unit == "deg" or column == "h_m":
        middle = float(np.median(theirs))
        return float(np.median(mine)) / middle if abs(middle) > 0.5 else 1.0
    if unit == "rad":
        mine, theirs = np.diff(mine), np.diff(theirs)
        used = np.abs(mine) <= np.quantile(np.abs(mine), _USUAL)
        used &= np.abs(theirs) <= np.quantile(np.abs(theirs), _USUAL)
        mine, theirs = mine[used], theirs[used]
    x, y = theirs - theirs.mean(), mine - mine.mean()
    if not (x.any() and y.any()) or (x @ y) ** 2 < 0.9 * (x @ x) * (y @ y):
        return 1.0
    return float(x @ y / (x @ x))
