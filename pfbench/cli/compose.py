"""Configurations of commands: sweeps, experiments and descriptions of files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pfbench.config.composition import JobConfig, compose
from pfbench.config.folders import experiments_dir
from pfbench.config.named_sets import expand_filter_sets
from pfbench.config.sweep_check import expand_sweep


def compose_study(words: Sequence[str]) -> JobConfig:
    """Compose the configuration of a study, with its experiment if it exists.

    Args:
        words: Overrides, `study=NAME` among them.

    Returns:
        The configuration.
    """
    config = compose(words)
    study = config.values["study"]
    has_experiment = (experiments_dir() / f"{study}.yaml").exists()
    if "experiment" in given_keys(words) or not has_experiment:
        return config
    return compose([f"+experiment={study}", *words])


def given_keys(words: Sequence[str]) -> set[str]:
    """Return the keys of overrides."""
    return {word.lstrip("+~").partition("=")[0] for word in words}


def count_planned_jobs(study: str) -> int | None:
    """Count the jobs of the sweep of an experiment.

    Args:
        study: Name of the experiment.

    Returns:
        The number, or None if the experiment does not exist or does not define a sweep.
    """
    overrides = read_sweep(study)
    return math.prod(map(len, expand_sweep(overrides))) if overrides else None


def read_sweep(experiment: str) -> list[str]:
    """Read the sweep of an experiment as overrides. Empty if there is none."""
    from omegaconf import OmegaConf

    path = experiments_dir() / f"{experiment}.yaml"
    if not path.exists():
        return []
    params = OmegaConf.select(OmegaConf.load(path), "hydra.sweeper.params") or {}
    return expand_filter_sets([f"{name}={value}" for name, value in params.items()])


def read_description(path: Path) -> str:
    """Read the first comment of a configuration file, its description."""
    lines = path.read_text().splitlines()
    first = next((line for line in lines if not line.startswith("# @package")), "")
    return first.removeprefix("#").strip() if first.startswith("#") else ""
