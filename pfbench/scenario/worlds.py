"""Worlds on disk: what is costly to simulate is drawn once and shared by all filters of a study."""

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


def cached(folder: str | Path | None, recipe: object, build: Callable[[], Arrays]) -> Arrays:
    """The tensors that `build` makes, from disk where the same recipe was built before.

    Args:
        folder: where worlds are kept; None keeps none.
        recipe: everything that decides the world; its `repr` is the key, so it holds frozen dataclasses and plain values.
        build: makes the tensors.
    """
    if folder is None:
        return build()
    path = Path(folder) / f"{hashlib.sha256(repr(recipe).encode()).hexdigest()[:16]}.npz"
    if path.exists():
        with np.load(path, allow_pickle=False) as file:
            return {name: torch.from_numpy(file[name]) for name in file.files}
    arrays = build()
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{uuid4().hex[:8]}.tmp")
    try:
        with temporary.open("xb") as file:
            plain: dict[str, Any] = {name: tensor.numpy() for name, tensor in arrays.items()}
            np.savez(file, **plain)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return arrays
