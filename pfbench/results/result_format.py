"""Format of a result file: required metadata, and arrays whose shapes agree."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = 1

# Axes that must agree across arrays: R runs, T steps, D components, G groups, S scored steps.
_AXES = {
    "time": "T",
    "error": "RTD",
    "sd": "RTD",
    "nees": "RTG",
    "log_evidence": "R",
    "lost": "R",
}

_OPTIONAL = {
    "scored": "S",
    "crps": "RSD",
    "pit": "RSD",
    "energy": "RSG",
    "bound": "TD",
    "range": "T",
}

_META = ("key", "study", "choices", "config", "label", "seed", "runs", "state")


def check_metadata(path: Path, meta: Any) -> None:
    """Raise ValueError if required metadata are missing."""
    version = meta.get("format") if isinstance(meta, dict) else None
    if version != FORMAT:
        raise ValueError(f"{path} must have format {FORMAT}, got {version}. Run the job again.")
    missing = [name for name in _META if name not in meta]
    if missing:
        raise ValueError(f"{path}: metadata must contain {', '.join(missing)}")


def check_arrays(path: Path, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if arrays are missing, pickled, or inconsistent in R, T, D, G or S."""
    missing = [name for name in _AXES if name not in arrays]
    if missing:
        raise ValueError(f"{path}: a result must contain the arrays {', '.join(missing)}")
    for name, value in arrays.items():
        # the first three are arguments of numpy's savez
        if name in ("file", "args", "allow_pickle", "meta"):
            raise ValueError(f"{path}: the array name {name!r} is reserved. Use another name")
        if value.dtype.hasobject:
            raise ValueError(
                f"{path}: {name} must be numbers, booleans or texts, got Python objects"
            )
    size: dict[str, int] = {
        "R": int(meta["runs"]),
        "D": len(meta["state"]["names"]),
        "G": len(meta["state"]["groups"]),
        "T": arrays["time"].size,
        "S": arrays["scored"].size if "scored" in arrays else 0,
    }
    for name, axes in (
        _AXES | {name: axes for name, axes in _OPTIONAL.items() if name in arrays}
    ).items():
        expected = tuple(size[axis] for axis in axes)
        if arrays[name].shape != expected:
            raise ValueError(
                f"{path}: {name} must have shape {list(axes)} = {expected}, got {arrays[name].shape}"
            )
