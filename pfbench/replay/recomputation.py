"""Computation of one stored run with scores at all steps."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.config.composition import CHOICES, JobConfig
from pfbench.config.trust import UntrustedConfigError, trusted_packages
from pfbench.job.inputs import CODE_OF, find_inputs
from pfbench.job.plan import build_plan
from pfbench.job.run_job import compute_job
from pfbench.replay.run_selection import StoredRun
from pfbench.results import store
from pfbench.results.config_key import DATA_FOLDERS, Inputs
from pfbench.results.inputs import list_changed

_ENGINES = ("kernels", "compiled")  # engines that a job may have used; the others are eager


def replay_config(stored: StoredRun, changes: Mapping[str, Any]) -> JobConfig:
    """Return the configuration that computes one run of a stored job.

    Args:
        stored: Run.
        changes: See `stored_config`.

    Returns:
        The configuration.

    Raises:
        ValueError: If the result was not computed by a job, or names what is not trusted.
    """
    meta = stored.result.meta
    one_run = {"first_run": stored.run, "runs": 1, "score_steps": int(meta["steps"])}
    return stored_config(meta, stored.job.path, {**one_run, **changes})


def stored_config(meta: Mapping[str, Any], path: Path, changes: Mapping[str, Any]) -> JobConfig:
    """Return the configuration of a stored job.

    All settings that affect the numbers are those of the job. A number of particles that a budget chose is
    set as such, so that nothing is measured again.

    Args:
        meta: Metadata of the job.
        path: File of the job, for errors.
        changes: Values of top-level keys that replace the stored ones: folders, the folder of the data,
            threads, device.

    Returns:
        The configuration.

    Raises:
        ValueError: If the result was not computed by a job, or the packages of its classes are not trusted.
    """
    parts = ("scenario", "noise", "filter", "model")
    values = copy.deepcopy(meta["config"])
    if not all(isinstance(values.get(name), Mapping) for name in parts):
        raise ValueError(
            f"study must have results of pfbench run, got results without {', '.join(parts)} in "
            f"{path}. Choose another study."
        )
    values |= {
        "pcrb": False,
        "engine": meta["engine"] if meta.get("engine") in _ENGINES else "eager",
        "memory_limit_gib": None,
        "budget": store.SAME_N,
        **changes,
    }
    if meta.get("budget_allocation"):
        values["filter"]["particles"] = meta["particles"]
    for key in DATA_FOLDERS:
        _replace_folder(values, key.split("."), values["data"]["root"])
    _replace_cache_folders(values["scenario"], values["episode_cache_dir"])
    trusted = trusted_packages()
    packages = meta.get("trusted", [])
    if not set(packages) <= set(trusted):
        text = f"trust=[{','.join(trusted)}]" if trusted else "none of them"
        raise UntrustedConfigError(
            f"trust must name the packages whose classes the run used, {', '.join(packages)}, got {text}. Nothing was "
            f"run. If you still trust them, add trust=[{','.join(packages)}] to the command."
        )
    return JobConfig(
        values, {group: str(meta["choices"][group]) for group in CHOICES}, trusted=trusted
    )


def describe_changed_code(meta: Mapping[str, Any]) -> str:
    """Describe a change of a user's classes since a stored job; empty without one.

    Args:
        meta: Metadata of the job, whose packages are trusted.
    """
    if not meta.get("trusted"):
        return ""
    changed = _list_changed_inputs(meta, find_inputs(meta["config"], trusted_packages()))
    code = [name for name in changed if name.startswith(CODE_OF)]
    if not code:
        return ""
    return f"the {' and the '.join(code)} has changed since {meta['label']} was run: its numbers may differ"


def _list_changed_inputs(meta: Mapping[str, Any], present: Inputs) -> list[str]:
    """List the inputs of a job that have other content now, for people."""
    return list_changed(meta["inputs"], present) if present and "inputs" in meta else []


def _replace_folder(node: Any, path: Sequence[str], folder: str | None) -> None:
    """Set a folder of data at a path of a stored configuration, if it has one."""
    for name in path[:-1]:
        node = node.get(name) if isinstance(node, dict) else None
    if isinstance(node, dict) and node.get(path[-1]) is not None:
        node[path[-1]] = folder


def _replace_cache_folders(node: Any, folder: str | None) -> None:
    """Set the cache folders of a stored scenario, which may be of another person."""
    children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    for child in children:
        _replace_cache_folders(child, folder)
    if isinstance(node, dict) and node.get("cache_dir") is not None:
        node["cache_dir"] = folder


def recompute_run(stored: StoredRun, changes: Mapping[str, Any]) -> store.JobResult:
    """Compute one stored run again.

    Args:
        stored: Run.
        changes: See `replay_config`.

    Returns:
        Result with one run, and scores at all steps.
    """
    config = replay_config(stored, changes)
    _check_inputs(stored.result.meta, find_inputs(config.values, config.trusted))
    choices = {group: config.choices[group] for group in CHOICES}
    title = " / ".join(choices[group] for group in ("scenario", "noise", "filter"))
    meta, outputs = compute_job(build_plan(config), f"{title}, run {stored.run}")
    head = {"key": stored.job.path.stem, "study": stored.job.path.parent.name}
    full = {**head, "choices": choices, "config": config.values, **meta}
    return store.JobResult(full, outputs)


def _check_inputs(meta: Mapping[str, Any], present: Inputs) -> None:
    """Raise ValueError if a job cannot be computed again, since a file that it read has changed.

    Another code of a user's classes is printed, since it may be a mended message.
    """
    changed = [name for name in _list_changed_inputs(meta, present) if not name.startswith(CODE_OF)]
    if changed:
        raise ValueError(
            f"{' and '.join(changed)} must be as it was when the result was computed, got other content. "
            "Run the job again, and replay the new result."
        )


def select_stored_scores(result: store.JobResult, stored: store.JobResult) -> store.JobResult:
    """Select the scores of a replay at the steps at which the stored run was scored.

    Args:
        result: Result with scores at all steps.
        stored: Stored result.

    Returns:
        The replay with the arrays of scores that the stored run has.
    """
    steps = stored.data.get("score_steps")
    names = ("crps", "pit", "energy_score", "nis", "nis_dof")
    data = {k: v for k, v in result.data.items() if k not in (*names, "score_steps")}
    if steps is not None:
        index = np.searchsorted(result.data["score_steps"], steps)
        data |= {k: result.data[k][:, index] for k in names if k in result.data}
        data["score_steps"] = np.asarray(steps)
    return store.JobResult(result.meta, data)
