"""Words for the world in which a filter was tuned: in its name, and in the data that a result stores."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pfbench.config.paper_block import PAPER

OWN_WORLD = "the world of each job"  # data of a tuned filter before a job chooses them
_DATA = re.compile(r"(?:^|\), )(\w+) \(model (\w+)[,)]")  # as `describe_world` writes it
_MARK = re.compile(r" \(tuned(?: on ([^()]*))?\)")


def add_world(name: str, world: str) -> str:
    """Return the name of a tuned filter with the world of its tuning.

    Args:
        name: Name such as "Gated EKF (tuned)".
        world: Words for the world.
    """
    settings = _MARK.search(name)
    tail = name[settings.end() :] if settings else ""
    head = name[: settings.start()] if settings else name
    return f"{head} (tuned on {world}){tail}"


def read_world(name: str) -> str:
    """Return the words for the world in the name of a filter, empty for one without.

    Args:
        name: Name, as `add_world` makes it.
    """
    stated = _MARK.search(name)
    return (stated[1] or "") if stated else ""


def list_tuned_worlds(data: str) -> dict[str, str]:
    """List the worlds that the data of a tuning state: models by scenario.

    Args:
        data: Data of a tuning, as a result stores them; several are separated by commas.
    """
    return dict(_DATA.findall(data))


def find_foreign_world(data: str, scenario: str, model: str = "") -> str:
    """Return the words for the world of a tuning, empty if it is that of the job or not stated.

    Args:
        data: Data of the tuning, as a result stores them.
        scenario: Scenario of the job.
        model: Model of the job, empty if it is not known.
    """
    stated = list_tuned_worlds(data)
    if not stated or (scenario in stated and model in ("", stated[scenario])):
        return ""
    name = scenario if scenario in stated else min(stated)
    return name_world({"scenario": name, "model": stated[name]}, {"scenario": scenario})


def name_world(world: Mapping[str, Any], choices: Mapping[str, str]) -> str:
    """Name the world of a tuning; its model only where the scenario is the same.

    Args:
        world: World of the tuning, as its file states it.
        choices: Names of the chosen files of the job by group.
    """
    scenario, model = world.get("scenario", ""), world.get("model", "another model")
    return f"{scenario} with {model}" if scenario == choices.get("scenario") else f"{scenario}"


def describe_foreign(values: Mapping[str, Any]) -> str:
    """Return " (tuned on WORLD)" for a filter with the knobs of another world; empty for another filter.

    Args:
        values: Resolved configuration of a job.
    """
    words = _MARK.search((values["filter"].get(PAPER) or {}).get("name", ""))
    return f" (tuned on {words[1]})" if words and words[1] else ""
