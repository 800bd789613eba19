"""Residuals that change over a log: the medians of blocks, and whether they jump, drift or come back."""

from __future__ import annotations

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.thresholds import STANDARD_ERRORS

_MOST, _FEWEST = 8, 2  # blocks
_OF_MEDIAN = (
    1.2533 * 1.4826
)  # standard error of a median of normal values, in median deviations over sqrt(n)


def find_change(
    time: Array, values: Array, fewest: int, unit: str
) -> tuple[int, float, str] | None:
    """Find the column whose medians of blocks differ most; None within five standard errors, or with few values.

    Args:
        time: Times, s, [n].
        values: Residuals, [n, k].
        fewest: Values of a block.
        unit: Unit of the residuals.

    Returns:
        Column, difference between its extreme blocks, and how it changes and when.
    """
    if len(time) < _FEWEST * fewest:
        return None
    blocks = np.array_split(np.arange(len(time)), min(len(time) // fewest, _MOST))
    medians = np.array([np.median(values[rows], 0) for rows in blocks])
    spread = [np.median(np.abs(values[b] - m), 0) for b, m in zip(blocks, medians, strict=True)]
    error = _OF_MEDIAN * np.mean(spread, 0) / np.sqrt(len(blocks[0]))
    axis = int(np.argmax(np.ptp(medians, axis=0)))
    size = float(np.ptp(medians[:, axis]))
    if size < STANDARD_ERRORS * error[axis]:
        return None
    borders = np.array([time[0], *(time[rows[-1]] for rows in blocks)])
    return axis, size, describe_change_of(borders, medians[:, axis], unit)


def describe_change_of(borders: Array, levels: Array, unit: str) -> str:
    """Describe the levels of blocks as a drift or as a jump, whichever leaves less.

    Shapes: borders [n + 1], levels [n].
    """
    index, steps = np.arange(len(levels)), range(1, len(levels))
    rests = [levels[:k].var() * k + levels[k:].var() * (len(levels) - k) for k in steps]
    best, line = int(np.argmin(rests)) + 1, np.polyval(np.polyfit(index, levels, 1), index)
    if len(levels) > 2 and np.square(levels - line).sum() < min(rests):
        return f"drifts by {line[-1] - line[0]:+.3g} {unit}"
    size = levels[best:].mean() - levels[:best].mean()
    return f"jumps by {size:+.3g} {unit} near t = {borders[best]:.1f}"
