"""Writing of files: an interruption leaves the old or the new file, never a partial one."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any
from uuid import uuid4


def write_atomically(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    """Write a file under a temporary name and rename it.

    Args:
        path: File. Its folder is created.
        fill: Writes the content to an open file.

    Raises:
        OSError: If the file cannot be written. The error names the file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name.split('.')[0]}.{uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None:  # the error of a full disk names no file
            error.filename = error.filename or str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def remove_temporary_files(path: Path) -> None:
    """Remove the temporary files that interrupted writes of a file left.

    Args:
        path: File. Only names that `write_atomically` gives for it are removed.
    """
    pattern = re.compile(re.escape(path.name.split(".")[0]) + r"\.[0-9a-f]{8}\.tmp")
    for file in path.parent.iterdir():
        if pattern.fullmatch(file.name) and file.is_file() and not file.is_symlink():
            file.unlink(missing_ok=True)


def set_aside(path: Path, reason: str = "damaged") -> Path:
    """Rename a file, so that it is not read again and another file can have its name.

    Args:
        path: File.
        reason: New suffix.

    Returns:
        The new path, `NAME.damaged`, with a number if that exists.
    """
    target = path.with_name(f"{path.name}.{reason}")
    number = 1
    while target.exists() or target.is_symlink():
        number += 1
        target = path.with_name(f"{path.name}.{reason}{number}")
    # Another process that read the same file may have renamed it already.
    with suppress(FileNotFoundError):
        os.replace(path, target)
    return target
