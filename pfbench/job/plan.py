"""Plan of a job: a checked configuration, its settings and objects, and what a report states about it."""

from __future__ import annotations

import copy
import hashlib
import os
import platform
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pfbench
from pfbench.core.record import Episode
from pfbench.filter.exactness import has_bounded_weights, has_covariance, has_evidence
from pfbench.filter.loop import choose_run_batch
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.config import JobConfig
from pfbench.job.inputs import describe_unnamed_files
from pfbench.job.memory import keep_freed_memory
from pfbench.job.model_fit import instantiate_parts
from pfbench.job.settings import check_settings
from pfbench.job.trust import hash_package
from pfbench.model.base import StateSpaceModel
from pfbench.scenario.base import RecordingRegime, Scenario


@dataclass(frozen=True, eq=False)
class JobPlan:
    """Objects of a job.

    Budget and memory limit are applied to them, never to the configuration.

    Attributes:
        config: Resolved configuration.
        model: Model of the filter, on the CPU in double precision.
        scenario: Source of episodes.
        recording_regime: Noise regime that records the measurement channels of the scenario.
        method: Filter.
        runs: Numbers of the Monte Carlo runs, [R].
    """

    config: JobConfig
    model: StateSpaceModel
    scenario: Scenario
    recording_regime: RecordingRegime
    method: Any
    runs: Tensor

    @property
    def values(self) -> dict[str, Any]:
        """Values of the configuration."""
        return self.config.values

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the filter."""
        dtype: torch.dtype = getattr(torch, self.values["dtype"])
        return dtype

    def draw_episode(self, runs: Tensor) -> Episode:
        """Draw the episode of some runs. Each run depends on its number and the seed only.

        Args:
            runs: Numbers of the runs, [R].

        Returns:
            Their measurements, inputs and truth.
        """
        return self.scenario.draw(self.recording_regime, runs, self.values["seed"])

    def make_filter_model(self, episode: Episode) -> StateSpaceModel:
        """Copy the model to the device and precision of the job.

        Args:
            episode: Episode of the job, with whose noise regime an oracle model agrees.

        Returns:
            The model that the filter receives.
        """
        model = copy.deepcopy(self.model)
        if self.values["oracle_noise"]:
            model = self.recording_regime.to_oracle_model(model, episode.time)
        return model.to(self.values["device"], self.dtype)

    def choose_run_batch(self, method: Any, runs: int, is_shared: bool = False) -> int:
        """Choose how many runs are stepped together. On a GPU all runs are.

        Args:
            method: Filter.
            runs: Number of runs.
            is_shared: Whether the threads of the job share the batches.
        """
        if self.values["device"] != "cpu" or not isinstance(method, ParticleFilter):
            return runs
        threads = self.values["threads"] if is_shared else 1
        return choose_run_batch(runs, method.particles, self.model.chart.size, threads)

    def choose_timer(self) -> Callable[[], float]:
        """Choose processor time for one CPU thread, which other programs do not affect.

        Processor time adds up over threads, so wall time is used otherwise.
        """
        is_single = self.values["device"] == "cpu" and self.values["threads"] == 1
        return time.process_time if is_single else time.perf_counter


def build_plan(config: JobConfig) -> JobPlan:
    """Check a configuration, apply its global settings and build its objects once.

    Args:
        config: Resolved configuration.

    Returns:
        The plan. Nothing is drawn yet.

    Raises:
        ValueError: If a value of the configuration is invalid, or the model does not fit the scenario.
    """
    values = config.values
    apply_global_settings(values)
    # The model first: a scenario may contain it, and an error then names the key of the model.
    model, scenario, noise, method = instantiate_parts(
        values, ("model", "scenario", "noise", "filter"), config.trusted, config.choices["model"]
    )
    runs = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    return JobPlan(config, model, scenario, RecordingRegime(noise), method, runs)


def apply_global_settings(values: Mapping[str, Any]) -> None:
    """Check the settings of a job, and set threads and memory allocator.

    Args:
        values: Configuration.

    Raises:
        ValueError: If a value is invalid.
    """
    check_settings(values)
    torch.set_num_threads(values["threads"])
    keep_freed_memory()


# parts of a checkout that decide results; analyses read them only
_DECIDING = ("pfbench", "conf", "experiments", "pyproject.toml", "setup.py")
_TIMEOUT = 10  # s, of git


def make_metadata(
    plan: JobPlan, model: StateSpaceModel, steps: int, notes: Sequence[str]
) -> dict[str, Any]:
    """Collect the metadata of a job.

    Returns values that JSON can represent.
    """
    values, method = plan.values, plan.method
    device = values["device"]
    unnamed = describe_unnamed_files(values["scenario"], plan.config.trusted)
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
        "is_exact": method.is_exact or _is_kalman_filter(model, method),
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


def _is_kalman_filter(model: StateSpaceModel, method: Any) -> bool:
    """Return whether a filter is the Kalman filter of a linear model."""
    from pfbench.filter.gaussian.gaussian_filter import GaussianFilter

    return model.linear and isinstance(method, GaussianFilter) and method.plain


def make_provenance() -> dict[str, Any]:
    """Return versions, host and time of creation."""
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return {"versions": read_versions(), "host": platform.node(), "created": created}


def read_versions() -> dict[str, str]:
    """Return the versions that affect the numbers.

    `commit` is that of the checkout or of the wheel, empty without both. `build` is the commit of an unchanged checkout, else a digest of
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
    """Return the commit and the build of this process. A wheel states the commit of its checkout."""
    commit = describe_commit(Path(pfbench.__file__).resolve().parents[1])
    stated = (dist.read_text("COMMIT") for dist in distributions(name="pfbench"))
    commit = commit or (next(stated, None) or "").strip()
    is_clean = commit and not commit.endswith("-dirty")
    return commit, commit if is_clean else f"sources {hash_package()}"


def describe_commit(checkout: Path) -> str:
    """Return the commit of a checkout, with "-dirty" if a tracked file that decides results is changed.

    Pages, reports, analyses and tests do not count.
    """
    if not (checkout / ".git").exists():  # installed, perhaps in the repository of another project
        return ""
    commands = (("rev-parse", "--short", "HEAD"), ("ls-tree", "-rz", "HEAD", "--", *_DECIDING))
    try:
        commit, tree = (_run_git(checkout, *command) for command in commands)
    except (OSError, subprocess.SubprocessError):
        return ""
    is_clean = all(_is_unchanged(checkout, entry) for entry in filter(None, tree.split("\0")))
    return commit if is_clean else f"{commit}-dirty"


def _is_unchanged(checkout: Path, entry: str) -> bool:
    """Return whether a file has the content of its entry in a tree of git, which no filter of a repository decides."""
    stored, _, name = entry.partition("\t")
    file = checkout / name
    content = file.read_bytes() if file.is_file() else b"missing"
    blob = b"blob %d\0%s" % (len(content), content)
    is_same = hashlib.sha1(blob, usedforsecurity=False).hexdigest() == stored.split()[2]
    return is_same or name.startswith("experiments/analyses/")


def _run_git(folder: Path, *words: str) -> str:
    """Run git in a folder, without programs that its settings name, and return its output, empty after an error of git.

    The commands read commits and trees. Neither reads the index or the files, so that neither asks monitors or filters.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}
    safe = ("-c", "core.fsmonitor=false", "-c", "safe.bareRepository=explicit")
    return subprocess.run(
        ["git", "-C", str(folder), *safe, *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=_TIMEOUT,
        env=environment | {"GIT_ALLOW_PROTOCOL": "none", "GIT_OPTIONAL_LOCKS": "0"},
    ).stdout.strip()
