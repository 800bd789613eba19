"""Import of own logs: files of other programs become the tables imu, gnss and reference of a folder."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.files.table_file import TableFile
from pfbench.logs.judge.formats import read_file
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import (
    LOCAL,
    ROLES,
    VELOCITY_COLUMNS,
)

_MOST_REPEATS = 0.5  # share of rows that another sampling explains


def import_table(role: str, path: Path, options: SourceOptions) -> TableFile:
    """Read a file of another program as a table of an own log.

    Args:
        role: imu, gnss or reference.
        path: File, or folder of KITTI.
        options: How it is read.

    Returns:
        The table in the units and axes of an own log, and notes.
    """
    require(path.exists(), role, "be a file", f"none at {path}", "Check the path.")
    (table,) = read_file(path, options, role)
    columns = {"t": table.time, **table.values}
    rows = pd.DataFrame({name: columns[name] for name in ROLES[role] if name in columns})
    result = _drop_repeats(role, TableFile(rows, {}, table.notes), options)
    return _complete_reference(result) if role == "reference" else result


def _complete_reference(table: TableFile) -> TableFile:
    """Add the velocity to a reference as the change of local positions if it has none."""
    rows = table.rows
    if VELOCITY_COLUMNS[0] in rows:
        return table
    require(
        LOCAL[0] in rows,
        "a reference",
        "have vn, ve, vd or local positions pn, pe, pd",
        "neither",
        "Add the velocities.",
    )
    velocity = np.gradient(rows[list(LOCAL)].to_numpy(float), rows["t"].to_numpy(float), axis=0)
    rows = rows.assign(**dict(zip(VELOCITY_COLUMNS, velocity.T, strict=True)))
    notes = (*table.notes, "velocities are the change of the positions")
    return TableFile(rows[[name for name in ROLES["reference"] if name in rows]], {}, notes)


def _drop_repeats(role: str, table: TableFile, options: SourceOptions) -> TableFile:
    """Check that times are finite and, unless the option says so, not repeated."""
    time = table.rows["t"].to_numpy(float)
    count = int(np.isfinite(time).sum())
    require(
        len(time) > 1 and count == len(time),
        role,
        "have at least two rows with a time",
        count,
        "Check the file.",
    )
    repeated = pd.Series(time).duplicated().to_numpy()
    if not repeated.any():
        return table
    is_rounded = repeated.mean() > _MOST_REPEATS
    remedy = f"Set {role}.repeats=first to keep the first of them, in Python repeats='first'."
    if is_rounded:
        remedy = (
            "The times have lost digits: write them again with more, since no key brings them back."
        )
    require(
        options.repeats == "first" and not is_rounded,
        role,
        "have one row for each time",
        f"{int(repeated.sum())} rows that repeat one, the first at t = {time[repeated][0]:g}",
        remedy,
    )
    note = f"{int(repeated.sum())} rows that repeat a time left out"
    return TableFile(table.rows[~repeated].reset_index(drop=True), {}, (*table.notes, note))


def write_log(folder: Path, tables: Mapping[str, TableFile]) -> None:
    """Write the tables of an own log to a new folder, all or none.

    Args:
        folder: New folder.
        tables: Tables by role.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as scratch:
        draft = Path(scratch) / folder.name
        draft.mkdir()
        for role, table in tables.items():
            table.rows.to_csv(draft / f"{role}.csv", index=False)
        draft.rename(folder)
