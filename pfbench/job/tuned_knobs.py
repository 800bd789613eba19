"""Knobs of tuned filters: those of the job's own world, or of another world, which the filter's name then says."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.results.paper_block import PAPER, add_world, conf_dir, name_world

TUNED = "tuned"  # group of the knobs that `pfbench tune` chose, which no job stores
AUTO, NOMINAL = "auto", "nominal"  # choices that look up the world of the job
SEED_SHIFT = 1000  # seed of a tuning minus seed of the study
_WORLD = ("scenario", "model")  # groups that a tuning and its jobs have in common
# names, places of data, and the part of a recording: a tuning takes another part than the scored one
_NOT_A_SETTING = (PAPER, "root", "cache_dir", "start_s", "end_s")
_PLACES = ("own", "with_model", "own_nominal", "with_model_nominal")  # of conf/tuned/auto.yaml
_REFERENCE = re.compile(r"\$\{\.*tuned\.(\w+)")


def select_knobs(tree: Any, choices: Mapping[str, str], trusted: Sequence[str]) -> None:
    """Replace the node `tuned` by the knobs of one world."""
    from omegaconf import OmegaConf, flag_override

    if TUNED not in tree:
        return
    plain = OmegaConf.to_container(tree["filter"], resolve=False)
    needed = sorted({*_REFERENCE.findall(repr(plain))} - {"data"})
    knobs = _find_world(tree[TUNED], choices) if needed else {}
    lacking = [name for name in needed if "unsupported" in knobs.get(name, {"unsupported": ""})]
    if lacking:
        reason = (knobs.get(lacking[0]) or {}).get("unsupported")
        raise ValueError(
            f"filter={choices['filter']} must have knobs of {choices['scenario']}, got none, since {reason} "
            "Choose another filter." if reason else _refuse(choices, trusted, lacking, knobs.get("world"))
        )  # fmt: skip
    with flag_override(tree, ["struct", "readonly"], [False, False]):
        tree[TUNED] = knobs


def _find_world(node: Any, choices: Mapping[str, str]) -> dict[str, Any]:
    """Return the content of the chosen file, or of the first one of the world of the job."""
    from omegaconf import OmegaConf

    choice = choices.get(TUNED, AUTO)
    content: Any = OmegaConf.to_container(node, resolve=False)
    if choice not in (AUTO, NOMINAL):
        return {"world": {"scenario": choice}, "data": choice, **content}
    loose = min({*content} - {*_PLACES}, default="")
    remedy = f"Choose the file that it changes: {TUNED}=NAME (pfbench list {TUNED})."
    require(not loose, f"{TUNED}.{loose}", "be in a file", f"a value with {TUNED}={choice}", remedy)
    worlds = [world for world in content.values() if _is_of(world.get("world", {}), choices)]
    if choice == NOMINAL:
        worlds = [world for world in worlds if world["world"].get("regimes") == [NOMINAL]]
    return dict(worlds[0]) if worlds else {}


def _is_of(world: Mapping[str, Any], choices: Mapping[str, str]) -> bool:
    """Return whether scenario and model of a tuning are those of a job."""
    return all(world.get(group) == choices.get(group) for group in _WORLD)


def _refuse(
    choices: Mapping[str, str],
    trusted: Sequence[str],
    lacking: Sequence[str],
    world: Mapping[str, Any] | None,
) -> str:
    """Word the refusal of a job without knobs, with the command that makes them.

    A world with a file that lacks some filters is tuned for these with the runs of the file.
    """
    from pfbench.job.config import TUNED_METHODS  # which imports this module

    scenario, model, choice = (choices.get(key, "") for key in ("scenario", "model", TUNED))
    folders, words = _read_command()
    words = [
        word
        for word in words
        if re.match(r"\+{0,2}(scenario\.|model\.|experiment=|data\.root=)", word)
    ]
    is_found = folders or Path("conf").resolve() == conf_dir()
    again = "" if is_found else ", and add 'hydra.searchpath=[file://conf]' to the words of the run"
    if world:
        words = [
            *world.get("settings", ()),
            *(word for word in words if word.startswith("data.root=")),
        ]
        words += [f"runs={world['runs']}", f"seed={world['seed'] - SEED_SHIFT}"]
        words += [f"noise={','.join(world['regimes'])}", f"filter={','.join(lacking)}"]
        words += [f"report.start_time_s={world['start_time_s']:g}"] if world["start_time_s"] else []
        if not is_found:  # a file of this name is pfbench's own
            words += [f"name=my_{scenario}"]
            again += f" with tuned=my_{scenario}"
    else:
        others = sorted({*lacking} - {*TUNED_METHODS})
        words += [f"filter={','.join((*TUNED_METHODS, *others))}"] if others else []
        words += ["noise=nominal"] if choice == NOMINAL else []
    words += [f"trust=[{','.join(trusted)}]"] if trusted else []
    words += [f"hydra.searchpath=[{','.join(folders)}]"] if folders else []
    command = shlex.join(["pfbench", "tune", f"scenario={scenario}", f"model={model}", *words])
    return (
        f"{TUNED}={choice or AUTO} must find the knobs of filter={choices.get('filter')} for scenario={scenario} "
        f"with model={model}, got none. Choose {TUNED}=WORLD (pfbench list {TUNED}), which the names of the "
        f"filters then state, or make them{again}: {command}"
    )


def _read_command() -> tuple[list[str], list[str]]:
    """Return the folders of the search path and the words of the composition, as Hydra holds them."""
    from hydra.core.hydra_config import HydraConfig

    state: Any = HydraConfig.instance().cfg
    if state is None:
        return [], []
    folders = [
        f"file://{source.path}" for source in state.hydra.runtime.config_sources
        if source.schema == "file" and Path(source.path) != conf_dir()
    ]  # fmt: skip
    return folders, [str(word) for word in state.hydra.overrides.task]


def mark_foreign(
    values: Mapping[str, Any],
    choices: Mapping[str, str],
    world: Mapping[str, Any],
    trusted: Sequence[str] = (),
) -> None:
    """Say in the name of a tuned filter on which other world it was tuned."""
    block = values["filter"].get(PAPER) or {}
    if not world or not block.get("tuning"):  # a filter may state its own factors and their data
        return
    text = ""
    if not _is_of(world, choices):
        text = name_world(world, choices)
    elif not _has_settings(values, world, trusted):
        text = f"{world['scenario']} with other settings"
    if text:
        block |= {key: add_world(block[key], text) for key in ("name", "long_name") if key in block}


def _has_settings(
    values: Mapping[str, Any], world: Mapping[str, Any], trusted: Sequence[str]
) -> bool:
    """Return whether scenario and model of a job have the settings of a tuning."""
    words = [f"scenario={world['scenario']}", f"model={world['model']}", *world.get("settings", ())]
    words += [f"hydra.searchpath=[{','.join(folders)}]"] if (folders := _read_command()[0]) else []
    words += [f"trust=[{','.join(trusted)}]"] if trusted else []
    tuned = _compose_world(tuple(words))
    return all(_list_settings(values[group]) == _list_settings(tuned[group]) for group in _WORLD)


@cache
def _compose_world(words: tuple[str, ...]) -> Mapping[str, Any]:
    """Compose the world of a tuning."""
    from pfbench.job.config import compose  # which imports this module

    return compose([*words, "filter=ekf"]).values


def _list_settings(node: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a scenario or model, without where and which part of its data it takes."""
    return {key: value for key, value in node.items() if key not in _NOT_A_SETTING}


def check_tuned_seed(
    values: Mapping[str, Any], scenario: str | None, tuned: Mapping[str, Any]
) -> None:
    """Check that a job with a tuned filter does not score the seed of the tuning in the same scenario."""
    world = tuned.get("world", {})
    is_tuned = bool((values["filter"].get(PAPER) or {}).get("tuning"))
    if is_tuned and (world.get("scenario"), world.get("seed")) == (scenario, values.get("seed")):
        raise ValueError(
            f"seed must not be that of the tuning of the filter in {scenario}, got {values['seed']}. "
            "Set another seed."
        )
