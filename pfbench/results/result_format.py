"""Format of a result file: required metadata, and arrays whose shapes agree."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.files.digest import DIGEST

FORMAT = 2

# Axes that must agree across arrays: R runs, T steps, D components, G groups, S scored steps.
_AXES = {"time": "T", "error": "RTD", "sd": "RTD", "nees": "RTG", "log_evidence": "R", "lost": "R"}

_OPTIONAL = {
    "score_steps": "S",
    "crps": "RSD",
    "pit": "RSD",
    "energy_score": "RSG",
    "pcrb": "TD",
    "range": "T",
    "health": "R",
    "run": "R",
}

_META = ("key", "study", "choices", "config", "label", "seed", "runs", "state")


def check_metadata(path: Path, meta: Any) -> None:
    """Check that the metadata have the format and all required keys.

    Args:
        path: File, for the message.
        meta: Metadata.

    Raises:
        ValueError: If the format differs or a key is missing.
    """
    version = meta.get("format") if isinstance(meta, dict) else None
    if version != FORMAT:
        raise ValueError(f"{path} must have format {FORMAT}, got {version}. Run the job again.")
    missing = [name for name in _META if name not in meta]
    if missing:
        raise ValueError(f"{path}: metadata must contain {', '.join(missing)}. Run the job again.")


def check_arrays(path: Path, meta: Mapping[str, Any], data: Mapping[str, np.ndarray]) -> None:
    """Check the names, types and shapes of the arrays of a result.

    Args:
        path: File, for the message.
        meta: Metadata.
        data: Arrays by name.

    Raises:
        ValueError: If an array is missing, is pickled, or has an inconsistent shape.
    """
    missing = [name for name in _AXES if name not in data]
    if missing:
        raise ValueError(
            f"{path}: a result must contain the arrays {', '.join(missing)}. Run the job again."
        )
    for name, value in data.items():
        # the first three are arguments of numpy's savez
        if name in ("file", "args", "allow_pickle", "meta", DIGEST):
            raise ValueError(
                f"{path}: name of an array must not be reserved, got {name!r}. Use another name."
            )
        if value.dtype.hasobject:
            raise ValueError(
                f"{path}: {name} must be numbers, booleans or texts, got Python objects. Convert them."
            )
    _check_run_numbers(path, meta, data)
    size: dict[str, int] = {
        "R": int(meta["runs"]),
        "D": len(meta["state"]["names"]),
        "G": len(meta["state"]["groups"]),
        "T": data["time"].size,
        "S": data["score_steps"].size if "score_steps" in data else 0,
    }
    for name, axes in (
        _AXES | {name: axes for name, axes in _OPTIONAL.items() if name in data}
    ).items():
        expected = tuple(size[axis] for axis in axes)
        if data[name].shape != expected:
            raise ValueError(
                f"{path}: {name} must have shape {list(axes)} = {expected}, got {data[name].shape}"
            )


def _check_run_numbers(path: Path, meta: Mapping[str, Any], data: Mapping[str, np.ndarray]) -> None:
    """Check that each run has a number of its own: a repeated run would count twice."""
    first = meta.get("first_run", 0)
    if type(first) is not int or first < 0 or first + int(meta["runs"]) > 1 << 32:
        raise ValueError(
            f"{path}: first_run must be a whole number from 0 to 2**32 - runs, got {first}. "
            "Run the job again."
        )
    if "run" in data:
        numbers, counts = np.unique(data["run"], return_counts=True)
        if (counts > 1).any():
            raise ValueError(
                f"{path}: run must have distinct run numbers, got {numbers[counts > 1][0]} "
                f"{counts.max()} times. Run the job again."
            )
