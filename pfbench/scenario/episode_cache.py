"""Cache of episodes on disk: simulated once and shared by all filters of a study."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import torch
from torch import Tensor

Arrays = dict[str, Tensor]


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
        with np.load(path, allow_pickle=False) as file:
            return {name: torch.from_numpy(file[name]) for name in file.files}
    tensors = build()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as file:
            data: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()}
            np.savez(file, **data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return tensors
