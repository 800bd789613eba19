"""Digest of the content of a file: dictionaries, lists, plain values, arrays and tensors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

DIGEST = "digest"  # name of the digest in a file


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
    """Compute the SHA-256 of the bytes of a file, once in a process while the file is unchanged.

    Args:
        path: File.

    Returns:
        16 hexadecimal digits.

    Raises:
        OSError: If the file cannot be read.
    """
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
