"""Format of a result file: required metadata, and arrays whose shapes agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from textwrap import shorten
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
    "pareto_k": "R",
    "run": "R",
}

_META = ("key", "study", "choices", "config", "label", "seed", "runs", "state")
_LONGEST = 2000  # characters of a name; a label lists the settings in which it differs
_LARGEST = 1 << 63
_HEALTH = 8  # classes of `pfbench.filter.health`


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST


def _is_whole(value: Any) -> bool:
    return type(value) is int and 0 <= value < _LARGEST


def _is_number(value: Any) -> bool:
    return value is None or (type(value) in (int, float) and abs(value) < _LARGEST)


def _are_texts(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


# requirement and test of keys; a key that is not required may be absent
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(("key", "label"), (f"a text of at most {_LONGEST} characters", _is_text)),
    **dict.fromkeys(("seed", "runs", "steps"), ("a whole number", _is_whole)),
    "particles": ("a number or null", _is_number),
    "config": ("a dictionary", lambda value: isinstance(value, dict)),
    "choices": ("a dictionary of names", _are_texts),
    "versions": ("a dictionary of texts", _are_texts),
    "seconds": (
        "a dictionary of numbers",
        lambda value: isinstance(value, dict) and all(map(_is_number, value.values())),
    ),
}


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
    for name, (kind, is_valid) in _KINDS.items():
        if name in meta and not is_valid(meta[name]):
            raise ValueError(
                f"{path}: {name} must be {kind}, got {shorten(repr(meta[name]), 60)}. "
                "Run the job again."
            )
    if fault := _find_state_fault(meta["state"]):
        raise ValueError(f"{path}: state must {fault}. Run the job again.")


def _find_state_fault(state: Any) -> str:
    """Return the requirement that a description of a state does not meet, or an empty text."""
    if not isinstance(state, dict) or not {"names", "units", "groups"} <= state.keys():
        return "have names, units and groups, got none of one"
    names, units, groups = state["names"], state["units"], state["groups"]
    for values in (names, units):
        if not isinstance(values, list) or not all(map(_is_text, values)):
            return f"have lists of texts, got {shorten(repr(values), 60)}"
    if len(units) != len(names):
        return f"have one unit for each of {len(names)} names, got {len(units)}"
    if not isinstance(groups, dict) or not all(
        isinstance(group, list) for group in groups.values()
    ):
        return f"have groups of components, got {shorten(repr(groups), 60)}"
    indices = [index for group in groups.values() for index in group]
    wrong = [index for index in indices if not _is_whole(index) or index >= len(names)]
    if wrong:
        return f"have groups of components from 0 to {len(names) - 1}, got {wrong[0]!r:.60}"
    return ""


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
    _check_values(path, data)
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


def _check_values(path: Path, data: Mapping[str, np.ndarray]) -> None:
    """Check that scores are real numbers, times increase and no spread is negative."""
    for name in data.keys() & (_AXES.keys() | _OPTIONAL.keys()):
        if data[name].dtype.kind not in ("b" if name == "lost" else "biuf"):
            kind = "booleans" if name == "lost" else "real numbers"
            raise ValueError(
                f"{path}: {name} must be {kind}, got {data[name].dtype}. Run the job again."
            )
    health = data.get("health", np.zeros(1))
    for name, requirement, is_valid in (
        ("time", "increase", bool((np.diff(data["time"]) > 0.0).all())),
        ("sd", "not be negative", not bool((data["sd"] < 0.0).any())),
        ("health", f"be from 0 to {_HEALTH - 1}", bool(((health >= 0) & (health < _HEALTH)).all())),
    ):
        if not is_valid:
            raise ValueError(
                f"{path}: {name} must {requirement}, got other values. Run the job again."
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
