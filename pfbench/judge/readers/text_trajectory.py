"""Readers of text without column names: .tum and KF-GINS."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pfbench.files.table_file import describe_cut
from pfbench.judge.judge_options import SourceOptions
from pfbench.judge.readers.local_frame import euler_angles, rotation_from_quaternion
from pfbench.judge.readers.trajectory_table import (
    ATTITUDE_COLUMNS,
    ATTITUDE_SD,
    GEODETIC,
    LOCAL,
    POSITION_SD,
    VELOCITY_COLUMNS,
    VELOCITY_SD,
    TrajectoryTable,
)
from pfbench.results.error_measures import Array

_TUM_COLUMNS = ("t", "x", "y", "z", "qx", "qy", "qz", "qw")
_KF_GINS_COLUMNS = ("week", "t", *GEODETIC, *VELOCITY_COLUMNS, "roll", "pitch", "yaw")
_KF_GINS_SD = 22  # columns of the file of standard deviations: time, 9 of navigation, 12 of sensors
_TO_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # from East, North, Up
_TO_FRD = np.diag([1.0, -1.0, -1.0])  # a body with forward, left, up


def read_tum_trajectory(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read lines `t x y z qx qy qz qw` (s, m, rotation from body to world).

    With frame=enu, the world is East, North, Up and the body forward, left, up [REP 103]. With
    frame=ned they are North, East, Down and forward, right, down.

    Args:
        file: File.
        options: Options with the frame.

    Returns:
        One table.

    Raises:
        ValueError: If the frame is not stated, a line has other columns, or a quaternion is not of
            unit length.
    """
    if options.frame not in ("ned", "enu"):
        raise ValueError(
            f"NAME.frame must be ned or enu for {file.name}, got {options.frame or 'none'}: a .tum file "
            "does not state its axes. Set NAME.frame=enu if z points up."
        )
    numbers, lines, notes = _read_numbers(file, _TUM_COLUMNS)
    length = np.linalg.norm(numbers[:, 4:], axis=1)
    bad = np.abs(length - 1) > 0.01
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"{file.name}: line {lines[row]}, columns qx ... qw must be a quaternion of length 1, "
            f"got length {length[row]:.3g}. Check the order of the columns: {' '.join(_TUM_COLUMNS)}."
        )
    position, rotation = numbers[:, 1:4], rotation_from_quaternion(numbers[:, 4:])
    if options.frame == "enu":
        position, rotation = position @ _TO_NED.T, _TO_NED @ rotation @ _TO_FRD
    values = _by_name(LOCAL, position) | _by_name(ATTITUDE_COLUMNS, euler_angles(rotation))
    return [TrajectoryTable(file.name, numbers[:, 0], values, lines, notes)]


def read_kf_gins_trajectory(
    file: Path, options: SourceOptions, sd: Path | None = None
) -> list[TrajectoryTable]:
    """Read a navigation result or truth of KF-GINS: week, second, position, velocity, attitude.

    The units are deg, deg, m, m/s North, East, Down, and deg for roll, pitch and yaw.

    Args:
        file: File with 11 columns.
        options: Options.
        sd: File of standard deviations with 22 columns (m, m/s, deg), or None.

    Returns:
        One table; the time is the second of the week.

    Raises:
        ValueError: If a line has other columns, or the times of both files differ.
    """
    numbers, lines, notes = _read_numbers(file, _KF_GINS_COLUMNS)
    values = (
        _by_name(GEODETIC, numbers[:, 2:5])
        | _by_name(VELOCITY_COLUMNS, numbers[:, 5:8])
        | _by_name(ATTITUDE_COLUMNS, np.radians(numbers[:, 8:11]))
    )
    time = numbers[:, 1]
    if sd is not None:
        names = ("t", *(f"column {k}" for k in range(2, _KF_GINS_SD + 1)))
        if not sd.is_file():
            raise ValueError(f"sd must be a file, got {sd} for {file.name}. Check the path.")
        deviations, _, _ = _read_numbers(sd, names)
        if deviations.shape[0] != len(time) or (np.abs(deviations[:, 0] - time) > 1e-4).any():
            raise ValueError(
                f"{sd.name} must have the times of {file.name}, got {len(deviations)} rows from "
                f"{deviations[0, 0]} s for {len(time)} rows from {time[0]} s. Use files of one run."
            )
        values |= _by_name(POSITION_SD, deviations[:, 1:4])
        values |= _by_name(VELOCITY_SD, deviations[:, 4:7])
        values |= _by_name(ATTITUDE_SD, np.radians(deviations[:, 7:10]))
    return [TrajectoryTable(file.name, time, values, lines, notes, angle_unit="deg")]


def count_fields(file: Path) -> int:
    """Return the number of fields of the first line with numbers; 0 without one."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if line.strip() and not line.lstrip().startswith(("#", "%")):
                return len(line.split())
    return 0


def _by_name(names: tuple[str, ...], columns: Array) -> dict[str, Array]:
    return {name: columns[:, k] for k, name in enumerate(names)}


def _read_numbers(file: Path, names: tuple[str, ...]) -> tuple[Array, np.ndarray, tuple[str, ...]]:
    """Return numbers [T, K], their lines [T], and notes; comments start with # or %.

    A last line without an end may lack digits, so it is dropped with a note.
    """
    rows, lines = [], []
    *complete, last = file.read_text(encoding="utf-8", errors="replace").split("\n")
    for number, line in enumerate(complete, 1):
        fields = line.split()
        if not fields or fields[0].startswith(("#", "%")):
            continue
        try:
            row = [float(text) for text in fields]
        except ValueError:
            row = []
        if len(row) != len(names):
            raise ValueError(
                f"{file.name}: line {number} must have {len(names)} numbers ({' '.join(names[:11])}), "
                f"got {line[:80]!r}. Repair or remove this line."
            )
        rows.append(row)
        lines.append(number)
    notes = (describe_cut(file, len(complete) + 1),) if last.strip() else ()
    numbers = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return numbers, np.array(lines), notes
