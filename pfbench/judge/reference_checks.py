"""Checks of a trajectory against the reference: place and units of each column."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from pfbench.judge.readers.trajectory_table import (
    ATTITUDE_COLUMNS,
    COLUMN_GROUPS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
)
from pfbench.judge.reference_track import ReferenceTrack
from pfbench.judge.unit_checks import find_angle_factor
from pfbench.results.error_measures import Array

_FACTORS = {  # ratio of two units: the unit of the column, or of that of the reference
    "m": {3.28084: "feet", 1e3: "mm, or reference in km", 1e-3: "km", 0.3048: "reference in feet"},
    "m/s": {3.28084: "feet/s", 3.6: "km/h", 1.943844: "knots", 0.277778: "reference in km/h"},
    "rad": {57.29578: "degrees", 0.01745329: "rad converted twice, or reference in degrees"},
    "deg": {0.01745329: "radians", 57.29578: "reference in radians"},
}  # fmt: skip
_Column = tuple[str, str, Array, Array]  # name, unit, values of the program and of the reference
_CLOSE = 0.045  # relative difference from a factor
_USUAL = 0.97  # share of the increments of an angle that are compared
_NEAR = 1000.0  # m, smallest distance of a trajectory of the same place
INTERPOLATED = 0.5  # share of an RMSE that interpolation may cause
_SMALL = 1e-3  # m, error of interpolation that is of no account


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


def check_interpolation(
    reference: ReferenceTrack, time: Array, errors: Mapping[str, float]
) -> None:
    """Check that steps of the reference are short enough to tell errors from interpolation.

    Args:
        reference: Reference.
        time: Scored epochs, [T], s.
        errors: Position RMSE by program, m; NaN for a lost one.

    Raises:
        ValueError: If interpolation causes half of the smallest RMSE.
    """
    size = float(np.sqrt(np.mean(reference.interpolation_error(time) ** 2)))
    name, least = min(errors.items(), key=lambda item: item[1] if item[1] >= 0 else np.inf)
    if size > max(INTERPOLATED * least, _SMALL):
        step = float(np.median(np.diff(reference.table.time)))
        about = (
            f"about {size:.3g} m"
            if np.isfinite(size)
            else f"unknown with {len(reference.table.time)} rows"
        )
        raise ValueError(
            f"{reference.file}: column t must have steps that can be interpolated, got {step:.4g} s: the "
            f"error between the rows is {about}, and the position RMSE of {name} is {least:.3g} m. "
            f"Use shorter steps, add vn, ve, vd, or set every={step:.4g} if the epochs agree with the rows."
        )


def check_units(table: TrajectoryTable, reference: ReferenceTrack) -> TrajectoryTable:
    """Compare each column with that of the reference, and refuse a ratio of two units.

    Args:
        table: Trajectory.
        reference: Reference.

    Returns:
        The trajectory, with a note if yaw may be in degrees.

    Raises:
        ValueError: If a column is a constant times that of the reference, as feet for metres.
    """
    rows = reference.is_bridged(table.time)
    if rows.sum() < 10:
        return table
    columns = list(_common_columns(table.keep_rows(rows), reference, table.time[rows]))
    for column, unit, mine, theirs in columns:
        if column == "yaw" and not find_angle_factor(mine, theirs)[1]:
            note = f"yaw agrees with {reference.file} if it is in degrees: NAME.scale=yaw:0.0174533"
            return replace(table, notes=(*table.notes, note))
        ratio = _ratio(mine, theirs, unit, column)
        for factor, wrong in _FACTORS[unit].items():
            if abs(ratio / factor - 1) < _CLOSE:
                if unit == "rad" and table.angle_unit == "deg":  # the reader has converted them
                    unit, wrong = "deg", "radians, or reference in degrees"
                raise ValueError(
                    f"{table.file}: column {column} must be in {unit}, got values {ratio:.4g} times "
                    f"those of {reference.file}: {wrong}. {_unit_remedy(column, columns, factor, wrong)}"
                )
    return table


def _unit_remedy(column: str, columns: list[_Column], factor: float, wrong: str) -> str:
    """Return the remedy of all columns of a group that come nearer to the reference with a factor."""
    group = next(group for group in COLUMN_GROUPS if column in group)
    names = [
        name
        for name, _, mine, theirs in columns
        if name in group
        and (name == column or _distance(mine / factor, theirs) < _distance(mine, theirs))
    ]
    mine = ",".join(f"{name}:{1 / factor:.6g}" for name in names)
    theirs = ",".join(f"{name}:{factor:.6g}" for name in names)
    remedies = [
        f"Multiply the column by {1 / factor:.6g}: set NAME.scale={mine}",
        f"multiply that of the reference by {factor:.6g}: set reference.scale={theirs}",
    ]
    if wrong.startswith("reference"):
        return f"{remedies[1].replace('m', 'M', 1)}."
    return f"{', or '.join(remedies if 'reference' in wrong else remedies[:1])}."


def _distance(mine: Array, theirs: Array) -> float:
    """Return the sum of squares of the differences of two columns."""
    return float(((mine - theirs) ** 2).sum())


def _common_columns(
    table: TrajectoryTable, reference: ReferenceTrack, time: Array
) -> Iterator[_Column]:
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
    """Return the ratio of two columns: of medians, of units of yaw, or the slope if they correlate; else 1."""
    if unit == "deg" or column == "h_m":
        middle = float(np.median(theirs))
        return float(np.median(mine)) / middle if abs(middle) > 0.5 else 1.0
    if column == "yaw":
        return 1 / find_angle_factor(mine, theirs)[0]
    slope, share = regress_column(mine, theirs)
    return slope if share >= 0.9 else 1.0


def regress_column(mine: Array, theirs: Array, is_angle: bool = False) -> tuple[float, float]:
    """Regress a column on one of the reference.

    Args:
        mine: Column of the program, [T].
        theirs: Column of the reference at the same times, [T].
        is_angle: Compare the increments without the largest, which pass half a turn.

    Returns:
        Slope, and share of the variance that it explains; 1 and 0 for a constant column.
    """
    if is_angle:
        mine, theirs = np.diff(mine), np.diff(theirs)
        used = np.abs(mine) <= np.quantile(np.abs(mine), _USUAL)
        used &= np.abs(theirs) <= np.quantile(np.abs(theirs), _USUAL)
        mine, theirs = mine[used], theirs[used]
    x, y = theirs - theirs.mean(), mine - mine.mean()
    if not (x.any() and y.any()):
        return 1.0, 0.0
    return float(x @ y / (x @ x)), float((x @ y) ** 2 / ((x @ x) * (y @ y)))
