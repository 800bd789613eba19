"""Writing of files that is never partial, and digests of their content."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import IO, Any
from uuid import uuid4

import numpy as np


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
    """Remove the temporary files that interrupted writes of a file left."""
    pattern = re.compile(re.escape(path.name.split(".")[0]) + r"\.[0-9a-f]{8}\.tmp")
    for file in path.parent.iterdir():
        if pattern.fullmatch(file.name) and file.is_file() and not file.is_symlink():
            file.unlink(missing_ok=True)


def set_aside(path: Path, reason: str = "damaged") -> Path:
    """Rename a file, so that it is not read again and another file can have its name.

    Returns the new path, `NAME.damaged`, with a number if that exists.
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


# --------------------------------------------------------------------------------------------------
# Digest of the content of a file: dictionaries, lists, plain values, arrays and tensors.

DIGEST = "digest"  #: name of the digest in a file


def hash_content(content: Any) -> str:
    """Compute the SHA-256 of a content, independent of the order of its keys.

    Args:
        content: Nested dictionaries and lists of plain values, arrays and tensors. The key
            `digest` of the outermost dictionary is left out.

    Returns:
        64 hexadecimal digits.
    """
    if isinstance(content, Mapping):
        content = {key: value for key, value in content.items() if key != DIGEST}
    sha256 = hashlib.sha256()
    _add(sha256, content)
    return sha256.hexdigest()


def hash_file(path: Path) -> str:
    """Compute the SHA-256 of the bytes of a file, once in a process while the file is unchanged."""
    state = path.stat()
    return _hash_bytes(path, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)


@lru_cache(maxsize=4096)
def _hash_bytes(path: Path, *_: int) -> str:
    with path.open("rb") as file:  # in pieces: a log may be larger than the memory
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def has_valid_digest(content: Mapping[str, Any]) -> bool:
    """Return whether a content has a digest and agrees with it."""
    return DIGEST in content and str(content[DIGEST]) == hash_content(content)


def _add(sha256: Any, value: Any) -> None:
    """Add a value with its type and size, so that no two contents have the same bytes."""
    if isinstance(value, Mapping):
        sha256.update(f"dict {len(value)};".encode())
        for key in sorted(value, key=repr):
            _add(sha256, key)
            _add(sha256, value[key])
    elif isinstance(value, list | tuple):
        sha256.update(f"list {len(value)};".encode())
        for item in value:
            _add(sha256, item)
    elif hasattr(value, "detach") or isinstance(value, np.ndarray):
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        sha256.update(f"array {array.dtype.str} {array.shape};".encode())
        sha256.update(np.ascontiguousarray(array).tobytes())
    else:
        text = repr(value).encode()
        sha256.update(f"{type(value).__name__} {len(text)};".encode() + text)
