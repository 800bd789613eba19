"""Files of trajectories: patterns with sequence and run, and the reader of each format."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.nmea import read_nmea_trajectory
from pfbench.logs.judge.text_formats import (
    KF_GINS_SD,
    find_pose_columns,
    read_csv_trajectory,
    read_head,
    read_kf_gins_trajectory,
    read_tum_trajectory,
    to_numbers,
)
from pfbench.logs.judge.trajectory_table import (
    GEODETIC,
    LOCAL,
    POSITION_SD,
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
    if "track" not in result.data or not set(_AXES) <= set(names):
        raise ValueError(
            f"{file.name} must have the track of the truth and the states {', '.join(_AXES)}, got "
            f"{', '.join(names[:9])}. Use a result of a recorded or simulated flight."
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
# Files of trajectories: patterns with sequence and run, and the reader of each format.

ONE = "recording"  # name of the sequence of a pattern without {sequence}
_FIELDS = {"sequence": r"(?P<sequence>[^/]+?)", "run": r"(?P<run>[^/]+?)"}
_READERS: dict[str, Callable[[Path, SourceOptions], list[TrajectoryTable]]] = {
    "table": read_csv_trajectory,
    "tum": read_tum_trajectory,
    "nmea": read_nmea_trajectory,
    "result": read_result_trajectories,
}


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
    if not files:
        raise ValueError(
            f"{pattern} must match a file, got none. Write {{sequence}} and {{run}} for the parts "
            "that differ."
        )
    return sorted(files, key=lambda file: (file.sequence, file.run))


def read_trajectories(
    path: Path, options: SourceOptions, sd: Path | None = None
) -> list[TrajectoryTable]:
    """Read and check a file; columns are multiplied by their factors, then the clock is shifted."""
    kind = options.format or find_format(path, bool(options.columns))
    if sd is not None and kind != "kf_gins":
        raise ValueError(
            f"sd must belong to a text file of KF-GINS, got {sd.name} for {path.name}. Remove the option, "
            "and add columns sd_pn, sd_pe and sd_pd to the file."
        )
    for name, is_read in (("frame", kind == "tum"), ("columns", kind == "table")):
        if getattr(options, name) and not is_read:
            formats = "TUM file" if name == "frame" else "table with named columns"
            raise ValueError(
                f"{name} must belong to a {formats}, got {path.name}. Remove the option: the axes of "
                "all other formats are North, East, Down or latitude, longitude, height."
            )
    if kind == "kf_gins":
        tables: Sequence[TrajectoryTable] = read_kf_gins_trajectory(path, options, sd)
    else:
        tables = _READERS[kind](path, options)
    return [
        replace(table, time=table.time + options.shift)
        for table in (check_trajectory(_scale_columns(t, options.scale)) for t in tables)
    ]


def _scale_columns(table: TrajectoryTable, factors: Mapping[str, float]) -> TrajectoryTable:
    """Multiply columns by the factors of the option scale."""
    for name in factors:
        if name != "t" and name not in table.values:
            raise ValueError(
                f"NAME.scale must be factors of columns of {table.file}, got {name}. Choose from t, "
                f"{', '.join(table.values)}."
            )
    return table.scale_columns(factors)


# --------------------------------------------------------------------------------------------------
# Format of a trajectory file: its content decides, and its suffix only where the content does not.

_PARQUET = b"PAR1"
_SIGNATURES = {_PARQUET: "table", b"PK\x03\x04": "result"}
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
_HEAD = 1 << 16  # bytes


def find_format(file: Path, has_names: bool) -> str:
    """Find the format of a file."""
    with file.open("rb") as content:
        head = content.read(_HEAD)
    if head[:4] == _PARQUET and file.suffix != ".parquet":
        raise ValueError(
            f"{file.name} must have the suffix .parquet, got a Parquet file. Rename it to "
            f"{file.with_suffix('.parquet').name}."
        )
    if head[:4] in _SIGNATURES:
        return _SIGNATURES[head[:4]]
    if _SENTENCE.search(head):
        return "nmea"
    if _RTKLIB.search(head):
        raise _rtklib_error(file, head)
    return _find_text_format(file, has_names)


def _find_text_format(file: Path, has_names: bool) -> str:
    """Return the format of a text with columns."""
    names, rows = read_head(file)
    by_suffix = _SUFFIXES.get(file.suffix.lower(), "")
    numbers = to_numbers(rows)
    width = len(rows[0]) if rows else 0
    if names and (has_names or _is_table(names)):
        return "table"
    if find_pose_columns(names, rows):
        return "tum"
    if _is_kf_gins(numbers):
        return "kf_gins"
    if _is_kitti(numbers):
        raise ValueError(
            f"{file.name} must state times, got poses of KITTI, 12 numbers without a time. Write a .csv "
            "with t from their times.txt, and pn, pe, pd from the position, columns 4, 8 and 12 of a pose."
        )
    if by_suffix:
        return by_suffix
    if names:
        return "table"
    remedy = (
        "Insert a line with names, t,pn,pe,pd,..., or set NAME.format=table, tum, kf_gins or nmea."
    )
    if width == KF_GINS_SD:
        remedy = "Use the navigation result of KF-GINS, and its deviations as NAME.sd."
    raise ValueError(
        f"{file.name} must be a table with names of columns, a TUM file (8 numbers in a line, the last four a "
        f"quaternion), a result of KF-GINS (11 numbers from week and second on) or NMEA, got {width} fields in "
        f"the first row. {remedy}"
    )


def _is_table(names: Sequence[str]) -> bool:
    """Return whether names of columns are those of a table of pfbench."""
    return "t" in names and (set(LOCAL) <= set(names) or set(GEODETIC) <= set(names))


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


def _rtklib_error(file: Path, head: bytes) -> ValueError:
    """Return the error for a solution of RTKLIB, with the lines of pandas that convert it."""
    if re.search(rb"^%.*(ecef|baseline|d\')", head, re.MULTILINE):
        remedy = "Set out-solformat=llh and out-degform=deg in RTKLIB, and convert its columns"
    else:
        remedy = "Convert its columns"
    has_dates = re.search(rb"^\d{4}/\d\d/\d\d ", head, re.MULTILINE)
    time = "d[1] + 604800 * (d[0] - d[0][0])"
    if has_dates:
        time = "(to_datetime(d[0] + ' ' + d[1]) - to_datetime('1980-01-06')).dt.total_seconds()"
    return ValueError(
        f"{file.name} must be a format that judge reads, got a solution of RTKLIB. {remedy}, in pandas: "
        f"d = read_csv({str(file)!r}, comment='%', sep=r'\\s+', header=None); DataFrame({{'t': {time}, "
        f"'lat_deg': d[2], 'lon_deg': d[3], 'h_m': d[4]}}).to_csv({str(file.with_suffix('.csv'))!r}, index=False)"
    )
