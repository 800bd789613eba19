"""Worlds of conf/tuned/families/worlds.yaml: the block `tuned` of docs/robustness.md, and `tuned_worlds` of docs/methods/robust.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from runpy import run_path
from typing import Any

import yaml

from pfbench.files import markdown_head, markdown_row

_TABLE = run_path(
    str(Path(__file__).with_name("tuned_table.py"))
)  # also where this folder is not on the path
TABLE, read_candidates = _TABLE["TABLE"], _TABLE["read_candidates"]
METHODS = ("ekf_scaled", "gate", "huber", "student")
NAMES = {"r_factor": "R", "q_factor": "Q"}


def tuned_table(worlds: Mapping[str, str]) -> str:
    """Table of the parameters of tier B, and a sentence on the ends of the grid.

    Args:
        worlds: Data on which a study says that its filters were tuned, by scenario.
    """
    lines = markdown_head("world", "tuned on", *(f"`{method}_tuned`" for method in METHODS))
    largest = at_end = 0
    for world, data in worlds.items():
        name, content = read_tuning(world, data)
        lines.append(
            markdown_row(
                f"`{world}`",
                content["data"]
                if content["world"]["scenario"] == world
                else f"not tuned here: {data}",
                *(describe_choice(name, method, content[method]) for method in METHODS),
            )
        )
        largest += sum(has_largest_factor(name, method, content[method]) for method in METHODS)
        at_end += sum(is_at_end(name, method, content[method]) for method in METHODS)
    number = len(worlds) * len(METHODS)
    return "\n".join([
        *lines, "",
        f"In {largest} of {number} cells the factor on R is the largest of the grid. In {at_end} cells the second parameter is at an end of "
        "its grid. A value beyond may be better still. The control and the other filters have the same number of candidates.",
    ])  # fmt: skip


def read_tuning(world: str, data: str) -> tuple[str, dict[str, Any]]:
    """Read name and entry of a tuning: that of a world, if a study says so, else the one that it names.

    Args:
        world: Scenario.
        data: Data on which the study says that its filters were tuned.

    Raises:
        ValueError: If there is no such entry.
    """
    named = [(name, content) for name, content in read_files().items() if content["data"] in data]
    named.sort(key=lambda entry: entry[1]["world"]["scenario"] != world)
    if not named:
        raise ValueError(
            f"{TABLE} must have an entry of the tuning on {data}, got none. Run pfbench tune."
        )
    return named[0]


def read_files() -> dict[str, dict[str, Any]]:
    """Read the entries of all tunings, by name."""
    return dict(yaml.safe_load(TABLE.read_text()))


def tuned_worlds() -> str:
    """Table of all tuned worlds: the best conventional filter, and whether Kalman filters fit."""
    lines = markdown_head("file", "tuned on", "best", "Kalman filters fit", "SIR", "RPF", "runs")
    for name, content in read_files().items():
        if fit := content.get("fit"):  # an early file states none
            ratios = ("{:.2f} [{:.2f}, {:.2f}]".format(*fit["ratios"][k]) for k in ("sir", "rpf"))
            word = "yes" if content["kalman_fits"] else "no"
            cells = (f"`{content['best']}`", word, *ratios, str(fit["runs"]))
        else:
            cells = ("–", "–", "–", "–", "–")
        lines.append(markdown_row(f"`{name}`", content["data"], *cells))
    return "\n".join(lines)


def describe_choice(name: str, method: str, node: Mapping[str, Any]) -> str:
    """State the parameters of a filter, and the change of its score from tier A in percent.

    Args:
        name: Name of the tuning.
        method: Filter.
        node: Its entry in the tuning.
    """
    candidates = read_candidates(name, method)
    knobs = list(candidates.columns[: candidates.columns.get_loc("log_ratio")])
    chosen = (candidates[knobs] == [node[knob] for knob in knobs]).all(axis=1)
    (log_ratio,), untuned = candidates["log_ratio"][chosen], candidates["log_ratio"].iloc[-1]
    values = ", ".join(f"{NAMES.get(knob, knob)} {node[knob]:g}" for knob in knobs)
    return f"{values} ({100 * math.expm1(log_ratio - untuned):+.0f} %)"


def has_largest_factor(name: str, method: str, node: Mapping[str, Any]) -> bool:
    """Return whether the chosen factor on R is the largest of its grid."""
    return bool(node["r_factor"] == read_candidates(name, method)["r_factor"].max())


def is_at_end(name: str, method: str, node: Mapping[str, Any]) -> bool:
    """Return whether the second parameter of the choice is the smallest or the largest of its grid."""
    candidates = read_candidates(name, method)
    knob = candidates.columns[1]
    return bool(node[knob] in (candidates[knob].min(), candidates[knob].max()))
