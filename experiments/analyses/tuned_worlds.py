"""Files that `pfbench tune` wrote: the block `tuned` of docs/robustness.md, and `tuned_worlds` of docs/methods/robust.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from pfbench.files import markdown_head, markdown_row

METHODS = ("ekf_scaled", "gate", "huber", "student")
TUNED = Path(__file__).parents[2] / "conf" / "tuned"
NAMES = {"r_factor": "R", "q_factor": "Q"}


def tuned_table(worlds: Mapping[str, str]) -> str:
    """Table of the parameters of tier B, and a sentence on the ends of the grid.

    Args:
        worlds: Data on which a study says that its filters were tuned, by scenario.
    """
    lines = markdown_head("world", "tuned on", *(f"`{method}_tuned`" for method in METHODS))
    largest = at_end = 0
    for world, data in worlds.items():
        content = read_tuning(world, data)
        lines.append(
            markdown_row(
                f"`{world}`",
                content["data"]
                if content["world"]["scenario"] == world
                else f"not tuned here: {data}",
                *(describe_choice(content[method]) for method in METHODS),
            )
        )
        largest += sum(has_largest_factor(content[method]) for method in METHODS)
        at_end += sum(is_at_end(content[method]) for method in METHODS)
    number = len(worlds) * len(METHODS)
    return "\n".join([
        *lines, "",
        f"In {largest} of {number} cells the factor on R is the largest of the grid. In {at_end} cells the second parameter is at an end of "
        "its grid. A value beyond may be better still. The control and the other filters have the same number of candidates.",
    ])  # fmt: skip


def read_tuning(world: str, data: str) -> dict[str, Any]:
    """Read the file of a tuning: that of a world, if a study says so, else the one that it names.

    Args:
        world: Scenario.
        data: Data on which the study says that its filters were tuned.

    Raises:
        ValueError: If there is no such file.
    """
    named = [content for content in read_files().values() if content["data"] in data]
    named.sort(key=lambda content: content["world"]["scenario"] != world)
    if not named:
        raise ValueError(
            f"{TUNED} must have a file of the tuning on {data}, got none. Run pfbench tune."
        )
    return dict(named[0])


def read_files() -> dict[str, dict[str, Any]]:
    """Read all files of tunings, by name; `auto` and `nominal` only refer to them."""
    contents = {
        path.stem: yaml.safe_load(path.read_text()) for path in sorted(TUNED.glob("*.yaml"))
    }
    return {name: content for name, content in contents.items() if "world" in content}


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


def describe_choice(node: Mapping[str, Any]) -> str:
    """State the parameters of a filter, and the change of its score from tier A in percent.

    Args:
        node: Entry of the filter in the file of a tuning.
    """
    candidates = read_candidates(node)
    knobs = list(candidates.columns[: candidates.columns.get_loc("log_ratio")])
    chosen = (candidates[knobs] == [node[knob] for knob in knobs]).all(axis=1)
    (log_ratio,), untuned = candidates["log_ratio"][chosen], candidates["log_ratio"].iloc[-1]
    values = ", ".join(f"{NAMES.get(knob, knob)} {node[knob]:g}" for knob in knobs)
    return f"{values} ({100 * math.expm1(log_ratio - untuned):+.0f} %)"


def has_largest_factor(node: Mapping[str, Any]) -> bool:
    """Return whether the chosen factor on R is the largest of its grid.

    Args:
        node: Entry of the filter in the file of a tuning.
    """
    return bool(node["r_factor"] == read_candidates(node)["r_factor"].max())


def is_at_end(node: Mapping[str, Any]) -> bool:
    """Return whether the second parameter of the choice is the smallest or the largest of its grid.

    Args:
        node: Entry of the filter in the file of a tuning.
    """
    candidates = read_candidates(node)
    knob = candidates.columns[1]
    return bool(node[knob] in (candidates[knob].min(), candidates[knob].max()))


def read_candidates(node: Mapping[str, Any]) -> pd.DataFrame:
    """Read the candidates of a filter; the last row is the filter of tier A, without parameters.

    Args:
        node: Entry of the filter in the file of a tuning.
    """
    return pd.read_csv(StringIO(node["candidates"]), sep=" ", na_values="-")
