"""Remedies for times that go back or do not overlap, each tried on the times before it is named."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pfbench.core.parameter_checks import require
from pfbench.files.table_file import Array
from pfbench.logs.units import UNIT_FACTORS, WEEK

DAY = 86400.0  # s
UNIX_TO_GPS = -315964782.0  # s; GPS time of 1980-01-06 in Unix time, and 18 leap seconds since 2017
# counters that start again, s
_PERIODS = {
    "a new GPS week": WEEK,
    "a new day": DAY,
    "1024 GPS weeks": 1024 * WEEK,
    "a new hour": 3600.0,
    "a 32-bit counter of milliseconds": 2**32 * 1e-3,
    "a 32-bit counter of microseconds": 2**32 * 1e-6,
}
_REGULAR = (0.5, 1.9)  # shortest and longest usual step, in median steps
_FEW_REPEATS = 0.2  # share of rows that can be removed because they repeat a time
_FEW_ROWS = 0.01  # share of rows with a wrong time


def check_time_order(name: str, time: Array, row: Callable[[int], str]) -> None:
    """Check that the times of a table increase.

    Shapes: time [n].
    """
    back = np.flatnonzero(np.diff(time) <= 0) + 1
    if back.size:
        i = int(back[0])
        problem = "repeats the previous time" if time[i] == time[i - 1] else "goes back in time"
        raise ValueError(
            f"{name}: column t must increase, got {time[i]:.15g} after {time[i - 1]:.15g} in {row(i)}, which {problem} "
            f"({back.size} such rows). {find_order_remedy(time, row)}"
        )


def find_order_remedy(time: Array, row: Callable[[int], str]) -> str:
    """Find what makes times increase.

    Shapes: time [n].
    """
    back = np.flatnonzero(np.diff(time) < 0.0) + 1
    if not back.size:
        share = float(np.mean(np.diff(time) == 0.0))
        more = "" if share <= _FEW_REPEATS else "Write t with more digits, or keep "
        return f"{more or 'Keep '}one row for each time."
    period = _find_period(time, back)
    if period:
        name, size = period
        return (
            f"The counter starts again there ({name}): add {size:.10g} to t from {row(int(back[0]))} on"
            f"{', and again at each further such row' if back.size > 1 else ''}. The steps are then usual."
        )
    in_order = np.unique(time)
    removed = len(time) - len(in_order)
    if _is_regular(in_order, time) and removed <= _FEW_REPEATS * len(time):
        rest = " and keep one row for each time" if removed else ""
        return f"Sort the rows by t{rest}."
    wrong = _fewest_wrong(time)
    if len(wrong) <= max(3, _FEW_ROWS * len(time)):
        more = f" and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        return f"Correct or remove {row(int(wrong[0]))}{more}."
    first, last = _longest_part(time)
    return (
        "The clock was set there, or another recording begins. Keep one part: the longest is "
        f"{row(first)} to {row(last)}."
    )


def _find_period(time: Array, back: NDArray[np.intp]) -> tuple[str, float] | None:
    """Return the counter, and its period in units of t, after which all steps are usual."""
    restarts = np.zeros(len(time))
    restarts[back] = 1.0
    step = np.diff(time)
    forward = step[step > 0.0]
    if not forward.size:
        return None
    typical = float(np.median(forward))
    longest = max(_REGULAR[1] * typical, float(forward.max()))
    for name, period in _PERIODS.items():
        for unit in (1.0, *(1.0 / f for f in UNIT_FACTORS["time"].values() if f < 1.0)):
            fixed = time + period * unit * np.cumsum(restarts)
            new = np.diff(fixed)
            if (new >= 0.0).all() and ((new[back - 1] > 0.0) & (new[back - 1] <= longest)).all():
                return name, period * unit
    return None


def _is_regular(in_order: Array, time: Array) -> bool:
    """Return whether sorting puts rows next to their neighbours: without short steps or new gaps."""
    step, before = np.diff(in_order), np.diff(time)
    # a jump next to a step back is that of a row in the wrong place
    beside_back = np.convolve(before <= 0.0, np.ones(3), "same") > 0.0
    usual = before[~beside_back]
    if not step.size:
        return False
    # of rows without any order, the steps once they are sorted
    limits = [(_REGULAR[1] * np.median(step), np.median(step))]
    limits += [(max(_REGULAR[1] * np.median(usual), usual.max()), np.median(usual))] if usual.size else []  # fmt: skip
    return any(step.min() >= _REGULAR[0] * median and step.max() <= most for most, median in limits)


def _fewest_wrong(time: Array) -> NDArray[np.intp]:
    """Return the rows without which the times increase: the late ones, or the early ones if these are fewer."""
    late = np.flatnonzero(time[1:] <= np.maximum.accumulate(time)[:-1]) + 1
    early = np.flatnonzero(time[:-1] >= np.minimum.accumulate(time[::-1])[::-1][1:])
    return late if len(late) <= len(early) else early


def _longest_part(time: Array) -> tuple[int, int]:
    """Return the first and the last row of the longest part whose times increase."""
    borders = np.concatenate([[0], np.flatnonzero(np.diff(time) <= 0.0) + 1, [len(time)]])
    i = int(np.argmax(np.diff(borders)))
    return int(borders[i]), int(borders[i + 1]) - 1


def check_overlap(imu_name: str, imu_time: Array, name: str, time: Array) -> None:
    """Check that two tables have a common time.

    Shapes: imu_time [n], time [m].
    """
    require(
        min(imu_time[-1], time[-1]) > max(imu_time[0], time[0]),
        f"{imu_name} and {name}",
        "overlap in time",
        " and ".join(f"t = {t[0]:.3f} to {t[-1]:.3f}" for t in (imu_time, time)),
        find_overlap_remedy(time, imu_time, name),
    )


def find_overlap_remedy(time: Array, reference: Array, name: str) -> str:
    """Find the shift of one table that makes it overlap a second one.

    Shapes: time [n], reference [m].
    """
    distance = 0.5 * float(reference[0] + reference[-1] - time[0] - time[-1])
    shortest = min(time[-1] - time[0], reference[-1] - reference[0])
    shifts = {
        f"{abs(round(distance / WEEK))} GPS weeks": WEEK * round(distance / WEEK),
        "Unix time and GPS time": UNIX_TO_GPS if distance < 0.0 else -UNIX_TO_GPS,
        f"{abs(round(distance / DAY))} days": DAY * round(distance / DAY),
    }
    for reason, shift in shifts.items():
        common = min(time[-1] + shift, reference[-1]) - max(time[0] + shift, reference[0])
        if shift and common >= 0.5 * shortest:
            return f"Add {shift:.10g} to t of {name} ({reason} apart), then they overlap."
    return "Use the same clock in both (GPS seconds, or seconds from the same instant)."
