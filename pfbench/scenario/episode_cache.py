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
from pfbench.files.limits import check_zip
from pfbench.kernels.generator_version import GENERATOR_VERSION

Arrays = dict[str, Tensor]
log = logging.getLogger("pfbench")

_KEY = "episode_key"  # name of the key in a file, which shows that a file has another one's name


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
    head = f"episodes 2 generator {GENERATOR_VERSION}"
    key = hashlib.sha256(f"{head} {recipe!r}".encode()).hexdigest()[:16]
    path = Path(folder) / f"{key}.npz"
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
    data[_KEY] = np.array(key)
    data[DIGEST] = np.array(hash_content(data))
    write_atomically(path, lambda file: np.savez(file, **data))
    return tensors


def _read(path: Path) -> Arrays:
    """Read a file of the cache.

    Raises:
        ValueError: If its digest is not that of its content, or its key is that of other episodes.
            Other errors are those of numpy.
    """
    # opened here, since numpy leaves a damaged file open
    check_zip(path)
    with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
        data = {name: file[name] for name in file.files}
    if not has_valid_digest(data):
        raise ValueError("its digest must be that of its content")
    if str(data.get(_KEY)) != path.stem:
        raise ValueError(f"its key must be {path.stem}, got {data.get(_KEY)}")
    items = (item for item in data.items() if item[0] not in (DIGEST, _KEY))
    return {name: torch.from_numpy(value) for name, value in items}
