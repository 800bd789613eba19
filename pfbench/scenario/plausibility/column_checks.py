"""Ranges and rates of change of the columns of a table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pfbench.files.table_file import Array
from pfbench.nav.plausible_limits import LIMIT_COLUMNS, Quantity
from pfbench.scenario.plausibility.log_table import LogTable


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
        raise ValueError(
            f"{table.name}: column {column} must be between {quantity.least:g} and "
            f"{quantity.largest:g} {quantity.unit}, got {values[i]:g} in {table.row(i)} "
            f"({outside.size} such rows). {_remedy(quantity)}"
        )


def _remedy(quantity: Quantity) -> str:
    widen = f"If the platform can reach it, set scenario.limits.{quantity.key}."
    return " ".join(
        filter(None, (quantity.hint, "Correct or remove this row.", widen if quantity.key else ""))
    )


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
                f"{_remedy(quantity)}"
            )
