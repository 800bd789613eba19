"""Readers of text with columns of a fixed order: TUM and KF-GINS."""

from __future__ import annotations

import difflib
import re
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.files.limits import check_columns, read_text
from pfbench.files.table_file import describe_cut, is_number_text, read_table_file, split_lines
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import (
    ALL_COLUMNS,
    ATTITUDE_COLUMNS,
    ATTITUDE_SD,
    COVARIANCE_COLUMNS,
    GEODETIC,
    LOCAL,
    POSITION_SD,
    SD_GROUPS,
    VELOCITY_COLUMNS,
    VELOCITY_SD,
    TrajectoryTable,
    euler_angles,
    rotation_from_quaternion,
)
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES
from pfbench.logs.units import ALIASES, WEEK
from pfbench.stats.error_measures import Array

_TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_KF_GINS_COLUMNS = ("week", "t", *GEODETIC, *VELOCITY_COLUMNS, "roll", "pitch", "yaw")
KF_GINS_SD = 22  # columns of the file of standard deviations: time, 9 of navigation, 12 of sensors
_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # from East, North, Up
_TO_FRD = np.diag([1.0, -1.0, -1.0])  # a body with forward, left, up
_COMMENTS, _BOM = ("#", "%"), "\ufeff"
_HEAD_BYTES = 2**20  # with all comments before the first row
_UNIT = re.compile(r"[\[(][^\[(\])]*[\])]")  # as in time [s]
_QUATERNION = re.compile(r"(?:.*\W)?(?:q|quat|quaternion|orientation|rot|rotation)\w*?_?([wxyz])")


def read_tum_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read lines `t x y z qx qy qz qw` (s, m, rotation from body to world).

    With frame=enu, the world is East, North, Up and the body forward, left, up [REP 103]. With
    frame=ned they are North, East, Down and forward, right, down. A line of names can state another
    order of the quaternion and further columns, and an index can precede the time.
    """
    if not options.frame:
        raise ValueError(
            f"NAME.frame must be ned or enu for {file.name}, got none: a TUM file does not state its "
            "axes. Set NAME.frame=enu if z points up."
        )
    names, rows = read_head(file)
    places = find_pose_columns(names, rows) or list(range(len(_TUM_COLUMNS)))
    width = len(names) or (to_numbers(rows).shape[1] if places[0] else len(places))
    numbers, lines, notes = _read_numbers(file, _TUM_COLUMNS, places, width)
    length = np.linalg.norm(numbers[:, 4:], axis=1)
    bad = np.abs(length - 1) > 0.01
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{file.name}: line {lines[row]}, columns qx ... qw must be a quaternion of length 1, "
            f"got length {length[row]:.3g}. Check the order of the columns: {' '.join(_TUM_COLUMNS)}."
        )
    if width > len(_TUM_COLUMNS):
        used = ", ".join(str(index + 1) for index in places)
        notes = (*notes, f"columns {used} of {width} are read as {' '.join(_TUM_COLUMNS)}")
    position, rotation = numbers[:, 1:4], rotation_from_quaternion(numbers[:, 4:])
    if options.frame == "enu":
        position, rotation = position @ _TO_NED.T, _TO_NED @ rotation @ _TO_FRD
    values = _by_name(LOCAL, position) | _by_name(ATTITUDE_COLUMNS, euler_angles(rotation))
    return [TrajectoryTable(file.name, numbers[:, 0], values, lines, notes, frame=options.frame)]


def find_pose_columns(names: Sequence[str], rows: Sequence[Sequence[str]]) -> list[int]:
    """Find the columns of time, position and quaternion (x, y, z, w)."""
    axes = {m[1]: k for k, name in enumerate(names) if (m := _QUATERNION.fullmatch(name.lower()))}
    first = min(axes.values(), default=0)
    if len(axes) == 4 and max(axes.values()) == first + 3 and first > 3:
        return [0, first - 3, first - 2, first - 1, *(axes[axis] for axis in "xyzw")]
    numbers = to_numbers(rows)
    width = numbers.shape[1]
    is_unit = np.abs(np.linalg.norm(numbers[:, -4:], axis=1) - 1) < 0.01
    if width not in (8, 9) or is_unit.mean() < 0.5:
        return []
    has_index = width == 9 and bool((np.diff(numbers[:, 0]) == 1).all())
    return list(range(width - 8, width)) if width == 8 or has_index else []


def read_kf_gins_trajectory(
    file: Path, options: SourceOptions, sd: Path | None = None
) -> list[TrajectoryTable]:
    """Read a navigation result or truth of KF-GINS: week, second, position, velocity, attitude.

    The units are deg, deg, m, m/s North, East, Down, and deg for roll, pitch and yaw.
    """
    numbers, lines, notes = _read_numbers(file, _KF_GINS_COLUMNS)
    values = (
        _by_name(GEODETIC, numbers[:, 2:5])
        | _by_name(VELOCITY_COLUMNS, numbers[:, 5:8])
        | _by_name(ATTITUDE_COLUMNS, np.radians(numbers[:, 8:11]))
    )
    second = numbers[:, 1]
    time = (
        second if (np.diff(second) > 0).all() else second + WEEK * (numbers[:, 0] - numbers[0, 0])
    )
    if sd is not None:
        names = ("t", *(f"column {k}" for k in range(2, KF_GINS_SD + 1)))
        require(sd.is_file(), "sd", "be a file", f"{sd} for {file.name}", "Check the path.")
        deviations, _, _ = _read_numbers(sd, names)
        if deviations.shape[0] != len(time) or (np.abs(deviations[:, 0] - second) > 1e-4).any():
            raise ValueError(
                f"{sd.name} must have the times of {file.name}, got {len(deviations)} rows from "
                f"{deviations[0, 0]} s for {len(time)} rows from {second[0]} s. Use files of one run."
            )
        values |= _by_name(POSITION_SD, deviations[:, 1:4])
        values |= _by_name(VELOCITY_SD, deviations[:, 4:7])
        values |= _by_name(ATTITUDE_SD, np.radians(deviations[:, 7:10]))
    return [TrajectoryTable(file.name, time, values, lines, notes, angle_unit="deg")]


def read_head(file: Path, rows: int = 20) -> tuple[list[str], list[list[str]]]:
    """Read names of columns and the first rows of a text; a line of names can be a comment."""
    heads: list[list[str]] = []
    fields: list[list[str]] = []
    for line in map(str.strip, _read_first_lines(file)):
        if line.startswith(_COMMENTS) or (not fields and _has_no_number(line)):
            heads.append(split_line(_UNIT.sub("", line.lstrip("#% "))))
        elif line:
            fields.append(split_line(line))
        if len(fields) == rows:
            break
    width = len(fields[0]) if fields else 0
    check_columns(file, width)
    return next((names for names in reversed(heads) if len(names) == width), []), fields


def _read_first_lines(file: Path) -> list[str]:
    """Return the lines at the start of a text. The last one can be cut."""
    with file.open("rb") as stream:
        return split_lines(stream.read(_HEAD_BYTES).decode("utf-8-sig", "replace"))


def to_numbers(rows: Sequence[Sequence[str]]) -> Array:
    """Convert the rows of the most common width to numbers [T, K], without damaged ones."""
    widths = [len(row) for row in rows]
    width = max(widths, key=widths.count, default=0)
    valid = [row for row in rows if len(row) == width and all(map(is_number_text, row))]
    return np.array(valid, dtype=np.float64).reshape(len(valid), width if valid else 0)


def split_line(line: str) -> list[str]:
    """Split a line at commas or semicolons, else at blanks and tabs."""
    separator = next((s for s in ",;" if s in line), None)
    fields = [field.strip() for field in line.strip().split(separator)]
    return fields[:-1] if separator and not fields[-1] else fields


def _has_no_number(line: str) -> bool:
    """Return whether a line consists of names."""
    return not any(map(is_number_text, split_line(line)))


def _by_name(names: tuple[str, ...], columns: Array) -> dict[str, Array]:
    return {name: columns[:, k] for k, name in enumerate(names)}


def _read_numbers(
    file: Path, names: tuple[str, ...], places: Sequence[int] = (), width: int = 0
) -> tuple[Array, np.ndarray, tuple[str, ...]]:
    """Return numbers [T, K] of some columns or of all, their lines [T], and notes.

    Comments start with # or %, and names can precede the first row. A last line without an end may
    lack digits, so it is dropped with a note.
    """
    rows, lines = array("d"), array("q")  # a list of numbers needs four times the memory
    notes: list[str] = []
    width = width or len(names)
    content = read_text(file).decode("utf-8", "replace").removeprefix(_BOM)
    *complete, last = split_lines(content)
    for number, line in enumerate(complete, 1):
        text, fields = line.strip(), split_line(line)
        if not text or text.startswith(_COMMENTS):
            continue
        if not (rows or notes) and len(fields) == width and _has_no_number(text):
            notes = [f"line {number} is read as names of columns: {text[:80]}"]
            continue
        try:
            row = [float(fields[k]) for k in places or range(width)]
        except (ValueError, IndexError):
            row = []
        if not row or len(fields) != width:
            raise ValueError(
                f"{file.name}: line {number} must have {width} numbers ({' '.join(names[:11])}), "
                f"got {line[:80]!r}. Repair or remove this line."
            )
        rows.extend(row)
        lines.append(number)
    notes += [describe_cut(file, len(complete) + 1)] if last.strip() else []
    numbers = np.array(rows).reshape(len(lines), len(places) or width)
    return numbers, np.array(lines), tuple(notes)


# --------------------------------------------------------------------------------------------------
# Reader of CSV and Parquet tables with named columns.

_STATED_UNIT = re.compile(r"[\[(]\s*([^\[(\])]+?)\s*[\])]\s*$")  # at the end of a name


def read_csv_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read a table whose columns have the names of `ALL_COLUMNS`."""
    content = read_table_file(file)
    rows = content.rows.rename(columns=str)
    lines = np.arange(len(rows)) + (1 if file.suffix == ".parquet" else 2)
    rows = _rename_columns(file, rows, options)
    if "t" not in rows:
        raise ValueError(
            f"{file.name} must have the column t (time, s), got {', '.join(map(str, rows))}."
            f"{_similar('time', list(map(str, rows)))} Rename it with NAME.columns=t:NAME_IN_FILE."
        )
    incomplete = [name for group in SD_GROUPS for name in _incomplete(group, rows)]
    names = [name for name in ALL_COLUMNS if name in rows and name not in incomplete]
    values = {name: _numbers(file, rows[name], name, lines) for name in names}
    unused = [str(name) for name in rows if name not in names]
    notes = (f"columns not used: {', '.join(unused)}",) if unused else ()
    if COVARIANCE_COLUMNS[0] in values and POSITION_SD[0] in values:
        notes = (*notes, "the covariance is used in place of sd_pn, sd_pe and sd_pd")
    time = values.pop("t")
    origin = _stated_origin(content.stated)
    table_notes = (*content.notes, *notes)
    return [TrajectoryTable(file.name, time, values, lines, table_notes, origin=origin)]


def _rename_columns(file: Path, rows: pd.DataFrame, options: SourceOptions) -> pd.DataFrame:
    """Return the rows with the names of pfbench."""
    for name, in_file in options.columns.items():
        if in_file not in rows or name not in ALL_COLUMNS:
            absent = in_file not in rows
            wrong, choices = (in_file, map(str, rows)) if absent else (name, ALL_COLUMNS)
            raise ValueError(
                f"{file.name}: columns must exist, got {wrong}. Choose from {', '.join(choices)}. Write a name "
                "with commas in quotes."
            )
    _check_stated_units(file, options)
    used = options.columns.items()
    hidden = [name for name in options.columns if name in rows]
    rows = rows.drop(columns=[name for name in hidden if name not in options.columns.values()])
    return rows.rename(columns={in_file: name for name, in_file in used})


def _check_stated_units(file: Path, options: SourceOptions) -> None:
    """Raise ValueError if names state other units, as time [ms], that no factor converts."""
    factors: dict[str, float] = {}
    for name, in_file in options.columns.items():
        match = _STATED_UNIT.search(in_file)
        stated = match[1] if match else ""
        units = QUANTITIES[LIMIT_COLUMNS[name]].units if name in LIMIT_COLUMNS else {}
        factor = units.get(ALIASES.get(stated, stated), 1.0)
        if factor != 1 and name not in options.scale:
            factors[name] = factor
    if factors:
        names = ", ".join(f"{name} from {options.columns[name]}" for name in factors)
        word = ",".join(
            f"{name}:{factor:.8g}" for name, factor in {**options.scale, **factors}.items()
        )
        raise ValueError(
            f"{file.name}: columns must be in s, m, m/s and rad, latitude and longitude in deg, got {names}. "
            f"Set NAME.scale={word}."
        )


def _stated_origin(stated: Mapping[str, str]) -> tuple[float, ...]:
    """Return the origin that a Parquet file states in deg, deg, m, or an empty tuple."""
    try:
        return tuple(float(stated[f"origin_{name}"]) for name in GEODETIC)
    except (KeyError, ValueError):
        return ()


def _incomplete(group: tuple[str, ...], rows: pd.DataFrame) -> list[str]:
    """Return the columns of a group that lacks others."""
    present = [name for name in group if name in rows]
    return present if len(present) < len(group) else []


def _numbers(file: Path, column: pd.Series, name: str, lines: np.ndarray) -> np.ndarray:
    numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64)
    bad = np.isnan(numbers) & column.notna().to_numpy()
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{file.name}: line {lines[row]}, column {name} must be a number, got "
            f"{str(column.iloc[row])[:40]!r}. Repair or remove this line."
        )
    return numbers


def _similar(name: str, names: list[str]) -> str:
    close = difflib.get_close_matches(name, names, 1, 0.5)
    return f" Similar: {close[0]}." if close else ""
