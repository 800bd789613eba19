"""Check that no study scores the seed of a tuning: installed experiments, and stored results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import yaml

from pfbench.config.composition import JobConfig
from pfbench.config.folders import experiments_dir
from pfbench.results.store import DamagedResultError, read_metadata

_TUNING = "tuning_"  # start of the names of folders with results of a tuning
_SCENARIO = "override /scenario"  # of the defaults of an experiment
_DEFAULT_SEED = 1


def check_seed(world: JobConfig, seed: int) -> None:
    """Check that no study scores a seed in the scenario of a tuning.

    Runs of another window of a recording have other data, so that settings of the scenario are compared
    where they are stored.

    Args:
        world: Configuration of the tuning.
        seed: Seed of the tuning.

    Raises:
        ValueError: If an experiment or a stored result has the scenario with this seed.
    """
    if seed < 0:
        raise ValueError(f"seed must be at least -1000, got {seed - 1000}. Set seed to that of the study.")  # fmt: skip
    scenario = world.choices["scenario"]
    scored = (*_list_experiments(scenario, seed), *_list_results(world, seed))
    for study in scored:
        raise ValueError(
            f"seed + 1000 must be a seed that no study scores in {scenario}, got {seed}, which {study} scores. "
            "Set another seed."
        )


def _list_experiments(scenario: str, seed: int) -> Iterator[str]:
    """Yield the experiments with a scenario and a seed."""
    for path in sorted(experiments_dir().glob("*.yaml")):
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
        sweep = tree.get("hydra", {}).get("sweeper", {}).get("params", {})
        choices = [entry for entry in tree.get("defaults", ()) if isinstance(entry, Mapping)]
        single = ",".join(entry[_SCENARIO] for entry in choices if _SCENARIO in entry)
        scenarios = str(sweep.get("scenario", single)).split(",")
        seeds = str(sweep.get("seed", tree.get("seed", _DEFAULT_SEED))).split(",")
        if scenario in scenarios and str(seed) in seeds:
            yield path.stem


def _list_results(world: JobConfig, seed: int) -> Iterator[str]:
    """Yield the studies with a stored result of a scenario with its settings and a seed."""
    for path in sorted(Path(world.values["results_dir"]).glob("*/*.npz")):
        if path.parent.name.startswith(_TUNING):
            continue
        try:
            config = read_metadata(path)["config"]
        except (DamagedResultError, KeyError):
            continue
        if config.get("seed") == seed and config.get("scenario") == world.values["scenario"]:
            yield path.parent.name
