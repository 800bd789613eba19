"""Configurations of commands: sweeps, experiments and descriptions of files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.messages import suggest_similar
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


def split_words(
    words: Sequence[str], keys: Sequence[str], required: Sequence[str], usage: str
) -> dict[str, str]:
    """Split words into values by key and check the keys.

    Args:
        words: Words `key=value`.
        keys: Keys that the command has.
        required: Keys that must be set.
        usage: Command with its required words, such as `pfbench cost study=NAME`.

    Returns:
        Values by key.

    Raises:
        ValueError: If a word is not `key=value`, a key is unknown or repeated, or one is missing.
    """
    values: dict[str, str] = {}
    advice = f"See {' '.join(usage.split()[:2])} --help."
    for word in words:
        key, equals, value = word.partition("=")
        if key == "hydra.searchpath":  # a word of the run: a result stores the configuration itself
            continue
        if not equals or not value or key in values:
            raise ValueError(f"words must be key=value, each key once, got {word}. {advice}")
        if key not in keys:
            raise ValueError(
                f"key must be one of {', '.join(keys)}, got {key}.{suggest_similar(key, keys)} {advice}"
            )
        values[key] = value
    for key in required:
        if key not in values:
            raise ValueError(f"{key} must be set. Use: {usage}")
    return values


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
