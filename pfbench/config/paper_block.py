"""The node `paper` of a configuration file: names and limits for reports, not for the computation.

A scenario, a noise regime or a filter may have this node. It is not passed to the class of the part
and does not enter the key of a job. It belongs to its own file: a part that another part contains
does not have it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

PARTS = ("scenario", "noise", "filter")
PAPER = "paper"

FAMILIES = ("kalman", "particle", "gaussian", "guided", "swarm", "learned")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">", "p", "h")  # of matplotlib
_COLOUR = re.compile(r"#[0-9a-f]{6}")

# keys of the node by part, each with its requirement
_TEXTS = ("name", "long_name", "words", "unit", "cite", "family", "tuning")
_KEYS = {
    "scenario": ("name", "words", "unit", "family", "divergence_threshold"),
    "noise": ("name", "words", "family"),
    "filter": (
        "name", "long_name", "family", "proposed", "colour", "marker", "cite", "baselines",
        "tuning",
    ),
}  # fmt: skip


def check_paper_blocks(values: Mapping[str, Any]) -> None:
    """Check the nodes `paper` of a configuration.

    Args:
        values: Resolved configuration.

    Raises:
        ValueError: If a key is unknown or a value does not fit.
    """
    for group in PARTS:
        node = values.get(group)
        block = node.get(PAPER) if isinstance(node, Mapping) else None
        if block is None:
            continue
        if not isinstance(block, Mapping):
            raise ValueError(f"{group}.paper must be a dictionary, got {block!r}. Remove it.")
        for key, value in block.items():
            _check_key(group, key, value)


def remove_nested_blocks(values: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the nodes `paper` of parts that other parts contain, such as a guide filter.

    Args:
        values: Resolved configuration.

    Returns:
        Configuration with the nodes of scenario, noise and filter themselves only.
    """
    return {
        key: {k: v if k == PAPER else remove_all_blocks(v) for k, v in node.items()}
        if key in PARTS and isinstance(node, Mapping)
        else node
        for key, node in values.items()
    }


def remove_all_blocks(node: Any) -> Any:
    """Remove all nodes `paper` from a part, those of parts inside it included.

    Args:
        node: Part of a resolved configuration.

    Returns:
        The part without these nodes.
    """
    if isinstance(node, list):
        return [remove_all_blocks(item) for item in node]
    if not isinstance(node, Mapping):
        return node
    return {key: remove_all_blocks(value) for key, value in node.items() if key != PAPER}


def _check_key(group: str, key: str, value: Any) -> None:
    """Check one value of a node."""
    if key not in _KEYS[group]:
        names = ", ".join(_KEYS[group])
        raise ValueError(
            f"{group}.paper must have keys of {names}, got {key!r}. Remove or rename it."
        )
    requirement = _requirement(group, key, value)
    if requirement:
        raise ValueError(f"{group}.paper.{key} must be {requirement}, got {value!r}. Change it.")


def _requirement(group: str, key: str, value: Any) -> str:
    """Return the requirement that a value does not meet, empty if it does."""
    if value is None:
        return ""
    if key == "divergence_threshold" and not _is_positive(value):
        return "finite and positive, or null for a scenario without this limit"
    if key in _TEXTS and not isinstance(value, str):
        return "a text"
    if key in ("name", "family") and not value.strip():
        return "a name"
    if group == "filter" and key == "family" and value not in FAMILIES:
        return f"one of {', '.join(FAMILIES)}"
    if key == "proposed" and not isinstance(value, bool):
        return "true or false"
    if key == "marker" and value not in MARKERS:
        return f"one of {' '.join(MARKERS)}"
    if key == "colour" and not _is_colour_pair(value):
        return "two colours such as '#0b4f8a', for white and for dark ground"
    if key == "baselines" and not _is_list_of_names(value):
        return "a list of filters"
    return ""


def _is_colour_pair(value: Any) -> bool:
    """Return whether a value is a list of two colours."""
    return _is_list_of_names(value) and len(value) == 2 and all(map(_COLOUR.fullmatch, value))


def _is_list_of_names(value: Any) -> bool:
    """Return whether a value is a list of texts."""
    return isinstance(value, list | tuple) and all(isinstance(item, str) for item in value)


def _is_positive(value: Any) -> bool:
    """Return whether a value is a finite positive number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and math.isfinite(value) and value > 0.0
