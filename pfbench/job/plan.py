"""Plan of a job: a checked configuration, its settings and objects, and what a report states about it."""

from __future__ import annotations

import copy
import math
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import pfbench
from pfbench.core.parameter_checks import RUN_NUMBERS
from pfbench.core.record import Episode
from pfbench.filter.exactness import has_bounded_weights, has_covariance, has_evidence
from pfbench.filter.loop import choose_run_batch
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.config import JobConfig
from pfbench.job.inputs import describe_unnamed_files, find_inputs, names_checkpoint
from pfbench.job.memory import keep_freed_memory
from pfbench.job.model_fit import instantiate_parts
from pfbench.job.trust import hash_package
from pfbench.model.base import StateSpaceModel
from pfbench.results import store
from pfbench.results.paper_block import PAPER, PARTS
from pfbench.results.store import PLACE_SETTINGS, Inputs, compute_config_key, extend_key
from pfbench.scenario.base import RecordingRegime, Scenario

# --------------------------------------------------------------------------------------------------
# Plan of a job: a checked configuration and its objects, each built once.

#: paths of the configuration that do not enter the key of a job
IGNORED_IN_KEY = (
    *PLACE_SETTINGS,
    *(f"{group}.{PAPER}" for group in PARTS),  # names and limits for reports
    "particles",  # part of the key where a filter uses it, as filter.particles
)
# settings of a comparison that are part of the key only if they differ from the default
DEFAULTS_NOT_IN_KEY: Mapping[str, Any] = {"budget": store.SAME_N}


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

    def choose_run_batch(self, method: Any, runs: int, is_compiled: bool = False) -> int:
        """Choose how many runs are stepped together. On a GPU all runs are.

        Args:
            method: Filter.
            runs: Number of runs.
            is_compiled: Whether its step may be compiled as a whole.
        """
        if self.values["device"] != "cpu" or not isinstance(method, ParticleFilter):
            return runs
        compiled_type = self.dtype if is_compiled else None
        return choose_run_batch(runs, method.particles, self.model.chart.size, compiled_type)

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


def job_key(values: Mapping[str, Any], inputs: Inputs | None = None) -> str:
    """Compute the key of a job from all that affects its results.

    That is its settings and the content of all files that it reads, a user's classes included. The source
    code of pfbench is not part of it: reports refuse results of several builds.

    Args:
        values: Resolved configuration.
        inputs: Inputs of the job, see `find_inputs`. None to find them.

    Returns:
        16 hexadecimal digits. The first half depends on the settings alone.
    """
    inputs = find_inputs(values) if inputs is None else inputs
    if names_checkpoint(values.get("filter")):
        from pfbench.filter.learned.checkpoint import replace_checkpoint_by_hash

        values = {**values, "filter": replace_checkpoint_by_hash(values["filter"])}
    defaults = (k for k, default in DEFAULTS_NOT_IN_KEY.items() if values.get(k) == default)
    return extend_key(compute_config_key(values, (*IGNORED_IN_KEY, *defaults)), inputs)


# --------------------------------------------------------------------------------------------------
# Settings of a job that do not belong to one of its objects: seed, threads, precision, device, engine.


def check_settings(values: Mapping[str, Any]) -> None:
    """Check the settings of a job that do not belong to one of its objects."""
    valid = {
        **{
            key: type(values[key]) is int and least <= values[key] <= _MOST.get(key, math.inf)
            for key, least in _INTEGERS.items()
        },
        "overwrite": type(values.get("overwrite", False)) is bool,
        "oracle_noise": type(values["oracle_noise"]) is bool,
        "pcrb": values["pcrb"] in (True, False, "auto"),
        "memory_limit_gib": _is_memory_limit(values["memory_limit_gib"]),
        "dtype": values["dtype"] in ("float32", "float64"),
        "budget": values["budget"] in store.BUDGETS,
        "engine": values["engine"] in ("auto", "eager", "kernels", "compiled"),
        "device": re.fullmatch(r"cpu|cuda(:\d{1,3})?", str(values["device"])) is not None,
    }
    for key, (requirement, example) in _REQUIREMENTS.items():
        if not valid[key]:
            remedy = _advise_integer(key, values[key]) or f"Set {key}={example}."
            raise ValueError(f"{key} must be {requirement}, got {values.get(key)}. {remedy}")
    if values["first_run"] + values["runs"] > RUN_NUMBERS:
        raise ValueError(
            f"first_run + runs must be at most 2**32 = {RUN_NUMBERS}, got {values['first_run']} + "
            f"{values['runs']}. Larger run numbers would repeat random numbers: use another seed."
        )
    device, count = values["device"], torch.cuda.device_count()
    if device != "cpu" and (torch.device(device).index or 0) >= count:
        raise ValueError(
            f"device must be cpu or one of {count} CUDA devices, got {device}. Use device=cpu."
        )


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


_LARGEST = 1_000_000_000  # a number that is advised
_INTEGERS = {"runs": 1, "first_run": 0, "threads": 1, "seed": 0, "score_steps": 0}  # with minimum
_EXAMPLES = {"runs": 100, "first_run": 0, "threads": 1, "seed": 1, "score_steps": 10}
# threads beyond the cores only wait, and OpenMP ends the process with a fault if there are many
_MOST = {"threads": max(256, os.cpu_count() or 1)}
_REQUIREMENTS = {  # requirement and valid value by key
    **{
        key: (
            f"a whole number of at least {least}" + f", at most {_MOST.get(key)}" * (key in _MOST),
            str(_EXAMPLES[key]),
        )
        for key, least in _INTEGERS.items()
    },
    "oracle_noise": ("true (the filter receives the true noise regime) or false", "false"),
    "overwrite": ("true (repeat finished jobs) or false", "false"),
    "pcrb": ("auto (where the model's distributions are the simulated ones), true or false", "auto"),
    "memory_limit_gib": ("the GiB that the job may use, or null for most of the free memory", "null"),
    "dtype": ("float64 (default) or float32", "float64"),
    "budget": (f"one of {', '.join(store.BUDGETS)}", store.SAME_N),
    "engine": ("auto, eager, kernels or compiled", "auto"),
    "device": ("cpu, cuda, or one of several GPUs such as cuda:1", "cpu"),
}  # fmt: skip


def _advise_integer(key: str, value: Any) -> str:
    """Return how a whole number is written that was given as 1e9 or 10.0; empty for other values."""
    if key not in _INTEGERS or not isinstance(value, float) or not value.is_integer():
        return ""
    if abs(value) > _LARGEST:
        return f"Choose at most {_LARGEST}."
    return f"Write it without exponent and without a decimal point: {key}={int(value)}."


def _is_memory_limit(value: Any) -> bool:
    """Return whether a value is a memory limit: a positive number, or None."""
    return value is None or (type(value) in (int, float) and 0 < value < math.inf)


# --------------------------------------------------------------------------------------------------
# Metadata of a job: all that a report states about how its results were computed.

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


def _is_kalman_filter(model: StateSpaceModel, method: Any) -> bool:
    """Return whether a filter is the Kalman filter of a linear model."""
    from pfbench.filter.gaussian.gaussian_filter import GaussianFilter

    return model.linear and isinstance(method, GaussianFilter) and method.plain


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

    Pages, reports, analyses and tests do not count.
    """
    present = [name for name in _DECIDING if (checkout / name).exists()]
    commands = (
        ("rev-parse", "--show-cdup", "--short", "HEAD"),  # the first is empty at the top
        ("diff", "--no-ext-diff", "--name-only", "HEAD", "--", *present, ":!experiments/analyses"),
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
