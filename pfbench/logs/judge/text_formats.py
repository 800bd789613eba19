"""Readers of text with columns of a fixed order: TUM, KF-GINS, RTKLIB, EuRoC and KITTI."""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from pfbench.core.parameter_checks import require
from pfbench.files.limits import check_columns, read_text
from pfbench.files.table_file import describe_cut, is_number_text, split_lines
from pfbench.logs.doctor.axis_orders import ENU_TO_NED, FLU_TO_FRD
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    ATTITUDE_SD,
    GEODETIC,
    IMU_COLUMNS,
    LOCAL,
    POSITION_SD,
    VELOCITY_COLUMNS,
    VELOCITY_SD,
    TrajectoryTable,
    euler_angles,
)
from pfbench.logs.units import WEEK
from pfbench.stats.error_measures import Array

_TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_KF_GINS_COLUMNS = ("week", "t", *GEODETIC, *VELOCITY_COLUMNS, "roll", "pitch", "yaw")
_EUROC_COLUMNS = ("t", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z", "v_x", "v_y", "v_z")
KF_GINS_SD = 22  # columns of the file of standard deviations: time, 9 of navigation, 12 of sensors
KF_GINS_IMU, KF_GINS_FIXES = 7, (7, 10, 13)  # columns; fixes with deviations, and with velocities
_EUROC_WITH_BIASES, _KITTI_PACKET = 17, 30  # columns
_COMMENTS, _BOM = ("#", "%"), "\ufeff"
_HEAD_LINES = 5000  # with the first rows among them
_HEAD_BYTES = 2**20  # with all comments before the first row
_UNIT = re.compile(r"[\[(][^\[(\])]*[\])]")  # as in time [s]
_QUATERNION = re.compile(r"(?:.*\W)?(?:q|quat|quaternion|orientation|rot|rotation)\w*?_?([wxyz])")
_GPS_DATE = re.compile(r"(\d{4})/(\d\d)/(\d\d)")


def read_tum_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read lines `t x y z qx qy qz qw` (s, m, rotation from body to world).

    With frame=enu, the world is East, North, Up and the body forward, left, up [REP 103]. With
    frame=ned they are North, East, Down and forward, right, down. A line of names can state another
    order of the quaternion and further columns, and an index can precede the time.
    """
    require(
        options.frame,
        "NAME.frame",
        f"be ned or enu for {file.name}",
        "none: a TUM file does not state its axes",
        "Set NAME.frame=enu if z points up.",
    )
    names, rows = read_head(file)
    places = find_pose_columns(names, rows) or list(range(len(_TUM_COLUMNS)))
    width = len(names) or (to_numbers(rows).shape[1] if places[0] else len(places))
    numbers, lines, notes = _read_numbers(file, _TUM_COLUMNS, (width,), places)
    length = np.linalg.norm(numbers[:, 4:], axis=1)
    row = int((np.abs(length - 1) > 0.01).argmax())
    require(
        abs(length[row] - 1) <= 0.01, f"{file.name}: line {lines[row]}, columns qx ... qw", "be a quaternion of length 1",
        f"length {length[row]:.3g}",
        f"Check the order of the columns: {' '.join(_TUM_COLUMNS)}." if length[row] else "Remove the lines without an attitude.",
    )  # fmt: skip
    if width > len(_TUM_COLUMNS):
        used = ", ".join(str(index + 1) for index in places)
        notes = (*notes, f"columns {used} of {width} are read as {' '.join(_TUM_COLUMNS)}")
    position, rotation = numbers[:, 1:4], Rotation.from_quat(numbers[:, 4:]).as_matrix()
    if options.frame == "enu":
        position, rotation = position @ ENU_TO_NED.T, ENU_TO_NED @ rotation @ FLU_TO_FRD
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


# --------------------------------------------------------------------------------------------------
# KF-GINS: navigation results with their deviations, increments of the IMU, and fixes.


def read_kf_gins_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
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
    if options.sd:
        sd, names = Path(options.sd), ("t", *(f"column {k}" for k in range(2, KF_GINS_SD + 1)))
        require(sd.is_file(), "sd", "be a file", f"{sd} for {file.name}", "Check the path.")
        deviations, _, _ = _read_numbers(sd, names)
        require(
            len(deviations) == len(time) and (np.abs(deviations[:, 0] - second) <= 1e-4).all(),
            sd.name,
            f"have the times of {file.name}",
            f"{len(deviations)} rows from {deviations[0, 0]} s for {len(time)} rows from {second[0]} s",
            "Use files of one run.",
        )
        values |= _by_name(POSITION_SD, deviations[:, 1:4])
        values |= _by_name(VELOCITY_SD, deviations[:, 4:7])
        values |= _by_name(ATTITUDE_SD, np.radians(deviations[:, 7:10]))
    return [TrajectoryTable(file.name, time, values, lines, notes, angle_unit="deg")]


def read_kf_gins_imu(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read increments: second, three angles, rad, and three velocities, m/s, forward, right, down."""
    numbers, lines, notes = _read_numbers(file, ("t", "angle increments", "velocity increments"), (KF_GINS_IMU,))  # fmt: skip
    time = numbers[:, 0]
    step = np.diff(time, prepend=2.0 * time[0] - time[1])[:, None]
    row = int((step <= 0.0).argmax())
    require(step[row, 0] > 0.0, f"{file.name}: line {lines[row]}", "have a later time than before", time[row], "Sort the lines.")  # fmt: skip
    values = _by_name(IMU_COLUMNS, np.hstack([numbers[:, 4:7], numbers[:, 1:4]]) / step)
    notes = (*notes, "increments divided by their intervals, at their middles")
    return [TrajectoryTable(file.name, time - 0.5 * step[:, 0], values, lines, notes)]


def read_kf_gins_fixes(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read fixes: second, latitude, longitude, height, three deviations, and velocities in files of 13 columns."""
    names = ("t", "latitude", "longitude", "height", "deviations")
    numbers, lines, notes = _read_numbers(file, names, KF_GINS_FIXES)
    values = _by_name(GEODETIC, numbers[:, 1:4])
    if numbers.shape[1] == KF_GINS_FIXES[-1]:
        values |= _by_name(VELOCITY_COLUMNS, numbers[:, 7:10])
    return [TrajectoryTable(file.name, numbers[:, 0], values, lines, notes)]


def read_rtklib(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read a solution of RTKLIB with latitude, longitude and height; t is the second of the GPS week of the first row."""
    texts = split_lines(read_text(file).decode("utf-8-sig", "replace"))
    heads = [text for text in texts if text.startswith("%")]
    require(
        not heads or any("latitude(deg)" in head for head in heads),
        file.name,
        "have latitude, longitude and height",
        "other positions",
        "Set the output of RTKLIB to lat/lon/height in degrees (out-solformat = llh, out-degform = deg).",
    )
    rows = [(number, text.split()) for number, text in enumerate(texts, 1) if text.strip() and not text.startswith("%")]  # fmt: skip
    for number, row in rows:
        require(
            len(row) >= 6 and all(map(is_number_text, row[2:6])),
            f"{file.name}: line {number}",
            "have time, latitude, longitude, height and Q",
            repr(" ".join(row)[:80]),
            "Repair or remove this line.",
        )
    stamps = pd.to_datetime([f"{r[0]} {r[1]}" for _, r in rows if _GPS_DATE.match(r[0])])
    seconds = (stamps - pd.Timestamp("1980-01-06")).total_seconds().to_numpy(float)
    if len(stamps) < len(rows):
        seconds = np.array([float(row[0]) * WEEK + float(row[1]) for _, row in rows])
    week = np.floor(seconds[0] / WEEK) if len(rows) else 0.0
    numbers = np.array([row[2:6] for _, row in rows], float).reshape(-1, 4)
    notes = (f"t is the second of GPS week {int(week)}", "the column fix has the codes of RTKLIB")
    lines = np.array([number for number, _ in rows])
    return [TrajectoryTable(file.name, seconds - week * WEEK, _by_name((*GEODETIC, "fix"), numbers), lines, notes)]  # fmt: skip


def read_euroc_imu(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read rate and force. The axes stay as recorded, and the inspection names the mounting."""
    names = ("t", "w_x", "w_y", "w_z", "a_x", "a_y", "a_z")
    numbers, lines, notes = _read_numbers(file, names)
    values = _by_name(IMU_COLUMNS, numbers[:, [4, 5, 6, 1, 2, 3]])
    notes = (*notes, "axes of the sensor are as recorded")
    return [TrajectoryTable(file.name, 1e-9 * numbers[:, 0], values, lines, notes)]


def read_euroc_reference(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read position, quaternion (w, x, y, z) and velocity in a frame with z up, and a body as recorded."""
    widths = (len(_EUROC_COLUMNS), _EUROC_WITH_BIASES)
    numbers, lines, notes = _read_numbers(file, _EUROC_COLUMNS, widths)
    rotation = ENU_TO_NED @ Rotation.from_quat(numbers[:, [5, 6, 7, 4]]).as_matrix()
    values = (
        _by_name(LOCAL, numbers[:, 1:4] @ ENU_TO_NED.T)
        | _by_name(VELOCITY_COLUMNS, numbers[:, 8:11] @ ENU_TO_NED.T)
        | _by_name(ATTITUDE_COLUMNS, euler_angles(rotation))
    )
    notes = (*notes, "x, y, z of the frame are taken as East, North, Up")
    return [TrajectoryTable(file.name, 1e-9 * numbers[:, 0], values, lines, notes)]


def _read_kitti(path: Path) -> tuple[Array, Array]:
    """Read times, s, [n], and packets, [n, 30], of a folder oxts with timestamps.txt and data/."""
    folder = path / "oxts" if (path / "oxts").is_dir() else path
    stamps, files = folder / "timestamps.txt", sorted((folder / "data").glob("*.txt"))
    remedy = "Use the folder of a KITTI drive."
    require(stamps.is_file() and files, path, "contain oxts/timestamps.txt and oxts/data/*.txt", "none", remedy)  # fmt: skip
    times = pd.to_datetime(stamps.read_text().split("\n"), errors="coerce").dropna()
    require(
        len(times) == len(files),
        stamps,
        f"have a time for each of {len(files)} files",
        len(times),
        "Complete the folder.",
    )
    packets = [to_numbers(read_head(file)[1]) for file in files]
    require(
        all(packet.shape == (1, _KITTI_PACKET) for packet in packets),
        stamps.parent,
        f"have packets of {_KITTI_PACKET} numbers",
        "others",
        remedy,
    )
    return (times - times[0]).total_seconds().to_numpy(float), np.vstack(packets)


def read_kitti(path: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read the navigation system of a KITTI drive: acceleration with gravity, rate, place, velocity and attitude.

    Axes of the body are forward, left, up; yaw is counted from East, anticlockwise.
    """
    time, packets = _read_kitti(path)
    angles = np.stack([packets[:, 3], -packets[:, 4], np.pi / 2 - packets[:, 5]], -1)
    down = -np.gradient(packets[:, 2], time)
    values = (
        _by_name(
            IMU_COLUMNS, np.hstack([packets[:, 11:14] @ FLU_TO_FRD, packets[:, 17:20] @ FLU_TO_FRD])
        )
        | _by_name(GEODETIC, packets[:, :3])
        | _by_name(VELOCITY_COLUMNS, np.column_stack([packets[:, 6:8], down]))
        | _by_name(ATTITUDE_COLUMNS, angles)
    )
    notes = ("fixes and reference are those of the navigation system", "the vertical velocity is the change of the height")  # fmt: skip
    return [TrajectoryTable(path.name, time, values, np.arange(len(time)), notes)]


# --------------------------------------------------------------------------------------------------
# Rows of numbers.


def read_head(file: Path, rows: int = 20) -> tuple[list[str], list[list[str]]]:
    """Read names of columns and the first rows of a text; a line of names can be a comment."""
    heads: list[list[str]] = []
    fields: list[list[str]] = []
    with file.open("rb") as stream:  # the last line can be cut
        lines = split_lines(stream.read(_HEAD_BYTES).decode("utf-8-sig", "replace"))
    for line in map(str.strip, lines[:_HEAD_LINES]):
        if line.startswith(_COMMENTS) or (not fields and _has_no_number(line)):
            heads.append(split_line(_UNIT.sub("", line.lstrip("#% "))))
        elif line:
            fields.append(split_line(line))
        if len(fields) == rows:
            break
    width = len(fields[0]) if fields else 0
    check_columns(file, width)
    return next((names for names in reversed(heads) if len(names) == width), []), fields


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
    file: Path, names: tuple[str, ...], widths: tuple[int, ...] = (), places: Sequence[int] = ()
) -> tuple[Array, np.ndarray, tuple[str, ...]]:
    """Return numbers [T, K] of some columns or of all, their lines [T], and notes.

    The width of the first row is one of `widths`, or the number of the names. Comments start with # or %, and names
    can precede the first row. A last line without an end may lack digits, so it is dropped with a note.
    """
    rows, lines = array("d"), array("q")  # a list of numbers needs four times the memory
    notes: list[str] = []
    widths = widths or (len(names),)
    content = read_text(file).decode("utf-8", "replace").removeprefix(_BOM)
    *complete, last = split_lines(content)
    for number, line in enumerate(complete, 1):
        text, fields = line.strip(), split_line(line)
        if not text or text.startswith(_COMMENTS):
            continue
        if not (rows or notes) and len(fields) in widths and _has_no_number(text):
            notes = [f"line {number} is read as names of columns: {text[:80]}"]
            continue
        try:
            row = [float(fields[k]) for k in places or range(len(fields))]
        except (ValueError, IndexError):
            row = []
        if not row or len(fields) not in widths:
            raise ValueError(
                f"{file.name}: line {number} must have {' or '.join(map(str, widths))} numbers ({' '.join(names[:11])}), "
                f"got {line[:80]!r}. Repair or remove this line."
            )
        widths = (len(fields),)
        rows.extend(row)
        lines.append(number)
    notes += [describe_cut(file, len(complete) + 1)] if last.strip() else []
    numbers = np.array(rows).reshape(len(lines), len(places) or widths[0])
    return numbers, np.array(lines), tuple(notes)
