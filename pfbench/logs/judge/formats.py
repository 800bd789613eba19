"""Files of trajectories and of own logs: patterns with sequence and run, and the readers of each format."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.named_tables import read_named_table
from pfbench.logs.judge.nmea import read_nmea_trajectory
from pfbench.logs.judge.text_formats import (
    KF_GINS_FIXES,
    KF_GINS_IMU,
    KF_GINS_SD,
    find_pose_columns,
    read_euroc_imu,
    read_euroc_reference,
    read_head,
    read_kf_gins_fixes,
    read_kf_gins_imu,
    read_kf_gins_trajectory,
    read_kitti,
    read_rtklib,
    read_tum_trajectory,
    to_numbers,
)
from pfbench.logs.judge.trajectory_table import (
    GEODETIC,
    LOCAL,
    POSITION_SD,
    TRAJECTORY,
    TrajectoryTable,
    check_trajectory,
)
from pfbench.results.store import DamagedResultError, JobResult, read_result
from pfbench.stats.error_measures import Array

# --------------------------------------------------------------------------------------------------
# Reader of results of pfbench: the estimate is the track of the truth plus the error.

_AXES = ("position_E", "position_N", "position_U")


def read_result_trajectories(file: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read the runs of a job whose scenario states the track of the truth."""
    try:
        result = read_result(file)
    except DamagedResultError:
        raise ValueError(
            f"{file.name} must be a result of pfbench, got a file that is damaged or of another format. "
            "Run the job again."
        ) from None
    names = list(result.meta["state"]["names"])
    require(
        "track" in result.data and set(_AXES) <= set(names),
        file.name,
        f"have the track of the truth and the states {', '.join(_AXES)}",
        ", ".join(names[:9]),
        "Use a result of a recorded or simulated flight.",
    )
    places = [names.index(name) for name in _AXES]
    return [_run_table(file, result, places, run) for run in range(len(result.data["lost"]))]


def _run_table(file: Path, result: JobResult, places: list[int], run: int) -> TrajectoryTable:
    data = result.data
    error, sd = (data[name][run][:, places].astype(np.float64) for name in ("error", "sd"))
    track = data["track"][run].astype(np.float64)
    east, north, up = (track + error).T
    values = dict(zip(LOCAL, (north, east, -up), strict=True))
    values |= dict(zip(POSITION_SD, sd[:, [1, 0, 2]].T, strict=True))
    number = int(data["run"][run]) if "run" in data else int(result.meta.get("first_run", 0)) + run
    time = data["time"].astype(np.float64)
    used = np.isfinite(np.stack(list(values.values()))).all(axis=0)
    notes = (
        (f"{int((~used).sum())} steps without a finite estimate or truth",)
        if not used.all()
        else ()
    )
    lines, truth = np.arange(1, len(time) + 1), track[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    table = TrajectoryTable(file.name, time, values, lines, notes, number, truth=truth)
    return table.keep_rows(used)


# --------------------------------------------------------------------------------------------------
# Files of trajectories: patterns with sequence and run, and the readers of each format by what is read.

ONE = "recording"  # name of the sequence of a pattern without {sequence}
_FIELDS = {"sequence": r"(?P<sequence>[^/]+?)", "run": r"(?P<run>[^/]+?)"}
_READERS: dict[str, dict[str, Callable[[Path, SourceOptions], list[TrajectoryTable]]]] = {
    TRAJECTORY: {
        "table": partial(read_named_table, TRAJECTORY), "tum": read_tum_trajectory, "kf_gins": read_kf_gins_trajectory,
        "nmea": read_nmea_trajectory, "rtklib": read_rtklib, "result": read_result_trajectories,
    },
    "imu": {
        "table": partial(read_named_table, "imu"), "kf_gins": read_kf_gins_imu, "euroc": read_euroc_imu,
        "kitti": read_kitti,
    },
    "gnss": {
        "table": partial(read_named_table, "gnss"), "tum": read_tum_trajectory, "kf_gins": read_kf_gins_fixes,
        "nmea": read_nmea_trajectory, "rtklib": read_rtklib, "kitti": read_kitti,
    },
    "reference": {
        "table": partial(read_named_table, "reference"), "tum": read_tum_trajectory,
        "kf_gins": read_kf_gins_trajectory, "euroc": read_euroc_reference, "kitti": read_kitti,
    },
}  # fmt: skip


class TrajectoryFile(NamedTuple):
    """File that a pattern names.

    Attributes:
        path: File.
        sequence: Name of the sequence.
        run: Name of the run.
    """

    path: Path
    sequence: str
    run: str


def list_trajectory_files(pattern: str) -> list[TrajectoryFile]:
    """List the files of a pattern such as out/{sequence}_{run}.csv.

    Returns files in order of sequence and run.
    """
    path = Path(pattern)
    if "{" not in pattern:
        require(path.is_file(), pattern, "be a file", "none", "Check the path.")
        return [TrajectoryFile(path, ONE, "")]
    fixed = path
    while "{" in str(fixed):
        fixed = fixed.parent
    expression = re.escape(path.as_posix())
    for name, group in _FIELDS.items():
        expression = expression.replace(re.escape(f"{{{name}}}"), group, 1)
        expression = expression.replace(re.escape(f"{{{name}}}"), f"(?P={name})")
    depth = "/".join("*" for _ in path.relative_to(fixed).parts)
    files = []
    for candidate in sorted(fixed.glob(depth)):
        match = re.fullmatch(expression, candidate.as_posix())
        if match and candidate.is_file():
            values = match.groupdict()
            files.append(
                TrajectoryFile(candidate, values.get("sequence", ONE), values.get("run", ""))
            )
    require(
        files,
        pattern,
        "match a file",
        "none",
        "Write {sequence} and {run} for the parts that differ.",
    )
    return sorted(files, key=lambda file: (file.sequence, file.run))


def read_trajectories(path: Path, options: SourceOptions) -> list[TrajectoryTable]:
    """Read and check the trajectories of a file; the clock is shifted last."""
    tables = (check_trajectory(table) for table in read_file(path, options))
    return [replace(table, time=table.time + options.shift) for table in tables]


def read_file(path: Path, options: SourceOptions, role: str = TRAJECTORY) -> list[TrajectoryTable]:
    """Read a file as trajectories or as a table of an own log; columns are multiplied by their factors."""
    kind = options.format or find_format(path, options, role)
    readers = _READERS[role]
    require(
        kind in readers,
        role,
        "be of a format with such data",
        f"{kind} for {path.name}",
        f"Formats of {role}: {', '.join(sorted(readers))}.",
    )
    for name, belongs, owner, remedy in (
        ("sd", kind == "kf_gins", "text file of KF-GINS", "Remove the option, and add columns sd_pn, sd_pe and sd_pd to the file."),
        ("frame", kind == "tum", "TUM file", _FIXED_AXES), ("columns", kind == "table", "table with named columns", _FIXED_AXES),
    ):  # fmt: skip
        require(
            belongs or not getattr(options, name),
            name,
            f"belong to a {owner}",
            f"{Path(options.sd).name} for {path.name}" if name == "sd" else path.name,
            remedy,
        )
    return [_scale_columns(table, options.factors) for table in readers[kind](path, options)]


def _scale_columns(table: TrajectoryTable, factors: Mapping[str, float]) -> TrajectoryTable:
    """Multiply columns by the factors of the option scale."""
    absent = [name for name in factors if name != "t" and name not in table.values]
    require(
        not absent,
        "NAME.scale",
        f"be factors of columns of {table.file}",
        ", ".join(absent),
        f"Choose from t, {', '.join(table.values)}.",
    )
    return table.scale_columns(factors)


# --------------------------------------------------------------------------------------------------
# Format of a file: its content decides, and its suffix only where the content does not.

_FIXED_AXES = "Remove the option: the axes of all other formats are North, East, Down or latitude, longitude, height."
_PARQUET = b"PAR1"
_SIGNATURES = {_PARQUET: "table", b"PK\x03\x04": "result"}
_BINARY = {  # first bytes of files that other programs convert
    b"\xb5b": "UBX of u-blox", b"ULog": "ULog of PX4", b"\xa3\x95": "a log of ArduPilot", b"#ROSBAG": "a bag of ROS 1",
    b"SQLite format 3": "a bag of ROS 2 or another database", b"\x89MCAP": "a bag of ROS 2", b"\xaaD": "messages of NovAtel",
    b"\x1f\x8b": "a compressed file",
}  # fmt: skip
_SUFFIXES = {
    ".csv": "table",
    ".parquet": "table",
    ".tum": "tum",
    ".nav": "kf_gins",
    ".nmea": "nmea",
    ".npz": "result",
}
_SENTENCE = re.compile(rb"^[^\n$]{0,80}\$[A-Z][A-Z0-9]{2,9},", re.MULTILINE)
_RTKLIB = re.compile(
    rb"^\d{4}/\d\d/\d\d +\d\d:|^% *(program *: *(RTK|rnx2rtkp)|(GPST|UTC|JST) .*(latitude|ecef|baseline))",
    re.MULTILINE,
)
_EUROC = re.compile(rb"^(\xef\xbb\xbf)?#? ?timestamp ?\[ns\]", re.IGNORECASE)
_HEAD = 1 << 16  # bytes


def find_format(file: Path, options: SourceOptions, role: str = TRAJECTORY) -> str:
    """Find the format of a file."""
    if file.is_dir():
        return "kitti"
    with file.open("rb") as content:
        head = content.read(_HEAD)
    require(
        head[:4] != _PARQUET or file.suffix == ".parquet",
        file.name,
        "have the suffix .parquet",
        "a Parquet file",
        f"Rename it to {file.with_suffix('.parquet').name}.",
    )
    kind = next((name for first, name in _BINARY.items() if head.startswith(first)), "")
    require(
        not kind,
        file.name,
        "be a text, a .parquet or a result of pfbench",
        f"{kind}, by its first bytes",
        "Convert it with a program of its maker to CSV, NMEA or RTKLIB .pos, or unpack it.",
    )
    if head[:4] in _SIGNATURES:
        return _SIGNATURES[head[:4]]
    if role != TRAJECTORY and options.columns:
        return "table"
    if role != TRAJECTORY and _EUROC.search(head):
        return "euroc"
    if _SENTENCE.search(head):
        return "nmea"
    if _RTKLIB.search(head):
        return "rtklib"
    names, rows = read_head(file)
    widths = {"imu": (KF_GINS_IMU,), "gnss": KF_GINS_FIXES}.get(role, ())
    if not names and to_numbers(rows).shape[1] in widths:
        return "kf_gins"
    return (
        "table"
        if role == "imu"
        else _find_text_format(file, bool(options.columns or role != TRAJECTORY))
    )


def _find_text_format(file: Path, has_names: bool) -> str:
    """Return the format of a text with columns."""
    names, rows = read_head(file)
    by_suffix = _SUFFIXES.get(file.suffix.lower(), "")
    numbers = to_numbers(rows)
    is_table = "t" in names and any(set(columns) <= set(names) for columns in (LOCAL, GEODETIC))
    if names and (has_names or is_table):
        return "table"
    if find_pose_columns(names, rows):
        return "tum"
    if _is_kf_gins(numbers):
        return "kf_gins"
    require(
        not _is_kitti(numbers),
        file.name,
        "state times",
        "poses of KITTI, 12 numbers without a time",
        "Write a .csv with t from their times.txt, and pn, pe, pd from the position, columns 4, 8 and 12 of a pose.",
    )
    if by_suffix or names:
        return by_suffix or "table"
    raise _describe_unknown(file, len(rows[0]) if rows else 0)


def _describe_unknown(file: Path, width: int) -> ValueError:
    """Return the error for a text of no known format."""
    remedy = (
        "Insert a line with names, t,pn,pe,pd,..., or set NAME.format=table, tum, kf_gins or nmea."
    )
    if width == KF_GINS_SD:
        remedy = "Use the navigation result of KF-GINS, and its deviations as NAME.sd."
    return ValueError(
        f"{file.name} must be a table with names of columns, a TUM file (8 numbers in a line, the last four a "
        f"quaternion), a result of KF-GINS (11 numbers from week and second on) or NMEA, got {width} fields in "
        f"the first row. {remedy}"
    )


def _is_kf_gins(numbers: Array) -> bool:
    """Return whether rows are week, second, latitude, longitude, height and six further numbers."""
    if numbers.shape[1] != 11:
        return False
    week, second, lat, lon = numbers[:, :4].T
    is_week = (week == week.round()) & (week >= 0) & (week < 10_000) & (np.ptp(week) <= 1)
    is_place = (second >= 0) & (np.abs(lat) <= 90) & (np.abs(lon) <= 360)
    return bool((is_week & is_place).all())


def _is_kitti(numbers: Array) -> bool:
    """Return whether rows are 3 x 4 matrices of a rotation and a position."""
    if numbers.shape[1] != 12:
        return False
    rotation = numbers.reshape(-1, 3, 4)[:, :, :3]
    product = rotation @ rotation.transpose(0, 2, 1)
    return bool((np.abs(product - np.eye(3)) < 0.01).all())
