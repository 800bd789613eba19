"""Limits of the files that pfbench reads. A file of another person may be made to fill the memory or to take hours."""

from __future__ import annotations

import stat
import zipfile
import zlib
from pathlib import Path

# of a configuration file
CONFIG_BYTES = 1_000_000
CONFIG_VALUES = 10_000  # with its aliases expanded
CONFIG_DEPTH = 40
CONFIG_TEXT = 10_000  # characters of one text
CONFIG_INTERPOLATED = 1_000  # characters of a text with interpolations
# of a configuration
RESOLVED_REFERENCES = 2_000
RESOLVED_VALUES = 100_000  # that others refer to, each as often as it is referred to
RESOLVED_TEXT = 1_000_000  # characters of all their values
LOADED_FILES = (
    300  # by the defaults lists of one configuration with a search path, repetitions counted
)
SWEPT_JOBS = 100_000  # of the sweep in a file
# of tables and compressed files
TABLE_BYTES = 4 * 2**30
TABLE_COLUMNS = 1_000
INFLATED_RATIO = (
    200  # times the size of the file; numbers of runs and of sensors have a ratio below 20
)
INFLATED_FREE = 64 * 2**20  # bytes that any file may inflate to

_CHUNK = 2**20


def check_is_file(path: Path, most: int) -> None:
    """Check that a path is a file and no pipe or device, which may never end, and its size.

    Args:
        path: File, or a link to one.
        most: Largest size in bytes.

    Raises:
        OSError: If the file does not exist.
        ValueError: If it is another kind of file, or too large.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(
            f"{path} must be a file, got a folder, a pipe or a device. Give the path of a file."
        )
    if status.st_size > most:
        raise ValueError(
            f"{path} must have at most {most} bytes, got {status.st_size}. Split the file."
        )


def check_columns(path: Path, count: int) -> None:
    """Raise ValueError if a table has too many columns."""
    if count > TABLE_COLUMNS:
        raise ValueError(
            f"{path.name} must have at most {TABLE_COLUMNS} columns, got {count}. "
            "Keep the columns that the reader names."
        )


def check_inflated(path: Path, size: int) -> None:
    """Check the size that a compressed file states, before it is read.

    Args:
        path: File.
        size: Its size without compression in bytes.

    Raises:
        ValueError: If it is much larger than the file.
    """
    most = _most_inflated(path)
    if size > most:
        raise ValueError(
            f"{path} must inflate to at most {most} bytes, {INFLATED_RATIO} times its size, got {size}. "
            "The file is damaged or made to fill the memory. Delete it and write it again."
        )


def check_zip(path: Path) -> None:
    """Check the sizes in a zip file such as a result or a checkpoint, before it is read.

    Args:
        path: File. One that is not a zip file is left to its reader.

    Raises:
        ValueError: If its content is much larger than the file.
    """
    try:
        with zipfile.ZipFile(path) as file:
            size = sum(member.file_size for member in file.infolist())
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, EOFError):
        return
    check_inflated(path, size)


def read_gzip(path: Path) -> bytes:
    """Read a gzip file, which does not state its size, up to the limit.

    Args:
        path: File.

    Returns:
        The content.

    Raises:
        OSError: If the file does not exist.
        ValueError: If the content is much larger than the file, or the file is damaged.
    """
    check_is_file(path, TABLE_BYTES)
    content, most, chunks, size = path.read_bytes(), _most_inflated(path), [], 0
    try:
        while content:
            stream = zlib.decompressobj(zlib.MAX_WBITS | 16)
            while not stream.eof:
                chunks.append(stream.decompress(content, _CHUNK))
                content, size = stream.unconsumed_tail or stream.unused_data, size + len(chunks[-1])
                if size > most:
                    check_inflated(path, size)
                if not chunks[-1] and not content and not stream.eof:
                    raise EOFError("the file ends within its content")
    except (zlib.error, EOFError) as error:
        raise ValueError(f"{path} must be a gzip file, got {error}. Write it again.") from error
    return b"".join(chunks)


def _most_inflated(path: Path) -> int:
    """Return the number of bytes that a compressed file may inflate to."""
    return max(INFLATED_FREE, INFLATED_RATIO * path.stat().st_size)
