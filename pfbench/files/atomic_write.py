"""Writing of files: an interruption leaves the old or the new file, never a partial one."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any
from uuid import uuid4


def write_atomically(path: Path, fill: Callable[[IO[bytes]], Any]) -> None:
    """Write a file under a temporary name and rename it.

    Args:
        path: File. Its folder is created.
        fill: Writes the content to an open file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name.split('.')[0]}.{uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def set_aside(path: Path) -> Path:
    """Rename a damaged file, so that it is not read again.

    Args:
        path: File.

    Returns:
        The new path, `NAME.damaged`, with a number if that exists.
    """
    target = path.with_name(f"{path.name}.damaged")
    number = 1
    while target.exists():
        number += 1
        target = path.with_name(f"{path.name}.damaged{number}")
    os.replace(path, target)
    return target
