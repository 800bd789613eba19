"""Files of trajectories: patterns with sequence and run, and the reader of each format."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from pfbench.judge.judge_options import SourceOptions
from pfbench.judge.readers.csv_trajectory import read_csv_trajectory
from pfbench.judge.readers.file_format import find_format
from pfbench.judge.readers.nmea_trajectory import read_nmea_trajectory
from pfbench.judge.readers.result_trajectory import read_result_trajectories
from pfbench.judge.readers.text_trajectory import read_kf_gins_trajectory, read_tum_trajectory
from pfbench.judge.readers.trajectory_table import TrajectoryTable, check_trajectory

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

    Args:
        pattern: Path, optionally with {sequence} and {run}, each within one folder or file name.

    Returns:
        Files in order of sequence and run.

    Raises:
        ValueError: If no file exists.
    """
    path = Path(pattern)
    if "{" not in pattern:
        if not path.is_file():
            raise ValueError(f"{pattern} must be a file, got none. Check the path.")
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
    """Read and check a file; columns are multiplied by their factors, then the clock is shifted.

    Args:
        path: File: table, TUM, NMEA, text of KF-GINS, or result of pfbench.
        options: Options of the program.
        sd: KF-GINS file of standard deviations, or None.

    Returns:
        One table per run of the file.

    Raises:
        ValueError: If the format is unknown or a check fails.
    """
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
