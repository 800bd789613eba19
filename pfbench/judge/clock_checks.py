"""Checks of the clock of a trajectory: overlap with the reference, and the offset that the motion shows."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pfbench.judge.axis_checks import check_axes
from pfbench.judge.readers.trajectory_table import TrajectoryTable
from pfbench.judge.reference_track import ReferenceTrack
from pfbench.results.error_measures import Array

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
    """Check that a trajectory and the reference share time.

    Args:
        table: Trajectory.
        reference: Reference.
        applied: Shift that its clock already has, s.

    Raises:
        ValueError: If they do not overlap. The message proposes a unit or a shift.
    """
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

    Args:
        table: Trajectory.
        reference: Reference.
        applied: Shift that its clock already has, s.

    Returns:
        Time to add to the clock of the trajectory, s; NaN if the motion does not show it.

    Raises:
        ValueError: If the offset exceeds 0.5 s and leaves less than 20 % of the
            differences, or if other axes explain more of them.
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
