"""Format of a trajectory file: its content decides, and its suffix only where the content does not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pfbench.judge.readers.text_trajectory import (
    KF_GINS_SD,
    find_pose_columns,
    read_head,
    to_numbers,
)
from pfbench.judge.readers.trajectory_table import GEODETIC, LOCAL
from pfbench.results.error_measures import Array

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
    """Find the format of a file.

    Args:
        file: File.
        has_names: Whether names of columns are stated, which belong to a table.

    Returns:
        One of `FORMATS` of the options.

    Raises:
        ValueError: If the content is that of no format that is read, or of several.
    """
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
