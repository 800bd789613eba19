"""Limits of the files that pfbench reads. A file of another person may be made to fill the memory or to take hours."""

from __future__ import annotations

import gzip
import io
import stat
import zipfile
import zlib
from collections import Counter
from pathlib import Path, PurePath

# of a configuration file
CONFIG_BYTES = 1_000_000
CONFIG_VALUES = 10_000  # with its aliases expanded
CONFIG_DEPTH = 40
CONFIG_TEXT = 10_000  # characters of one text
CONFIG_INTERPOLATED = 1_000  # characters of a text with interpolations
# of a configuration
RESOLVED_REFERENCES = 1_000
RESOLVED_VALUES = 100_000  # that others refer to, counted at each reference
RESOLVED_TEXT = 1_000_000  # characters of all their values
LOADED_FILES = (
    300  # by the defaults lists of one configuration with a search path, repetitions counted
)
SWEPT_JOBS = 100_000  # of the sweep in a file
# of texts that are read line by line: NMEA, TUM, KF-GINS, RINEX and CSV
TEXT_BYTES = 512 * 2**20
TEXT_LINES = 5_000_000
LINE_BYTES = 100_000
_PIECE = 2**20  # bytes that are checked at once
# of tables and compressed files
TABLE_BYTES = 4 * 2**30
TABLE_COLUMNS = 1_000
INFLATED_RATIO = (
    200  # times the size of the file; numbers of runs and of sensors have a ratio below 20
)
INFLATED_FREE = 64 * 2**20  # bytes that any file may inflate to


class LimitError(ValueError):
    """A file exceeds a limit."""


def check_is_file(path: Path, most: int) -> None:
    """Check that a path is a file and no pipe or device, which may never end, and its size."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise LimitError(
            f"{path} must be a file, got a folder, a pipe or a device. Give the path of a file."
        )
    if status.st_size > most:
        raise LimitError(
            f"{path} must have at most {most} bytes, got {status.st_size}. Split the file."
        )


def find_input(folder: str | Path, name: str, *, is_data_set: bool = False) -> Path:
    """Return the path of a file or a folder that a configuration or a stored result names.

    Args:
        folder: Folder of the user.
        name: Name below the folder. Nothing else is opened: no parent, no other place, no link that leads out of it.
        is_data_set: Whether the name starts with a data set of the user's, which may be a link to another place.

    Raises:
        LimitError: If the name leaves the folder.
    """
    path, parts = Path(folder) / name, PurePath(name).parts
    home = Path(folder, *parts[:is_data_set])
    is_plain = ".." not in parts and not PurePath(name).is_absolute()
    if is_plain and path.resolve().is_relative_to(home.resolve()):
        return path
    raise LimitError(
        f"{name} must be a file or a folder below {folder}, got a path or a link that leaves it. "
        "Copy it there, or name another folder on the command line, such as data.root=..."
    )


def check_columns(path: Path, count: int) -> None:
    """Check the number of columns of a table."""
    if count > TABLE_COLUMNS:
        raise LimitError(
            f"{path.name} must have at most {TABLE_COLUMNS} columns, got {count}. "
            "Keep the columns that the reader names."
        )


def read_text(path: Path) -> bytes:
    """Read a text, whose size, number of lines and longest line are checked piece by piece."""
    check_is_file(path, TEXT_BYTES)
    pieces, ends, length = [], Counter[bytes](), 0
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            pieces.append(piece)
            first, *others = map(len, piece.replace(b"\r", b"\n").split(b"\n"))
            longest = max(length + first, *others, 0)
            if longest > LINE_BYTES:
                raise LimitError(
                    f"{path.name} must have lines of at most {LINE_BYTES} bytes, got a longer one. "
                    "Write each row into a line of its own."
                )
            length = others[-1] if others else length + first
            ends.update({end: piece.count(end) for end in (b"\n", b"\r")})
            if max(ends.values()) > TEXT_LINES:
                raise LimitError(
                    f"{path.name} must have at most {TEXT_LINES} lines, got more. Split the file, or write a "
                    "table as Parquet."
                )
    return b"".join(pieces)


def check_inflated(path: Path, size: int) -> None:
    """Check the size that a compressed file states, before it is read."""
    most = _most_inflated(path)
    if size > most:
        raise LimitError(
            f"{path} must inflate to at most {most} bytes, {INFLATED_RATIO} times its size, got {size} or "
            "more. The file is damaged or made to fill the memory. Delete it and write it again."
        )


def check_zip(path: Path) -> None:
    """Check the sizes in a zip file such as a result or a checkpoint, before it is read."""
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, EOFError):
        return
    check_inflated(path, size)


def inflate(path: Path, content: bytes) -> bytes:
    """Inflate gzip content of a file, which does not state its size, up to the limit of the file."""
    most = _most_inflated(path)
    try:
        with gzip.open(io.BytesIO(content)) as file:
            inflated = file.read(most + 1)
    except (zlib.error, EOFError, gzip.BadGzipFile) as error:
        raise ValueError(f"{path} must be a gzip file, got {error}. Write it again.") from error
    check_inflated(path, len(inflated))
    return inflated


def _most_inflated(path: Path) -> int:
    """Return the number of bytes that a compressed file may inflate to."""
    return max(INFLATED_FREE, INFLATED_RATIO * path.stat().st_size)
