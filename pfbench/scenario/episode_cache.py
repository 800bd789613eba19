"""Cache of episodes on disk: simulated once and shared by all filters of a study."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.files.atomic_write import set_aside, write_atomically
from pfbench.files.digest import DIGEST, has_valid_digest, hash_content

Arrays = dict[str, Tensor]
log = logging.getLogger("pfbench")


def load_or_build(folder: str | Path | None, recipe: object, build: Callable[[], Arrays]) -> Arrays:
    """Load tensors from the cache, or build and store them.

    Args:
        folder: Folder of the cache. None disables it.
        recipe: All that decides the tensors. Its `repr` is the key, so it must consist of frozen
            dataclasses and plain values.
        build: Builds the tensors.

    Returns:
        The tensors by name.
    """
    if folder is None:
        return build()
    path = Path(folder) / f"{hashlib.sha256(repr(recipe).encode()).hexdigest()[:16]}.npz"
    if path.exists():
        try:
            return _read(path)
        except Exception as error:  # numpy and zipfile raise many kinds for damaged files
            log.warning(
                "warning  episode cache: %s is damaged (%s). Renamed to %s, built again",
                path, error, set_aside(path).name,
            )  # fmt: skip
    tensors = build()
    data: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()}
    data[DIGEST] = np.array(hash_content(data))
    write_atomically(path, lambda file: np.savez(file, **data))
    return tensors


def _read(path: Path) -> Arrays:
    """Read a file of the cache.

    Raises:
        ValueError: If its digest is not that of its content. Other errors are those of numpy.
    """
    # opened here, since numpy leaves a damaged file open
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    if not has_valid_digest(data):
        raise ValueError("its digest must be that of its content")
    return {name: torch.from_numpy(value) for name, value in data.items() if name != DIGEST}
