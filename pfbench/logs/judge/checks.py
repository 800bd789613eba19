"""Checks of a trajectory against the reference: clock, axes, place and units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pfbench.logs.judge.reference_track import ReferenceTrack
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    COLUMN_GROUPS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
)
from pfbench.logs.judge.unit_checks import find_angle_factor
from pfbench.stats.error_measures import Array

# --------------------------------------------------------------------------------------------------
# Checks of the clock of a trajectory: overlap with the reference, and the offset that the motion shows.

CLOCK_LIMIT = 0.5  # s, offset above which clocks are refused
_TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds", 1 / 60: "minutes"}
_REFERENCE_UNITS = {1 / factor: unit for factor, unit in _TIME_UNITS.items() if factor > 1}
_EXPLAINED = 0.2  # share of the differences that remain at the offset of a wrong clock
_CLEAR = 0.05  # share below which the clock alone explains them
_SAMPLE, _COARSE_SAMPLE = 1500, 300  # epochs of the search for the clock
_LEAST_ROWS = 20  # rows within the reference that show a motion
_NEAR_S = 25.0  # s, half of the first search
_STEP_S, _LARGEST_GRID = 0.25, 4000
_FAR = 0.05  # share of the extent of the reference above which the search is widened
_SHOWN, _LARGE_SHOWN = 0.9, 0.4  # share that remains at an offset that is shown; above 0.5 s
_OFFSET_WEIGHT = 0.02  # weight of the median difference among shifts at which the motion agrees
_WHOLE = 0.05  # s: time scales differ by whole seconds


class _Offset(NamedTuple):
    shift: float  # s
    spread: float  # median difference of the positions at this shift, m


class _Motion:
    """Positions of a trajectory that are moved in time against the reference."""

    def __init__(self, table: TrajectoryTable, reference: ReferenceTrack, rows: np.ndarray) -> None:
        rows = rows[:: max(1, len(rows) // _SAMPLE)]
        self.time, self.position = table.time[rows], reference.locate(table)[rows]
        self.reference, self.clock = reference, reference.table.time
        self.extent = _median_distance(reference.position)

    def spread(self, shift: float, every: int = 1, offset_weight: float = 0.0) -> float:
        """Return the median distance from the reference after removal of the median difference, m.

        A motion with a period agrees at several shifts. The weight of the median difference
        selects among them.
        """
        time = self.time[::every] + shift
        inside = (time >= self.clock[0]) & (time <= self.clock[-1])
        if inside.sum() < max(_LEAST_ROWS, len(time) // 2):
            return np.inf
        truth = self.reference.interpolate_position(time[inside])
        difference = self.position[::every][inside] - truth
        move = float(np.linalg.norm(np.median(difference, axis=0))) if offset_weight else 0.0
        return _median_distance(difference) + offset_weight * move

    def search(self, first: float, last: float) -> _Offset:
        """Return the best shift from first to last, s, to 1 ms."""
        step = max(_STEP_S, (last - first) / _LARGEST_GRID)
        every = max(1, len(self.time) // _COARSE_SAMPLE)
        grid = np.arange(first, last + step / 2, step)
        shift = float(grid[np.argmin([self.spread(s, every, _OFFSET_WEIGHT) for s in grid])])
        for half, finer in ((2 * step, step / 5), (0.5, 0.02), (0.03, 0.001)):
            grid = shift + np.arange(-half, half + finer / 2, finer)
            shift = float(grid[np.argmin([self.spread(s) for s in grid])])
        return _Offset(shift, self.spread(shift))

    def search_all(self) -> _Offset:
        """Return the best shift of those that leave half of the trajectory in the reference."""
        middle = float(np.median(self.time))
        return self.search(self.clock[0] - middle, self.clock[-1] - middle)


def check_common_time(
    table: TrajectoryTable, reference: ReferenceTrack, applied: float = 0.0
) -> None:
    """Check that a trajectory and the reference share time."""
    (first, last), clock = (table.time[0], table.time[-1]), reference.table.time
    factor = _find_unit(table, reference)
    if last > clock[0] and first < clock[-1] and not factor:
        return
    if factor:
        remedy = f"The column is in {_TIME_UNITS.get(factor)}: set NAME.scale=t:{1 / factor:.6g}."
        if factor in _REFERENCE_UNITS:
            remedy = f"That of the reference is in {_REFERENCE_UNITS[factor]}: set reference.scale=t:{factor:.6g}."
    else:
        motion = _Motion(table, reference, np.arange(len(table.time)))
        search_result = motion.search_all()
        shift, remedy = clock[0] - first, "If both start together, set"
        if search_result.spread < _EXPLAINED * motion.extent:
            shift, remedy = _round_whole(search_result.shift), "The motion agrees at"
        remedy = f"{remedy} NAME.shift={applied + shift:.10g}."
    raise ValueError(
        f"{table.file}: column t must overlap {reference.file} ({clock[0]:.10g} to {clock[-1]:.10g} "
        f"s), got {first:.10g} to {last:.10g} s. {remedy}"
    )


def _find_unit(table: TrajectoryTable, reference: ReferenceTrack) -> float:
    """Return the unit of a time of 0.5 to 2 times the length of the reference, 0 for seconds.

    A trajectory that shares 20 rows with the reference needs a motion that agrees in the unit alone.
    """
    clock = reference.table.time
    length, span = table.time[-1] - table.time[0], clock[-1] - clock[0]
    units = (*_TIME_UNITS, *_REFERENCE_UNITS)
    factor = next((f for f in units if 0.5 < length / f / span < 2), 0.0)
    inside = int(((table.time >= clock[0]) & (table.time <= clock[-1])).sum())
    if factor and (factor < 1 or inside >= _LEAST_ROWS):
        scaled = replace(table, time=table.time / factor)
        motion = _Motion(scaled, reference, np.arange(len(table.time)))
        best = min(motion.spread(0.0), motion.search_all().spread)
        is_seconds = motion.extent == 0 or best > _EXPLAINED * motion.extent
        factor = 0.0 if is_seconds else factor
    return factor


def check_clock(table: TrajectoryTable, reference: ReferenceTrack, applied: float = 0.0) -> float:
    """Estimate the offset of the clock from the motion, and refuse a large one.

    The offset minimises the median distance of the positions from the reference, after removal of
    the median difference. Positions that are far from the reference widen the search from 25 s to all
    offsets that leave half of the trajectory within the reference.

    Returns time to add to the clock of the trajectory, s; NaN if the motion does not show it.
    """
    clock = reference.table.time
    rows = np.flatnonzero((table.time >= clock[0]) & (table.time <= clock[-1]))
    if len(rows) < _LEAST_ROWS:
        return np.nan
    motion = _Motion(table, reference, rows)
    at_zero, best = motion.spread(0.0), motion.search(-_NEAR_S, _NEAR_S)
    if best.spread >= _EXPLAINED * at_zero and at_zero > _FAR * motion.extent:
        full_motion = _Motion(table, reference, np.arange(len(table.time)))
        best = min(best, full_motion.search_all(), key=lambda offset: offset.spread)
    shift = best.shift
    if abs(shift) > CLOCK_LIMIT and best.spread < _EXPLAINED * at_zero:
        if best.spread > _CLEAR * at_zero:  # other axes may explain more
            check_axes(table, reference)
        raise ValueError(
            f"{table.file}: column t must have the clock of {reference.file}, got an offset of "
            f"{shift:.2f} s: with it the median difference falls from {at_zero:.3g} to {best.spread:.3g} m. "
            f"Set NAME.shift={applied + _round_whole(shift):.10g}. GPS time is 18 s ahead of UTC since 2017."
        )
    least = _SHOWN if abs(shift) <= CLOCK_LIMIT else _LARGE_SHOWN
    is_shown = (best.spread < least * at_zero and abs(shift) <= _NEAR_S) or abs(shift) < 0.02
    return round(shift, 3) + 0.0 if is_shown else np.nan


def _median_distance(points: Array) -> float:
    """Return the median distance of points [K, 3] from their median."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _round_whole(shift: float) -> float:
    """Return the whole number of seconds near a shift, else the shift to 10 ms."""
    return float(round(shift)) if abs(shift - round(shift)) < _WHOLE else round(shift, 2)


# --------------------------------------------------------------------------------------------------
# Checks of the axes of a trajectory: columns of opposite sign, and columns under the name of another one.

_GROUPS = ((*LOCAL, *VELOCITY_COLUMNS), ("roll", "pitch"), ("yaw",))
_CLOSE = 0.045  # relative difference of a slope from 1
_SIGN = 0.25  # the same for the opposite sign, which noise cannot cause
_AGREES, _HALF = 0.9, 0.5  # shares of explained variance
_SAME_ZERO = 0.1  # rad
_WORSE = 5.0  # ratio of the variances that the own and the other column leave

_TUM_REMEDY = "Check NAME.frame, enu or ned, and the order t x y z qx qy qz qw."


class _Fault(NamedTuple):
    column: str
    problem: str
    remedy: str


def check_axes(table: TrajectoryTable, reference: ReferenceTrack) -> None:
    """Compare each column with all columns of the reference, and refuse other signs and names.

    A column has the opposite sign if its slope on that of the reference is -1 and explains half of its
    variance. It has another name if another column explains 90 % with slope 1 or -1, and its own one
    leaves 5 times the variance.
    """
    rows = reference.is_bridged(table.time)
    if rows.sum() < 20:
        return
    time, clock = table.time[rows], reference.table.time
    for group in _GROUPS:
        shared = [n for n in group if n in table.values and n in reference.table.values]
        theirs = {n: np.interp(time, clock, reference.table.values[n]) for n in shared}
        mine = {n: table.values[n][rows] for n in shared}
        fault = _find_first_fault(mine, theirs)
        if fault:
            remedy = _frame_remedy(table.frame, mine, theirs) if table.frame else fault.remedy
            raise ValueError(
                f"{table.file}: column {fault.column} must be that of axes North, East, Down, got "
                f"{fault.problem} in {reference.file}. {remedy}"
            )


def _find_first_fault(mine: Mapping[str, Array], theirs: Mapping[str, Array]) -> _Fault | None:
    """Return what is wrong with the first of several columns that is wrong, or None."""
    faults = (_find_fault(column, values, theirs) for column, values in mine.items())
    return next((fault for fault in faults if fault), None)


def _frame_remedy(frame: str, mine: Mapping[str, Array], theirs: Mapping[str, Array]) -> str:
    """Return the other frame of a TUM file if positions agree in it."""
    if set(LOCAL) <= set(mine):
        north, east, down = (mine[name] for name in LOCAL)
        turned = dict(zip(LOCAL, (east, north, -down), strict=True))
        if not _find_first_fault(turned, theirs):
            return f"Set NAME.frame={'ned' if frame == 'enu' else 'enu'}."
    return _TUM_REMEDY


def _find_fault(column: str, mine: Array, theirs: Mapping[str, Array]) -> _Fault | None:
    """Return what is wrong with a column, or None."""
    own_slope, own_share = regress_column(mine, theirs[column], column == "yaw")
    for candidate in (n for n in theirs if n != column):
        slope, share = regress_column(mine, theirs[candidate])
        is_better = share >= _AGREES and 1 - own_share > _WORSE * (1 - share)
        if is_better and abs(abs(slope) - 1) < _CLOSE:
            problem = f"values {slope:.3f} times those of {candidate}"
            sign = "" if slope > 0 else ", and multiply the column by -1"
            remedy = f"Give it the name or the place of {candidate}{sign}."
            return _Fault(column, problem, remedy)
    if own_share >= _HALF and abs(own_slope + 1) < _SIGN:
        problem = f"values {own_slope:.3f} times those of {column}"
        return _Fault(column, problem, _opposite_remedy(column, mine, theirs[column]))
    return None


def _opposite_remedy(column: str, mine: Array, theirs: Array) -> str:
    """Return the remedy of an opposite sign; yaw from East also has another zero."""
    total = float(np.angle(np.exp(1j * (mine + theirs)).mean())) if column == "yaw" else 0.0
    if abs(total) < _SAME_ZERO:
        return "Multiply the column by -1."
    return (
        f"Subtract the column from {total:.4g} rad: it counts from another axis, the opposite way."
    )


# --------------------------------------------------------------------------------------------------
# Checks of a trajectory against the reference: place and units of each column.

_FACTORS = {  # ratio of two units: the unit of the column, or of that of the reference
    "m": {3.28084: "feet", 1e3: "mm, or reference in km", 1e-3: "km", 0.3048: "reference in feet"},
    "m/s": {3.28084: "feet/s", 3.6: "km/h", 1.943844: "knots", 0.277778: "reference in km/h"},
    "rad": {57.29578: "degrees", 0.01745329: "rad converted twice, or reference in degrees"},
    "deg": {0.01745329: "radians", 57.29578: "reference in radians"},
}  # fmt: skip
_Column = tuple[str, str, Array, Array]  # name, unit, values of the program and of the reference
_CLOSE_REFERENCE = 0.045  # relative difference from a factor
_USUAL = 0.97  # share of the increments of an angle that are compared
_NEAR = 1000.0  # m, smallest distance of a trajectory of the same place
INTERPOLATED = 0.5  # share of an RMSE that interpolation may cause
_SMALL = 1e-3  # m, error of interpolation that is of no account


def check_distance(table: TrajectoryTable, reference: ReferenceTrack) -> None:
    """Check that a trajectory comes near the reference at any epoch, even if it diverges later."""
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

    Shapes: time [T].
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

    Returns the trajectory, with a note if yaw may be in degrees.
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
            if abs(ratio / factor - 1) < _CLOSE_REFERENCE:
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

    Returns slope, and share of the variance that it explains; 1 and 0 for a constant column.
    Shapes: mine [T], theirs [T].
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
