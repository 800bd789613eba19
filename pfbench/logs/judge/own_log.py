"""Import of own logs: files of other programs become the tables imu, gnss and reference of a folder."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.files.table_file import is_number_text, read_table_file
from pfbench.logs.judge.formats import find_format, read_trajectories
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.text_formats import read_head, split_line, to_numbers
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    euler_angles,
    rotation_from_quaternion,
)
from pfbench.logs.units import UNIT_FACTORS, WEEK
from pfbench.stats.error_measures import Array

ROLES = {
    "imu": ("t", "fx", "fy", "fz", "wx", "wy", "wz"),
    "gnss": ("t", *GEODETIC, *LOCAL, *VELOCITY_COLUMNS, "fix"),
    "reference": ("t", *GEODETIC, *LOCAL, *VELOCITY_COLUMNS, *ATTITUDE_COLUMNS),
}
LAYOUTS = ("", "table", "tum", "nmea", "kf_gins", "rtklib", "euroc", "kitti")
_UNITS_OF_TIME = {"s": 1.0, **UNIT_FACTORS["time"]}
_REPEATS, _MOST_REPEATS = ("refuse", "first"), 0.5  # share of rows that another sampling explains
_FLIP = np.diag([1.0, -1.0, -1.0])  # forward-left-up and forward-right-down
_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_EUROC = re.compile(r"^#? ?timestamp ?\[ns\]", re.IGNORECASE)
_GPS_TIME = re.compile(r"(\d{4})/(\d\d)/(\d\d)")


@dataclass(frozen=True)
class ImportOptions:
    """Options of a file, `NAME.key=value` on the command line.

    Attributes:
        layout: One of `LAYOUTS`. Empty to find it from the content.
        frame: Axes of a TUM or EuRoC pose, ned or enu.
        time: Unit of the time of a table: s, ms, us or ns.
        repeats: refuse, or first: keep the first row of each time.
        columns: Name in the file by name of pfbench, for a table.
        scale: Factor by name of pfbench, for a column of a table in another unit.
    """

    layout: str = ""
    frame: str = ""
    time: str = "s"
    repeats: str = "refuse"
    columns: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for key, value, allowed in (
            ("format", self.layout, LAYOUTS), ("frame", self.frame, ("", "ned", "enu")),
            ("time", self.time, tuple(_UNITS_OF_TIME)), ("repeats", self.repeats, _REPEATS),
        ):  # fmt: skip
            if value not in allowed:
                raise ValueError(
                    f"NAME.{key} must be one of {', '.join(filter(None, allowed))}, got {value}. Choose one of these."
                )


class ImportedTable(NamedTuple):
    """Table of an own log with the notes of its reader."""

    rows: pd.DataFrame
    notes: tuple[str, ...]


def import_table(role: str, path: Path, options: ImportOptions) -> ImportedTable:
    """Read a file of another program as a table of an own log.

    Args:
        role: imu, gnss or reference.
        path: File, or folder of KITTI.
        options: How it is read.

    Returns:
        The table in the units and axes of an own log, and notes.
    """
    if not path.exists():
        raise ValueError(f"{role} must be a file, got none at {path}. Check the path.")
    layout = options.layout or find_layout(role, path, options)
    reader = _READERS.get((role, layout))
    if reader is None:
        accepted = sorted({name for table, name in _READERS if table == role})
        raise ValueError(
            f"{role} must be of a format with such data, got {layout} for {path.name}. Formats of {role}: "
            f"{', '.join(accepted)}."
        )
    table = reader(path, options)
    rows = table.rows.sort_index(axis=1, key=lambda names: names.map(ROLES[role].index))
    return _check_times(role, ImportedTable(rows, table.notes), options)


def find_layout(role: str, path: Path, options: ImportOptions) -> str:
    """Find the format of a file by its content.

    Args:
        role: imu, gnss or reference.
        path: File or folder.
        options: How it is read.

    Returns:
        Name of the format.
    """
    if path.is_dir():
        return "kitti"
    if options.columns:
        return "table"
    if path.suffix == ".parquet":
        return "table"
    with path.open(encoding="utf-8-sig", errors="replace") as lines:
        first = lines.readline().strip()
    names, rows = read_head(path)
    if _EUROC.match(first):
        return "euroc"
    width = to_numbers(rows).shape[1]
    if (rows and _GPS_TIME.match(" ".join(rows[0]))) or first.startswith("% program"):
        return "rtklib"
    if role == "imu" and not names and width == 7:
        return "kf_gins"
    if role == "gnss" and not names and width in (7, 10, 13):
        return "kf_gins"
    return find_format(path, bool(names)) if role != "imu" else "table"


def _check_times(role: str, table: ImportedTable, options: ImportOptions) -> ImportedTable:
    """Check that times are finite and, unless the option says so, not repeated."""
    time = table.rows["t"].to_numpy(float)
    if len(time) < 2 or not np.isfinite(time).all():
        raise ValueError(
            f"{role} must have at least two rows with a time, got {int(np.isfinite(time).sum())}. Check the file."
        )
    repeated = pd.Series(time).duplicated().to_numpy()
    if repeated.mean() > _MOST_REPEATS or (repeated.any() and options.repeats == "refuse"):
        remedy = f"Set {role}.repeats=first to keep the first of them."
        if repeated.mean() > _MOST_REPEATS:
            remedy = "The times have lost digits: write them again with more, since no key brings them back."
        raise ValueError(
            f"{role} must have one row for each time, got {int(repeated.sum())} rows that repeat one, the first at "
            f"t = {time[repeated][0]:g}. {remedy}"
        )
    if not repeated.any():
        return table
    note = f"{int(repeated.sum())} rows that repeat a time left out"
    return ImportedTable(table.rows[~repeated].reset_index(drop=True), (*table.notes, note))


# --------------------------------------------------------------------------------------------------
# Tables with named columns, and trajectories that `pfbench judge` reads.


def _read_named(role: str) -> Callable[[Path, ImportOptions], ImportedTable]:
    """Return the reader of a table with named columns."""

    def read(path: Path, options: ImportOptions) -> ImportedTable:
        content = read_table_file(path)
        names = {name: options.columns.get(name, name) for name in ROLES[role]}
        unknown = [name for name in (*options.columns, *options.scale) if name not in ROLES[role]]
        missing = [f"{new} ({old})" for new, old in names.items() if new in options.columns and old not in content.rows]  # fmt: skip
        if unknown or missing:
            raise ValueError(
                f"{role}.columns must map {', '.join(ROLES[role])} to columns of {path.name}, got "
                f"{', '.join(unknown or missing)}. It has {', '.join(map(str, content.rows.columns))}."
            )
        rows = pd.DataFrame({n: pd.to_numeric(content.rows[c], errors="coerce") for n, c in names.items() if c in content.rows})  # fmt: skip
        if "t" not in rows:
            raise ValueError(
                f"{path.name} must have a column t, got {', '.join(map(str, content.rows.columns))}. "
                f"Set {role}.columns=t:NAME."
            )
        rows["t"] *= _UNITS_OF_TIME[options.time]
        for name, factor in options.scale.items():
            rows[name] *= float(factor)
        return ImportedTable(rows, content.notes)

    return read


def _read_trajectory(path: Path, options: ImportOptions) -> ImportedTable:
    """Read a trajectory; the velocity of positions alone is their change."""
    frame = options.frame if options.layout in ("", "tum") else ""
    source = SourceOptions(frame=frame, format="" if options.layout == "table" else options.layout)
    table = read_trajectories(path, source)[0]
    names = (*GEODETIC, *LOCAL, *VELOCITY_COLUMNS, *ATTITUDE_COLUMNS)
    rows = pd.DataFrame({"t": table.time, **{n: table.values[n] for n in names if n in table.values}})  # fmt: skip
    return ImportedTable(rows, table.notes)


def _read_reference(path: Path, options: ImportOptions) -> ImportedTable:
    """Read a reference with attitudes."""
    table = _read_trajectory(path, options)
    missing = [name for name in ATTITUDE_COLUMNS if name not in table.rows]
    if missing:
        raise ValueError(
            f"{path.name} must have an attitude for a reference, got none of {', '.join(missing)}. "
            "Use a trajectory with roll, pitch, yaw or a quaternion."
        )
    return _with_velocity(table)


def _with_velocity(table: ImportedTable) -> ImportedTable:
    """Add the velocity as the change of local positions, if the table has none."""
    if "vn" in table.rows:
        return table
    if "pn" not in table.rows:
        raise ValueError(
            "a reference must have vn, ve, vd or local positions pn, pe, pd, got neither. Add the velocities."
        )
    position = table.rows[list(LOCAL)].to_numpy(float)
    velocity = np.gradient(position, table.rows["t"].to_numpy(float), axis=0)
    rows = table.rows.assign(**dict(zip(VELOCITY_COLUMNS, velocity.T, strict=True)))
    return ImportedTable(rows, (*table.notes, "velocities are the change of the positions"))


def _read_fixes(path: Path, options: ImportOptions) -> ImportedTable:
    """Read fixes; attitudes are left out."""
    table = _read_trajectory(path, options)
    return ImportedTable(table.rows.drop(columns=list(ATTITUDE_COLUMNS), errors="ignore"), table.notes)  # fmt: skip


# --------------------------------------------------------------------------------------------------
# Text of KF-GINS and RTKLIB.


def _read_rows(path: Path, widths: Sequence[int], names: str) -> Array:
    """Read the rows of numbers of a text, [n, k]."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    rows = [split_line(line) for line in lines if line.strip() and line.strip()[0] not in "#%"]
    for number, row in enumerate(rows, 1):
        if len(row) not in widths or not all(map(is_number_text, row)):
            raise ValueError(
                f"{path.name}: row {number} must have {' or '.join(map(str, widths))} numbers ({names}), got "
                f"{' '.join(row)[:80]!r}. Repair or remove this line."
            )
    if len({len(row) for row in rows}) > 1:
        raise ValueError(f"{path.name} must have rows of one length, got several. Repair the file.")
    return np.array(rows, float)


def _read_kf_gins_imu(path: Path, options: ImportOptions) -> ImportedTable:
    """Read increments: second, three angles, rad, and three velocities, m/s, forward, right, down."""
    numbers = _read_rows(path, (7,), "t, angle increments, velocity increments")
    time = numbers[:, 0]
    step = np.diff(time, prepend=2.0 * time[0] - time[1])[:, None]
    if (step <= 0.0).any():
        raise ValueError(
            f"{path.name} must have increasing times, got {time[int((step <= 0).argmax())]}. Sort the lines."
        )
    values = np.hstack([numbers[:, 4:7], numbers[:, 1:4]]) / step
    middle = time - 0.5 * step[:, 0]
    rows = pd.DataFrame(dict(zip(ROLES["imu"], [middle, *values.T], strict=True)))
    return ImportedTable(rows, ("increments divided by their intervals, at their middles",))


def _read_kf_gins_fixes(path: Path, options: ImportOptions) -> ImportedTable:
    """Read fixes: second, latitude, longitude, height, three deviations, and velocities in files of 10 or 13 columns."""
    numbers = _read_rows(path, (7, 10, 13), "t, latitude, longitude, height, deviations")
    names = ["t", *GEODETIC] + (list(VELOCITY_COLUMNS) if numbers.shape[1] == 13 else [])
    columns = [0, 1, 2, 3] + ([7, 8, 9] if numbers.shape[1] == 13 else [])
    return ImportedTable(pd.DataFrame(numbers[:, columns], columns=names), ())


def _read_rtklib(path: Path, options: ImportOptions) -> ImportedTable:
    """Read a solution of RTKLIB with latitude, longitude and height; t is the second of the GPS week of the first row."""
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    head = next((line for line in lines if line.startswith("%") and "latitude" in line), "")
    if lines and not head and any(line.startswith("%") for line in lines):
        raise ValueError(
            f"{path.name} must have latitude, longitude and height, got other positions. "
            "Set the output of RTKLIB to lat/lon/height (out-solformat = llh)."
        )
    fields = [line.split() for line in lines if line.strip() and not line.startswith("%")]
    for number, row in enumerate(fields, 1):
        if len(row) < 6 or not all(map(is_number_text, row[2:6])):
            raise ValueError(
                f"{path.name}: row {number} must have time, latitude, longitude, height and Q, got "
                f"{' '.join(row)[:80]!r}. Repair or remove this line."
            )
    stamps = pd.to_datetime([f"{row[0]} {row[1]}" for row in fields if _GPS_TIME.match(row[0])])
    if len(stamps) == len(fields):
        seconds = (stamps - pd.Timestamp("1980-01-06")).total_seconds().to_numpy(float)
    else:
        seconds = np.array([float(row[0]) * WEEK + float(row[1]) for row in fields])
    week = np.floor(seconds[0] / WEEK) if len(seconds) else 0.0
    numbers = np.array([row[2:6] for row in fields], float).reshape(-1, 4)
    rows = pd.DataFrame(numbers, columns=[*GEODETIC, "fix"]).assign(t=seconds - week * WEEK)
    note = f"t is the second of GPS week {int(week)}; the column fix has the codes of RTKLIB"
    return ImportedTable(rows, (note,))


# --------------------------------------------------------------------------------------------------
# EuRoC and KITTI.


def _read_euroc(path: Path, names: Sequence[str]) -> Array:
    """Read the rows of a EuRoC file with a time in ns, in s, [n, k]."""
    numbers = _read_rows(path, (len(names), 17), ", ".join(names))
    numbers[:, 0] *= 1e-9
    return numbers


def _read_euroc_imu(path: Path, options: ImportOptions) -> ImportedTable:
    """Read rate and force. The axes stay as recorded, and the inspection names the mounting."""
    numbers = _read_euroc(path, ("timestamp", "w x", "w y", "w z", "a x", "a y", "a z"))
    order = [0, 4, 5, 6, 1, 2, 3]
    rows = pd.DataFrame(numbers[:, order], columns=list(ROLES["imu"]))
    return ImportedTable(rows, ("axes of the sensor are as recorded",))


def _read_euroc_reference(path: Path, options: ImportOptions) -> ImportedTable:
    """Read position, quaternion (w, x, y, z) and velocity in a frame with z up, and a body as recorded."""
    numbers = _read_euroc(path, ("timestamp", "p x", "p y", "p z", "q w", "q x", "q y", "q z", "v x", "v y", "v z"))  # fmt: skip
    rotation = _FROM_ENU @ rotation_from_quaternion(numbers[:, [5, 6, 7, 4]])
    columns = {
        **dict(zip(LOCAL, (numbers[:, 1:4] @ _FROM_ENU.T).T, strict=True)),
        **dict(zip(VELOCITY_COLUMNS, (numbers[:, 8:11] @ _FROM_ENU.T).T, strict=True)),
        **dict(zip(ATTITUDE_COLUMNS, euler_angles(rotation).T, strict=True)),
    }
    rows = pd.DataFrame({"t": numbers[:, 0], **columns})
    return ImportedTable(rows, ("x, y, z of the frame are taken as East, North, Up",))


def _read_kitti(path: Path) -> tuple[Array, Array]:
    """Read times, s, [n], and packets, [n, 30], of a folder oxts with timestamps.txt and data/."""
    folder = path / "oxts" if (path / "oxts").is_dir() else path
    stamps = folder / "timestamps.txt"
    files = sorted((folder / "data").glob("*.txt"))
    if not stamps.is_file() or not files:
        raise ValueError(
            f"{path} must contain oxts/timestamps.txt and oxts/data/*.txt, got none. Use the folder of a KITTI drive."
        )
    times = pd.to_datetime(stamps.read_text().split("\n"), errors="coerce").dropna()
    if len(times) != len(files):
        raise ValueError(
            f"{stamps} must have a time for each of {len(files)} files, got {len(times)}. Complete the folder."
        )
    packets = np.vstack([_read_rows(file, (30,), "packet of KITTI") for file in files])
    return (times - times[0]).total_seconds().to_numpy(float), packets


def _read_kitti_imu(path: Path, options: ImportOptions) -> ImportedTable:
    """Read acceleration with gravity and rate, forward, left, up."""
    time, packets = _read_kitti(path)
    values = np.hstack([packets[:, 11:14] @ _FLIP, packets[:, 17:20] @ _FLIP])
    return ImportedTable(pd.DataFrame(dict(zip(ROLES["imu"], [time, *values.T], strict=True))), ())


def _read_kitti_reference(path: Path, options: ImportOptions) -> ImportedTable:
    """Read position, velocity East and North, and attitude; yaw is counted from East, anticlockwise."""
    time, packets = _read_kitti(path)
    roll, pitch, yaw = packets[:, 3], -packets[:, 4], np.pi / 2 - packets[:, 5]
    height = np.gradient(packets[:, 2], time)
    columns = {
        "t": time,
        **dict(zip(GEODETIC, packets[:, :3].T, strict=True)),
        **dict(zip(VELOCITY_COLUMNS, (packets[:, 6], packets[:, 7], -height), strict=True)),
        **dict(zip(ATTITUDE_COLUMNS, (roll, pitch, yaw), strict=True)),
    }
    return ImportedTable(pd.DataFrame(columns), ("the vertical velocity is the change of the height",))  # fmt: skip


def _read_kitti_fixes(path: Path, options: ImportOptions) -> ImportedTable:
    """Read the positions of the navigation system, which are not independent fixes."""
    time, packets = _read_kitti(path)
    rows = pd.DataFrame({"t": time, **dict(zip(GEODETIC, packets[:, :3].T, strict=True))})
    return ImportedTable(rows, ("the fixes are those of the reference",))


_READERS: dict[tuple[str, str], Callable[[Path, ImportOptions], ImportedTable]] = {
    **{(role, "table"): _read_named(role) for role in ROLES},
    **{("reference", name): _read_reference for name in ("tum", "kf_gins")},
    **{("gnss", name): _read_fixes for name in ("tum", "nmea")},
    ("imu", "kf_gins"): _read_kf_gins_imu,
    ("gnss", "kf_gins"): _read_kf_gins_fixes,
    ("gnss", "rtklib"): _read_rtklib,
    ("imu", "euroc"): _read_euroc_imu,
    ("reference", "euroc"): _read_euroc_reference,
    ("imu", "kitti"): _read_kitti_imu,
    ("gnss", "kitti"): _read_kitti_fixes,
    ("reference", "kitti"): _read_kitti_reference,
}


def write_log(folder: Path, tables: Mapping[str, ImportedTable]) -> None:
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
