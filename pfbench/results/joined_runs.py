"""Consecutive runs of one filter on the same data, from several batches or jobs, as one result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.results import store
from pfbench.results.store import PLACE_SETTINGS, compute_config_key

_SHARED = ("time", "pcrb", "range", "score_steps")  # arrays without an axis of runs
_EQUAL = ("time", "range", "score_steps")  # of all parts
_SAME_JOB = (
    "choices",
    "label",
    "seed",
    "steps",
    "particles",
    "trained",
    "state",
    "versions",
    "inputs",
)
StoredPart = tuple[Path, dict[str, Any]]


def find_consecutive_parts(items: Sequence[StoredPart]) -> list[list[StoredPart]]:
    """Group the jobs that differ in their runs alone and continue each other.

    Returns groups in the order of their first job, each sorted by its first run. A job that has a
    gap or an overlap with its neighbours is a group of its own.
    """
    groups: dict[str, list[StoredPart]] = {}
    for path, meta in items:
        groups.setdefault(_part_key(meta), []).append((path, meta))
    joined: list[list[StoredPart]] = []
    for members in groups.values():
        ordered = sorted(members, key=lambda item: int(item[1].get("first_run", 0)))
        starts = [int(meta.get("first_run", 0)) for _, meta in ordered]
        ends = [first + int(meta["runs"]) for first, (_, meta) in zip(starts, ordered, strict=True)]
        is_chain = starts[1:] == ends[:-1]
        joined += [ordered] if is_chain else [[item] for item in members]
    return joined


def join_metadata(metadata: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Join the metadata of consecutive parts: sums of runs and times, maximum of memory.

    Returns metadata of all runs. Other entries are those of the first piece.
    """
    first, shares = metadata[0], _shares(metadata)
    if len(metadata) == 1:
        return first
    total = sum(int(meta["runs"]) for meta in metadata)
    memory, times = ([meta[name] for meta in metadata] for name in ("memory", "seconds"))
    meta = {
        **first,
        "runs": total,
        "parts": len(metadata),
        "seconds": {
            name: sum(piece[name] for piece in times)
            for name in times[0]
            if all(name in piece for piece in times)
        },
        "memory": None if None in memory else max(memory),
        "likelihoods_per_step": float(
            shares @ [float(piece["likelihoods_per_step"]) for piece in metadata]
        ),
    }
    if "config" in first:
        meta["config"] = {**first["config"], "runs": total}
    if all("particles_used" in piece for piece in metadata):
        used = [piece["particles_used"] for piece in metadata]
        meta["particles_used"] = {
            "least": min(piece["least"] for piece in used),
            "most": max(piece["most"] for piece in used),
            "mean": float(shares @ [piece["mean"] for piece in used]),
        }
    return meta


def join_arrays(
    outputs: Sequence[Mapping[str, np.ndarray]], metadata: Sequence[Mapping[str, Any]]
) -> dict[str, np.ndarray]:
    """Join the arrays of consecutive parts along the axis of runs.

    Returns arrays of all runs. A PCRB of the parts becomes its root mean square.
    """
    if len(outputs) == 1:
        return dict(outputs[0])
    names = [name for name in outputs[0] if all(name in piece for piece in outputs)]
    joint = {
        name: outputs[0][name]
        if name in _SHARED
        else np.concatenate([piece[name] for piece in outputs])
        for name in names
    }
    if "pcrb" in joint:
        variances = np.stack([piece["pcrb"].astype(float) ** 2 for piece in outputs])
        mean = np.tensordot(_shares(metadata), variances, axes=1)
        joint["pcrb"] = np.sqrt(mean).astype(np.float32)
    return joint


def select_run(result: store.JobResult, index: int) -> store.JobResult:
    """Select one run of a result.

    Returns the same metadata, and arrays whose axis of runs has length 1.
    """
    data = {
        name: array if name in _SHARED else array[index : index + 1]
        for name, array in result.data.items()
    }
    return store.JobResult(result.meta, data)


def read_joined(paths: Sequence[Path]) -> store.JobResult:
    """Read the parts of a job that were computed one after the other."""
    parts = [store.read_result(path) for path in paths]
    first = parts[0]
    for path, piece in zip(paths, parts, strict=True):
        for name in _EQUAL:
            require(
                np.array_equal(piece.data.get(name, 0), first.data.get(name, 0)),
                name,
                f"be equal in all parts of {first.meta['label']}",
                f"another one in {path.name} than in {paths[0].name}",
                "Run all runs as one job (runs=...).",
            )
    metadata = [piece.meta for piece in parts]
    return store.JobResult(
        join_metadata(metadata), join_arrays([piece.data for piece in parts], metadata)
    )


def _part_key(meta: Mapping[str, Any]) -> str:
    """Return a key of all that decides the result of a job except its runs."""
    config = compute_config_key(meta["config"], (*PLACE_SETTINGS, "runs", "first_run"))
    return repr([config, *(meta.get(name) for name in _SAME_JOB)])


def _shares(metadata: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Return the share of each part in all runs."""
    runs = np.array([float(meta["runs"]) for meta in metadata])
    return runs / runs.sum()
