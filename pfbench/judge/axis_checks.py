"""Checks of the axes of a trajectory: columns of opposite sign, and columns under the name of another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from pfbench.judge.readers.trajectory_table import LOCAL, VELOCITY_COLUMNS, TrajectoryTable
from pfbench.judge.reference_checks import regress_column
from pfbench.judge.reference_track import ReferenceTrack
from pfbench.results.error_measures import Array

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

    Args:
        table: Trajectory, with the clock of the reference.
        reference: Reference.

    Raises:
        ValueError: If a column has the opposite sign or the values of another one.
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
