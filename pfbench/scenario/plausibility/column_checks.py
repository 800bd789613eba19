"""Ranges and rates of change of the columns of a table."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array
from pfbench.nav.plausible_limits import LIMIT_COLUMNS, Quantity
from pfbench.scenario.plausibility.log_table import LogTable

_MANY_ROWS = 4  # wrong rows that are not an accident
_FEW = 0.01  # share of rows that can be removed
_NEIGHBOUR = 0.1  # least share of a value that a neighbour has, unless the value is a single error
_LARGEST_WIDENING = 100.0  # times the limit


def check_range(table: LogTable, column: str, values: Array) -> None:
    """Check that values are in the range of their quantity.

    Args:
        table: Table, for the message.
        column: Name of the column.
        values: Values, [n].

    Raises:
        ValueError: If a value is out of range. The message names file, column and row.
    """
    quantity = table.limits.select(LIMIT_COLUMNS[column])
    outside = np.flatnonzero((values < quantity.least) | (values > quantity.largest))
    if outside.size:
        i = int(outside[0])
        least, largest = quantity.least, quantity.largest
        remedies = [
            *_conversions(quantity, values, outside, lambda a: (a >= least) & (a <= largest)),
            *_removal(len(values), len(outside)),
        ]
        reached = float(np.abs(values[outside]).max())
        # the least height is the same for all platforms
        is_reached = quantity.key != "height_m" or values.min() >= least
        # a larger range does not accept a single jump, which the largest change excludes
        is_jump = math.isfinite(quantity.rate) and _is_single(values, outside)
        if quantity.key and is_reached and not (is_jump and quantity.key != "speed_m_s"):
            remedies.append(_widening(quantity.key, reached, getattr(table.limits, quantity.key)))
        raise ValueError(
            f"{table.name}: column {column} must be between {quantity.least:g} and "
            f"{quantity.largest:g} {quantity.unit}, got {values[i]:g} in {table.row(i)} "
            f"({outside.size} such rows). {_join(remedies)}"
        )


def _conversions(
    quantity: Quantity,
    values: Array,
    outside: NDArray[np.intp],
    accepts: Callable[[Array], NDArray[np.bool_]],
) -> list[str]:
    """Name the units whose conversion makes all values acceptable; none for a single wrong value."""
    if _is_single(values, outside):
        return []
    return [
        f"If in {unit}, multiply by {factor:.9g}."
        for unit, factor in quantity.units
        if accepts(factor * values).all()
    ]


def _is_single(values: Array, outside: NDArray[np.intp]) -> bool:
    """Return whether the first value outside is an error of its own, far from its neighbours."""
    i = int(outside[0])
    near = np.sort(np.abs(values[max(i - 1, 0) : i + 2]))
    return len(outside) < _MANY_ROWS and bool(near[-2] < _NEIGHBOUR * near[-1])


def _removal(rows: int, wrong: int) -> list[str]:
    """Advise to remove some wrong rows; not most of a table."""
    if wrong > max(_MANY_ROWS, _FEW * rows):
        return []
    return [f"Correct or remove {'this row' if wrong == 1 else 'these rows'}."]


def _widening(key: str, reached: float, limit: float) -> str:
    """Name the key and value that accept what the platform reached; '' if no platform can."""
    if not reached <= _LARGEST_WIDENING * limit:
        return ""
    unit = 10.0 ** (math.floor(math.log10(reached)) - 2)
    return f"If the platform can reach it, set scenario.limits.{key}={math.ceil(reached / unit) * unit:g}."


def _join(remedies: Sequence[str]) -> str:
    return " ".join(filter(None, remedies)) or "Check the unit and the content of this column."


def check_changes(table: LogTable, columns: Sequence[str], time: Array, values: Array) -> None:
    """Check that columns do not change faster than their quantities can.

    Args:
        table: Table.
        columns: Names of columns.
        time: Times, s, [n].
        values: Values of the k columns, [n, k].

    Raises:
        ValueError: If a value differs from the previous one by more than `rate` times the interval
            plus `allowance` in `plausible_limits`.
    """
    for column, series in zip(columns, values.T, strict=True):
        quantity = table.limits.select(LIMIT_COLUMNS[column])
        step = np.diff(series)
        largest = quantity.rate * np.diff(time) + quantity.allowance
        outside = np.flatnonzero(np.abs(step) > largest)
        if outside.size:
            i = int(outside[0])
            raise ValueError(
                f"{table.name}: column {column} must change by at most {largest[i]:g} "
                f"{quantity.unit} in {time[i + 1] - time[i]:.4g} s, got {series[i + 1]:g} after "
                f"{series[i]:g} in {table.row(i + 1)} ({outside.size} such rows). "
                f"{_join(_change_remedies(table, column, time, series))}"
            )


def _change_remedies(table: LogTable, column: str, time: Array, series: Array) -> list[str]:
    """Find what makes a column change slowly enough."""
    quantity = table.limits.select(LIMIT_COLUMNS[column])

    def is_slow(values: Array, at: Array = time) -> NDArray[np.bool_]:
        return np.abs(np.diff(values)) <= quantity.rate * np.diff(at) + quantity.allowance

    outside = np.flatnonzero(~is_slow(series))
    remedies = _conversions(quantity, series, outside, is_slow) if len(outside) > 2 else []
    wrong = outside[1:][np.diff(outside) == 1]  # rows with a jump before and after
    if len(wrong) and is_slow(np.delete(series, wrong), np.delete(time, wrong)).all():
        remedies += _removal(len(series), len(wrong))
    if len(outside) == 1:
        remedies.append(
            f"Keep the rows on one side of the jump before {table.row(int(outside[0]) + 1)}."
        )
    if LIMIT_COLUMNS[column] == "velocity":
        change = (np.abs(np.diff(series)) - quantity.allowance) / np.diff(time)
        limit = table.limits.acceleration_m_s2
        remedies.append(_widening("acceleration_m_s2", float(change.max()), limit))
    return remedies
