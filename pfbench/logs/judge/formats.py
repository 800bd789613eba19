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
    ROLES,
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


ONE = "recording"  # name of the sequence of a pattern without {sequence}
_FIELDS = {"sequence": r"(?P<sequence>[^/]+?)", "run": r"(?P<run>[^/]+?)"}


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
    of_role = (name for name, item in FILE_FORMATS.items() if role in item.readers)
    require(
        role in FILE_FORMATS[kind].readers,
        role,
        "be of a format with such data",
        f"{kind} for {path.name}",
        f"Formats of {role}: {', '.join(sorted(of_role))}.",
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
    return [
        _scale_columns(table, options.factors)
        for table in FILE_FORMATS[kind].readers[role](path, options)
    ]


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
_FOREIGN = {  # first bytes of files that other programs convert
    b"\xb5b": "UBX of u-blox", b"ULog": "ULog of PX4", b"\xa3\x95": "a log of ArduPilot", b"#ROSBAG": "a bag of ROS 1",
    b"SQLite format 3": "a bag of ROS 2 or another database", b"\x89MCAP": "a bag of ROS 2", b"\xaaD": "messages of NovAtel",
    b"#BESTPOS": "messages of NovAtel", b"#INSPVA": "messages of NovAtel", b"<?xml": "XML, as GPX or KML", b"\x1f\x8b": "a compressed file",
}  # fmt: skip
_WIDE = (b"\xff\xfe", b"\xfe\xff")  # first bytes of texts of two bytes a letter
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
_WIDTHS = {"imu": (KF_GINS_IMU,), "gnss": KF_GINS_FIXES}  # of KF-GINS without names


class FileStart(NamedTuple):
    """Start of a file.

    Attributes:
        content: First bytes.
        names: Names of columns, empty without such a line.
        rows: Fields of the first rows.
        role: What is read: a trajectory, or a table of an own log.
        has_columns: Whether the options name columns.
    """

    content: bytes
    names: list[str]
    rows: list[list[str]]
    role: str
    has_columns: bool

    @property
    def numbers(self) -> Array:
        """Numbers of the first rows, [T, K]."""
        return to_numbers(self.rows)


class FileFormat(NamedTuple):
    """Format of files.

    Attributes:
        readers: Readers by what is read.
        suffix: Suffix that decides where the content does not; empty for none.
        is_shown: Whether the start of a text shows the format.
    """

    readers: Mapping[str, Callable[[Path, SourceOptions], list[TrajectoryTable]]]
    suffix: str
    is_shown: Callable[[FileStart], object]


def _is_named(start: FileStart) -> bool:
    """Return whether the columns of a table have names, as those of an own log, of the options or of a trajectory."""
    is_table = "t" in start.names and any(set(group) <= set(start.names) for group in (LOCAL, GEODETIC))  # fmt: skip
    return bool(start.names) and (start.has_columns or start.role != TRAJECTORY or is_table)


def _is_kf_gins(start: FileStart) -> bool:
    """Return whether rows are week, second, latitude, longitude, height and six further numbers, or of a table of KF-GINS."""
    numbers = start.numbers
    if numbers.shape[1] != 11:
        return not start.names and numbers.shape[1] in _WIDTHS.get(start.role, ())
    week, second, lat, lon = numbers[:, :4].T
    is_week = (week == week.round()) & (week >= 0) & (week < 10_000) & (np.ptp(week) <= 1)
    is_place = (second >= 0) & (np.abs(lat) <= 90) & (np.abs(lon) <= 360)
    return bool((is_week & is_place).all())


# one table of the formats, in the order in which a content is compared with them
FILE_FORMATS: dict[str, FileFormat] = {
    "result": FileFormat({TRAJECTORY: read_result_trajectories}, ".npz", lambda start: False),
    "kitti": FileFormat(dict.fromkeys(("imu", "gnss", "reference"), read_kitti), "", lambda start: False),
    "euroc": FileFormat(
        {"imu": read_euroc_imu, "reference": read_euroc_reference}, "",
        lambda start: start.role != TRAJECTORY and not start.has_columns and _EUROC.search(start.content),
    ),
    "nmea": FileFormat(
        dict.fromkeys((TRAJECTORY, "gnss"), read_nmea_trajectory), ".nmea", lambda start: _SENTENCE.search(start.content)
    ),
    "rtklib": FileFormat(dict.fromkeys((TRAJECTORY, "gnss"), read_rtklib), "", lambda start: _RTKLIB.search(start.content)),
    "table": FileFormat({role: partial(read_named_table, role) for role in ROLES}, ".csv", _is_named),
    "tum": FileFormat(
        dict.fromkeys((TRAJECTORY, "gnss", "reference"), read_tum_trajectory), ".tum",
        lambda start: start.role != "imu" and find_pose_columns(start.names, start.rows),
    ),
    "kf_gins": FileFormat(
        {
            TRAJECTORY: read_kf_gins_trajectory, "imu": read_kf_gins_imu, "gnss": read_kf_gins_fixes,
            "reference": read_kf_gins_trajectory,
        }, ".nav", _is_kf_gins,
    ),
}  # fmt: skip


def find_format(file: Path, options: SourceOptions, role: str = TRAJECTORY) -> str:
    """Find the format of a file by its content, and by its suffix where the content does not show it."""
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
    if head[:4] in _SIGNATURES:
        return _SIGNATURES[head[:4]]
    unknown = "bytes of no known kind" if b"\0" in head and not head.startswith(_WIDE) else ""
    kind = next((name for first, name in _FOREIGN.items() if head.startswith(first)), unknown)
    require(
        not kind or _SENTENCE.search(head),  # receivers write NMEA among other messages
        file.name,
        "be a text, a .parquet or a result of pfbench",
        f"{kind}, by its first bytes",
        "Convert it with a program of its maker to CSV, NMEA or RTKLIB .pos, or unpack it.",
    )
    start = FileStart(head, *read_head(file), role, bool(options.columns))
    by_content = next((name for name, item in FILE_FORMATS.items() if item.is_shown(start)), "")
    require(
        by_content or not _is_kitti(start.numbers),
        file.name,
        "state times",
        "poses of KITTI, 12 numbers without a time",
        "Write a .csv with t from their times.txt, and pn, pe, pd from the position, columns 4, 8 and 12 of a pose.",
    )
    suffixes = {item.suffix: name for name, item in FILE_FORMATS.items() if item.suffix}
    kind = by_content or suffixes.get(file.suffix.lower(), "table" if start.names or role == "imu" else "")  # fmt: skip
    width = len(start.rows[0]) if start.rows else 0
    remedy = (
        "Insert a line with names, t,pn,pe,pd,..., or set NAME.format=table, tum, kf_gins or nmea."
    )
    if width == KF_GINS_SD:
        remedy = "Use the navigation result of KF-GINS, and its deviations as NAME.sd."
    require(
        kind,
        file.name,
        "be a table with names of columns, a TUM file (8 numbers in a line, the last four a quaternion), a result of KF-GINS "
        "(11 numbers from week and second on) or NMEA",
        f"{width} fields in the first row",
        remedy,
    )
    return kind


def _is_kitti(numbers: Array) -> bool:
    """Return whether rows are 3 x 4 matrices of a rotation and a position."""
    if numbers.shape[1] != 12:
        return False
    rotation = numbers.reshape(-1, 3, 4)[:, :, :3]
    product = rotation @ rotation.transpose(0, 2, 1)
    return bool((np.abs(product - np.eye(3)) < 0.01).all())
