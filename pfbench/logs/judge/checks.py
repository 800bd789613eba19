"""Findings on a trajectory, by itself and against the reference: clock, units, place and axes.

They have the form of those of an inspection. A refusal is raised, and what cannot be decided becomes a note. Nothing is
looked for in axes before units, or in units before the clock can be compared, since one fault looks like the next.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pfbench.logs.doctor.axis_orders import BODY_ORDERS, ENU_TO_NED, FLU_TO_FRD, name_axes
from pfbench.logs.doctor.finding import REFUSE, TELL, Finding
from pfbench.logs.doctor.fix_checks import check_frame, check_shift, compare_at
from pfbench.logs.doctor.motion_search import MotionSearch, extent_of
from pfbench.logs.doctor.raw_log import (  # fmt: skip
    NO_IMU,
    RawFixes,
    RawLog,
    RawReference,
    dcm_of,
)
from pfbench.logs.judge.reference_track import ReferenceTrack
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    COLUMN_GROUPS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
)
from pfbench.logs.judge.unit_checks import check_consistent_units, find_angle_factor, settle
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES
from pfbench.logs.units import UNIT_FACTORS
from pfbench.stats.error_measures import Array

CLOCK_LIMIT = 0.5  # s, offset above which clocks are refused
INTERPOLATED, _SMALL = 0.5, 1e-3  # share of an RMSE, and m, that interpolation may cause
_EXPLAINED, _CLEAR = (
    0.2,
    0.05,
)  # shares of the differences that the offset of a wrong clock leaves: with other causes, and alone
_SHOWN, _LARGE_SHOWN = 0.9, 0.4  # the same at an offset that is shown; above 0.5 s
_LEAST_ROWS, _FEWEST = 20, 10  # rows within the reference that show a motion, and a unit
_NEAR_S, _FAR = (
    25.0,
    0.05,
)  # s, half of the first search; share of the extent of the reference above which it is widened
_PLACE = 1000.0  # m, smallest distance of a trajectory of the same place
_CLOSE, _SIGN = 0.045, 0.25  # relative differences of a slope from a factor, and from -1
_AGREES, _HALF, _WORSE = (
    0.9,
    0.5,
    5.0,
)  # shares of explained variance; ratio of the variances that two columns leave
_TURN = 0.1  # rad, of body axes
_USUAL = 0.97  # share of the increments of an angle that are compared
_AXES = ((*LOCAL, *VELOCITY_COLUMNS), ("roll", "pitch"), ("yaw",))
_COMPARED = (*LOCAL, GEODETIC[2], *GEODETIC[:2], *VELOCITY_COLUMNS, *ATTITUDE_COLUMNS)


def check_run(
    table: TrajectoryTable, reference: ReferenceTrack, align: str, applied: float
) -> tuple[TrajectoryTable, float]:
    """Check a trajectory against the reference and by itself; return it with its notes, and its clock offset, s."""
    settle(table, _check_common_time(table, reference, applied))
    table = settle(table, _check_units(table, reference))
    table = settle(table, _check_place(table, reference) if align == "none" else ())
    table = check_consistent_units(table)
    if align == "yaw":
        return table, np.nan
    offset = check_clock(table, reference, applied)
    return check_frame_of(check_axes(table, reference), reference), offset


# --------------------------------------------------------------------------------------------------
# Clock: overlap with the reference, and the offset that the motion shows.


def _follow(
    table: TrajectoryTable, reference: ReferenceTrack, rows: np.ndarray | slice
) -> MotionSearch:
    """Return positions of a trajectory that are moved in time against the reference."""
    position = reference.locate(table)[rows]
    return MotionSearch(
        table.time[rows], position, reference.table.time, reference.interpolate_position
    )


def _round_whole(shift: float) -> float:
    """Return the whole number of seconds near a shift, as between time scales, else the shift to 10 ms."""
    return float(round(shift)) if abs(shift - round(shift)) < 0.05 else round(shift, 2)


def _check_common_time(table: TrajectoryTable, reference: ReferenceTrack, applied: float) -> Iterator[Finding]:  # fmt: skip
    """Check that a trajectory and the reference share time."""
    (first, last), clock = (table.time[0], table.time[-1]), reference.table.time
    remedy = _find_time_unit(table, reference)
    if last > clock[0] and first < clock[-1] and not remedy:
        return
    if not remedy:
        motion = _follow(table, reference, slice(None))
        spread, shift = motion.search_all()
        is_found = spread < _EXPLAINED * extent_of(reference.position)
        size = applied + (_round_whole(shift) if is_found else clock[0] - first)
        remedy = f"{'The motion agrees at' if is_found else 'If both start together, set'} NAME.shift={size:.10g}"
    evidence = (
        f"{table.file}: column t must overlap {reference.file} ({clock[0]:.10g} to {clock[-1]:.10g} s), got "
        f"{first:.10g} to {last:.10g} s"
    )
    yield Finding("overlap", REFUSE, min(last, clock[-1]) - max(first, clock[0]), 0.0, "s", evidence, remedy)  # fmt: skip


def _find_time_unit(table: TrajectoryTable, reference: ReferenceTrack) -> str:
    """Return the remedy for a time of 0.5 to 2 times the length of the reference in another unit, '' for seconds.

    A trajectory that shares 20 rows with the reference needs a motion that agrees in the unit alone.
    """
    clock, units = reference.table.time, UNIT_FACTORS["time"].items()
    ratio = (table.time[-1] - table.time[0]) / (clock[-1] - clock[0])
    choices = [(f, f"The column is in {u}: set NAME.scale=t:{f:.6g}") for u, f in units]
    choices += [(1 / f, f"That of the reference is in {u}: set reference.scale=t:{f:.6g}") for u, f in units if f < 1]  # fmt: skip
    factor, remedy = next(((f, text) for f, text in choices if 0.5 < ratio * f < 2), (1.0, ""))
    inside = (table.time >= clock[0]) & (table.time <= clock[-1])
    if remedy and (factor > 1 or inside.sum() >= _LEAST_ROWS):
        motion = _follow(table.scale_columns({"t": factor}), reference, slice(None))
        best = min(motion.spread(0.0), motion.search_all()[0])
        return (
            remedy
            if extent_of(reference.position) and best <= _EXPLAINED * extent_of(reference.position)
            else ""
        )
    return remedy


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
    motion = _follow(table, reference, rows)
    at_zero, (spread, shift) = motion.spread(0.0), motion.search(-_NEAR_S, _NEAR_S)
    if spread >= _EXPLAINED * at_zero and at_zero > _FAR * extent_of(reference.position):
        spread, shift = min((spread, shift), _follow(table, reference, slice(None)).search_all())
    if abs(shift) > CLOCK_LIMIT and spread < _EXPLAINED * at_zero:
        if spread > _CLEAR * at_zero:  # other axes may explain more
            check_axes(table, reference)
        evidence = (
            f"{table.file}: column t must have the clock of {reference.file}, got an offset of {shift:.2f} s: with it "
            f"the median difference falls from {at_zero:.3g} to {spread:.3g} m"
        )
        remedy = f"Set NAME.shift={applied + _round_whole(shift):.10g}. GPS time is 18 s ahead of UTC since 2017"
        settle(table, [Finding("gnss clock", REFUSE, shift, CLOCK_LIMIT, "s", evidence, remedy)])
    least = _SHOWN if abs(shift) <= CLOCK_LIMIT else _LARGE_SHOWN
    is_shown = (spread < least * at_zero and abs(shift) <= _NEAR_S) or abs(shift) < 0.02
    return round(shift, 3) + 0.0 if is_shown else np.nan


# --------------------------------------------------------------------------------------------------
# Columns against those of the reference: place, unit, axis and sign.


class _Pair(NamedTuple):
    """Values of a column of the trajectory and of the reference at the same times, [T]."""

    name: str
    mine: Array
    theirs: Array


def _pair_columns(table: TrajectoryTable, reference: ReferenceTrack, fewest: int) -> list[_Pair]:
    """Pair the columns of both tables outside holes of the reference, if they have enough rows."""
    rows, recorded, clock = reference.is_bridged(table.time), reference.table.values, reference.table.time  # fmt: skip
    if rows.sum() < fewest:
        return []
    origin = dict(zip(GEODETIC, reference.origin, strict=False))
    level = {name: np.full(len(clock), origin[name]) for name in origin if name not in recorded}
    columns = {**recorded, **level}
    return [
        _Pair(name, table.values[name][rows], np.interp(table.time[rows], clock, columns[name]))
        for name in _COMPARED
        if name in table.values and name in columns
    ]


def _check_place(table: TrajectoryTable, reference: ReferenceTrack) -> Iterator[Finding]:
    """Check that a trajectory comes near the reference at any epoch, even if it diverges later."""
    rows = (table.time >= reference.table.time[0]) & (table.time <= reference.table.time[-1])
    difference = reference.locate(table)[rows] - reference.interpolate_position(table.time[rows])
    least = float(np.linalg.norm(difference, axis=1).min())
    limit = max(_PLACE, float(np.ptp(reference.position, axis=0).max()))
    if least > limit:
        evidence = f"{table.file}: positions must come within {limit:.4g} m of {reference.file}, got a distance of {least:.4g} m at least"
        remedy = "Check order, unit and origin of the columns"
        yield Finding("place", REFUSE, least, limit, "m", evidence, remedy)


def check_interpolation(reference: ReferenceTrack, time: Array, errors: Mapping[str, float]) -> None:  # fmt: skip
    """Check that steps of the reference are short enough to tell errors from interpolation.

    Shapes: time [T].
    """
    size = float(np.sqrt(np.mean(reference.interpolation_error(time) ** 2)))
    name, least = min(errors.items(), key=lambda item: item[1] if item[1] >= 0 else np.inf)
    if size > max(INTERPOLATED * least, _SMALL):
        step, rows = float(np.median(np.diff(reference.table.time))), len(reference.table.time)
        about = f"about {size:.3g} m" if np.isfinite(size) else f"unknown with {rows} rows"
        raise ValueError(
            f"{reference.file}: column t must have steps that can be interpolated, got {step:.4g} s: the "
            f"error between the rows is {about}, and the position RMSE of {name} is {least:.3g} m. "
            f"Use shorter steps, add vn, ve, vd, or set every={step:.4g} if the epochs agree with the rows."
        )


def _check_units(table: TrajectoryTable, reference: ReferenceTrack) -> Iterator[Finding]:
    """Compare each column with that of the reference, and refuse a ratio of two units."""
    pairs = _pair_columns(table, reference, _FEWEST)
    for pair in pairs:
        if pair.name == "yaw" and not find_angle_factor(pair.mine, pair.theirs)[1]:
            note = f"yaw agrees with {reference.file} if it is in degrees: NAME.scale=yaw:0.0174533"
            yield Finding("unit of attitude", TELL, 1.0, 1.0, "1", note)
            return
        quantity = QUANTITIES[LIMIT_COLUMNS[pair.name]]
        unit, dimension = quantity.unit, quantity.dimension
        units = quantity.units | (UNIT_FACTORS["rare angle"] if dimension == "angle" else {})
        ratio = _find_ratio(pair, dimension)
        names = [u for u, f in units.items() if abs(ratio * f - 1) < _CLOSE]
        others = [u for u, f in units.items() if abs(ratio / f - 1) < _CLOSE]
        if names or others:
            texts = [*names, *(f"reference in {name}" for name in others)]
            mine = [units[name] for name in names]
            if unit == "rad" and others:
                mine, texts = [1 / units[others[0]]], ["rad, converted twice", *texts]
            if unit == "rad" and table.angle_unit == "deg":  # the reader has converted them
                unit, texts = "deg", ["radians", *texts[bool(others) :]]
            evidence = (
                f"{table.file}: column {pair.name} must be in {unit}, got values {ratio:.4g} times those of "
                f"{reference.file}: {', or '.join(texts)}"
            )
            remedy = _describe_factors(pairs, pair, mine, [1 / units[n] for n in others])  # fmt: skip
            yield Finding(f"unit of {dimension}", REFUSE, ratio, 1.0, "1", evidence, remedy)


def _describe_factors(pairs: Sequence[_Pair], wrong: _Pair, mine: Sequence[float], theirs: Sequence[float]) -> str:  # fmt: skip
    """Return the remedies for all columns of a group that come nearer to the reference with a factor."""
    group = next(group for group in COLUMN_GROUPS if wrong.name in group)

    def words(factor: float, value: float) -> str:
        names = [
            p.name
            for p in pairs
            if p.name in group
            and (p is wrong or np.square(p.mine * factor - p.theirs).sum() < np.square(p.mine - p.theirs).sum())
        ]  # fmt: skip
        return ",".join(f"{name}:{value:.6g}" for name in names)

    remedies = [f"multiply the column by {f:.6g}: set NAME.scale={words(f, f)}" for f in mine]
    remedies += [
        f"multiply that of the reference by {1 / f:.6g}: set reference.scale={words(f, 1 / f)}"
        for f in theirs
    ]
    return f"M{', or '.join(remedies)[1:]}"


def _find_ratio(pair: _Pair, dimension: str) -> float:
    """Return the ratio of two columns: of medians, of units of yaw, or the slope if they correlate; else 1."""
    if dimension == "place" or pair.name == "h_m":
        middle = float(np.median(pair.theirs))
        return float(np.median(pair.mine)) / middle if abs(middle) > 0.5 else 1.0
    if pair.name == "yaw":
        return 1 / find_angle_factor(pair.mine, pair.theirs)[0]
    slope, share = regress_column(pair.mine, pair.theirs)
    return slope if share >= _AGREES else 1.0


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


def check_axes(table: TrajectoryTable, reference: ReferenceTrack) -> TrajectoryTable:
    """Compare each column with all columns of the reference, and refuse other signs and names.

    Returns the trajectory, with a note on a body that is turned as a whole, whose angles are then not compared.

    A column has the opposite sign if its slope on that of the reference is -1 and explains half of its
    variance. It has another name if another column explains 90 % with slope 1 or -1, and its own one
    leaves 5 times the variance.
    """
    pairs = _pair_columns(table, reference, _LEAST_ROWS)
    body = list(_check_body(table, reference))
    for group in _AXES[:1] if body else _AXES:
        of_group = [pair for pair in pairs if pair.name in group]
        fault = next(_list_axis_faults(of_group), None)
        if fault:
            column, problem, remedy = fault
            if table.frame:
                remedy = _frame_remedy(table.frame, of_group)
            evidence = f"{table.file}: column {column} must be that of axes North, East, Down, got {problem} in {reference.file}"
            settle(table, [Finding("axes", REFUSE, 1.0, 0.0, "1", evidence, remedy)])
    return settle(table, body)


def _list_axis_faults(pairs: Iterable[_Pair]) -> Iterator[tuple[str, str, str]]:
    """Yield column, problem and remedy of each column that is not its own one in the reference."""
    pairs = list(pairs)
    for pair in pairs:
        column, mine = pair.name, pair.mine
        slope, share = regress_column(mine, pair.theirs, column == "yaw")
        for candidate in pairs:
            factor, explained = regress_column(mine, candidate.theirs)
            is_better = explained >= _AGREES and 1 - share > _WORSE * (1 - explained)
            if candidate is not pair and is_better and abs(abs(factor) - 1) < _CLOSE:
                sign = "" if factor > 0 else ", and multiply the column by -1"
                remedy = f"Give it the name or the place of {candidate.name}{sign}"
                yield column, f"values {factor:.3f} times those of {candidate.name}", remedy
        if share >= _HALF and abs(slope + 1) < _SIGN:
            # yaw from East also has another zero
            total = float(np.angle(np.exp(1j * (mine + pair.theirs)).mean())) if column == "yaw" else 0.0  # fmt: skip
            remedy = "Multiply the column by -1"
            if abs(total) >= 0.1:
                remedy = f"Subtract the column from {total:.4g} rad: it counts from another axis, the opposite way"
            yield column, f"values {slope:.3f} times those of {column}", remedy


def _frame_remedy(frame: str, pairs: Sequence[_Pair]) -> str:
    """Return the other frame of a TUM file if positions agree in it."""
    mine = {pair.name: pair for pair in pairs}
    if set(LOCAL) <= mine.keys():
        north, east, down = (mine[name].mine for name in LOCAL)
        turned = [mine[name]._replace(mine=v) for name, v in zip(LOCAL, (east, north, -down), strict=True)]  # fmt: skip
        if not next(_list_axis_faults(turned), None):
            return f"Set NAME.frame={'ned' if frame == 'enu' else 'enu'}"
    return "Check NAME.frame, enu or ned, and the order t x y z qx qy qz qw"


def check_frame_of(table: TrajectoryTable, reference: ReferenceTrack) -> TrajectoryTable:
    """Compare the frame of the positions with the reference, as an inspection compares fixes.

    Returns the trajectory, with a note on a turn, a scale or a shift.
    """
    position, time = reference.locate(table), reference.table.time
    velocity = np.gradient(reference.position, time, axis=0)
    motion = RawReference(time, np.zeros_like(velocity), velocity, reference.position, np.arange(len(time)))  # fmt: skip
    fixes = RawFixes(table.time, position, np.arange(len(position)))
    log = RawLog(NO_IMU, fixes, motion, 0.0, ("", table.file, reference.file), ())
    notes = {
        "fix turn": "set align=yaw, which removes it from all programs",
        "fix scale": "correct the scale, or set NAME.scale for pn, pe, pd",
        "fix shift": "check heights (ellipsoid or geoid), datum and origin",
    }
    findings = [f._replace(level=TELL, remedy=f"If it is no error, {notes[f.check]}") for f in (*check_frame(log, {}), *check_shift(log, *compare_at(log, 0.0)[1:]))]  # fmt: skip
    return settle(table, [f._replace(evidence=f.evidence.replace("fixes", "positions"), explanations=()) for f in findings])  # fmt: skip


def _check_body(table: TrajectoryTable, reference: ReferenceTrack) -> Iterator[Finding]:
    """Compare the attitude with that of the reference: a quaternion in another order, or other body axes."""
    pairs = {pair.name: pair for pair in _pair_columns(table, reference, _LEAST_ROWS)}
    if not set(ATTITUDE_COLUMNS) <= pairs.keys():
        return
    mine, theirs = (
        Rotation.from_matrix(dcm_of(np.stack([getattr(pairs[name], side) for name in ATTITUDE_COLUMNS], -1)))
        for side in ("mine", "theirs")
    )  # fmt: skip
    turn, rest = _find_constant_turn(theirs.inv() * mine)
    level, body = (ENU_TO_NED, FLU_TO_FRD) if table.frame == "enu" else (np.eye(3), np.eye(3))
    read = Rotation.from_matrix(level.T @ mine.as_matrix() @ body.T).as_quat()
    reordered = level @ Rotation.from_quat(read[:, [1, 2, 3, 0]]).as_matrix() @ body
    _, reordered_rest = _find_constant_turn(theirs.inv() * Rotation.from_matrix(reordered))
    if table.frame and rest > _TURN and reordered_rest < _EXPLAINED * rest:
        evidence = f"{table.file}: columns qx qy qz qw must have this order, got an attitude that turns as that of {reference.file} with qw first"
        remedy = "Set the line of names # t x y z qw qx qy qz above the first row"
        yield Finding("axes", REFUSE, rest, _TURN, "rad", evidence, remedy)
    size = turn.magnitude()
    if size > _TURN and rest < _EXPLAINED * size:
        near = min(BODY_ORDERS, key=lambda m: float(np.abs(m - turn.as_matrix()).sum()))
        is_near = float(np.abs(near - turn.as_matrix()).max()) < np.sin(_TURN)
        names = f": forward, right, down of the reference are its [{', '.join(name_axes(near))}]" if is_near else ""  # fmt: skip
        evidence = (
            f"{table.file}: the body axes are turned by a constant {np.rad2deg(size):.1f} deg against those of "
            f"{reference.file}, within {np.rad2deg(rest):.1f} deg{names}"
        )
        causes = ("axes of a camera or of the sensor", "another frame of the attitude")
        remedy = "Convert the attitude: all its errors contain this turn"
        yield Finding("mounting", TELL, size, _TURN, "rad", evidence, remedy, explanations=causes)


def _find_constant_turn(turns: Rotation) -> tuple[Rotation, float]:
    """Return the mean of rotations, and the median distance from it, rad."""
    mean = turns.mean()
    return mean, float(np.median((mean.inv() * turns).magnitude()))
