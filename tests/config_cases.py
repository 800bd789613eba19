"""Composed configurations and short episodes of scenarios, for tests of all of conf/."""

import tempfile
from copy import deepcopy
from functools import cache
from pathlib import Path

import torch
import yaml
from omegaconf import DictConfig

from pfbench import job
from pfbench.core.record import Episode, Record, map_inputs
from pfbench.job.config import compose_tree
from pfbench.logs.sky.raw_log import write_raw_log
from pfbench.noise.base import NominalNoise
from pfbench.results.paper_block import list_named_parts, read_part

CONF = job.conf_dir()

SEED, RUNS, STEPS = 1, torch.arange(2), 5

GROUPS = {group: list_named_parts(group) for group in ("filter", "model", "noise", "scenario")}


@cache
def composed(*words: str) -> DictConfig:
    """Compose a configuration, to be read only: equal words are composed once, in 0.25 s."""
    return compose_tree(["checkpoint=untrained", "episode_cache_dir=null", "particles=30", *words])


def truncated(episode: Episode, steps: int = STEPS) -> Episode:
    """Return the first steps of an episode."""
    record = episode.record
    inputs = map_inputs(lambda a: a[:, :steps], record.u)
    truth = {name: value[:, :steps] for name, value in episode.truth.items()}
    cut = Record(record.y[:, :steps], inputs, record.start, record.spread, record.feedback)
    return Episode(cut, episode.time[:steps], truth, None, episode.notes)


WORLDS: dict[str, Episode] = {}


def world(scenario: str) -> Episode:
    """Return five steps of a scenario; a flight is cut, because all of it takes seconds."""
    if scenario not in WORLDS:
        cfg = deepcopy(composed(f"scenario={scenario}"))
        flown = cfg.scenario._target_.endswith("SimulatedFlight")
        if flown:  # its first seconds: 10 s of flight_300s, 20 s of flight_500s
            if "segments" in cfg.scenario.trajectory:
                cfg.scenario.trajectory.segments = cfg.scenario.trajectory.segments[:1]
            elif "duration_s" in cfg.scenario.trajectory:
                cfg.scenario.trajectory.duration_s = 10.0
            cfg.scenario.imu_rate_hz = 20.0
        with tempfile.TemporaryDirectory() as root:
            if scenario == "user_raw_log":  # an example in place of the log of a user
                cfg.scenario.root, cfg.scenario.folder = root, "drive"
                write_raw_log(Path(root) / "drive", 10.0)
            scene = job.instantiate(cfg.scenario)
            WORLDS[scenario] = truncated(scene.draw(NominalNoise(), RUNS, SEED))
    return WORLDS[scenario]


def list_bases(group: str, name: str) -> list[str]:
    """List the names of its group on which a name is built."""
    entries = yaml.safe_load(read_part(group, name)).get("defaults", ())
    return [base for base in entries if isinstance(base, str) and base != "_self_"]


def is_recorded(scenario: str) -> bool:
    """Return whether a scenario, or one that it starts from, reads recorded data."""
    is_own = "${data.root}" in read_part("scenario", scenario)
    return is_own or any(map(is_recorded, list_bases("scenario", scenario)))


RECORDED = [name for name in GROUPS["scenario"] if is_recorded(name)]
