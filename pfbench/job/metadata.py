"""Metadata of a job: all that a report states about how its results were computed."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pfbench
from pfbench.config.source_digest import hash_package
from pfbench.filter.exactness import has_bounded_weights, has_covariance, has_evidence
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.job.inputs import describe_unnamed_files
from pfbench.job.plan import JobPlan
from pfbench.model.base import StateSpaceModel

# parts of a checkout that decide results
_DECIDING = ("pfbench", "conf", "experiments", "pyproject.toml", "setup.py")
_TIMEOUT = 10  # s, of git


def make_metadata(
    plan: JobPlan, model: StateSpaceModel, steps: int, notes: Sequence[str]
) -> dict[str, Any]:
    """Collect the metadata of a job.

    Args:
        plan: Plan of the job.
        model: Model that the filter received.
        steps: Number of time steps.
        notes: Modelling choices of the scenario.

    Returns:
        Values that JSON can represent.
    """
    values, method = plan.values, plan.method
    device = values["device"]
    unnamed = describe_unnamed_files(values["scenario"], plan.config.trusted)
    is_exact_kalman = model.linear and isinstance(method, GaussianFilter) and method.plain
    return {
        "label": plan.config.choices["filter"],
        "seed": values["seed"],
        "first_run": values["first_run"],
        "runs": values["runs"],
        "particles": values["filter"].get("particles"),
        "steps": steps,
        "dtype": values["dtype"],
        "device": device if device == "cpu" else torch.cuda.get_device_name(device),
        "threads": values["threads"],
        "is_exact": method.is_exact or is_exact_kalman,
        "has_bounded_weights": has_bounded_weights(method),
        "has_evidence": has_evidence(method),
        "has_counts": model.has_counts,
        "has_covariance": has_covariance(method),
        "oracle_noise": values["oracle_noise"],
        "modelling_choices": [*model.choices, *notes, *unnamed],
        "state": describe_state(model),
        **make_provenance(),
    }


def describe_state(model: StateSpaceModel) -> dict[str, Any]:
    """Return names and units of the state's components, and its groups."""
    return {
        "names": list(model.names),
        "units": list(model.units),
        "groups": {name: list(components) for name, components in model.groups.items()},
    }


def make_provenance() -> dict[str, Any]:
    """Return versions, host and time of creation."""
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return {"versions": read_versions(), "host": platform.node(), "created": created}


def read_versions() -> dict[str, str]:
    """Return the versions that affect the numbers.

    `commit` is empty outside a checkout. `build` is the commit of an unchanged checkout, else a digest of
    the sources. Both are those of the first call in the process: later changes are not loaded.
    """
    commit, build = _read_build()
    return {
        "pfbench": pfbench.__version__,
        "commit": commit,
        "build": build,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }


@cache
def _read_build() -> tuple[str, str]:
    """Return the commit and the build of this process."""
    commit = describe_commit(Path(pfbench.__file__).resolve().parents[1])
    is_clean = commit and not commit.endswith("-dirty")
    return commit, commit if is_clean else f"sources {hash_package()}"


def describe_commit(checkout: Path) -> str:
    """Return the commit of a checkout, with "-dirty" if a tracked file that decides results is changed.

    Pages, reports and tests do not count.

    Args:
        checkout: Top folder.

    Returns:
        Abbreviated commit, empty outside a checkout. The repository of a project in whose folder pfbench
        is installed does not count.
    """
    present = [name for name in _DECIDING if (checkout / name).exists()]
    commands = (
        ("rev-parse", "--show-cdup", "--short", "HEAD"),  # the first is empty at the top
        ("diff", "--no-ext-diff", "--name-only", "HEAD", "--", *present),
    )
    try:
        commit, changed = (_run_git(checkout, *command) for command in commands)
    except (OSError, subprocess.SubprocessError):
        return ""
    if "/" in commit:
        return ""
    return f"{commit}-dirty" if commit and changed else commit


def _run_git(folder: Path, *words: str) -> str:
    """Run git in a folder and return its output, empty after an error of git."""
    command = ["git", "-C", str(folder), *words]
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=_TIMEOUT
    ).stdout.strip()
