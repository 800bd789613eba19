"""Nodes `paper` as the installed configuration files state them, without composition."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from pfbench.config.folders import conf_dir
from pfbench.config.paper_block import PAPER
from pfbench.config.tuning_names import OWN_WORLD
from pfbench.results.comparison.baselines import list_planned_pairs
from pfbench.results.job_labels import parse_label

_TUNED_DATA = "${tuned.data}"  # of a filter whose knobs are those of the group `tuned`
_NAME = re.compile(r"\w+")
_NODE = re.compile(rf"^{PAPER}:.*\n(?:[ \t]+.*\n?|[ \t]*\n)*", re.MULTILINE)


@cache
def read_paper_block(group: str, name: str) -> Mapping[str, Any]:
    """Read the node `paper` of an installed file; a variant does not inherit that of its parent.

    Args:
        group: Group of the configuration: scenario, noise or filter.
        name: Name of the file without suffix.

    Returns:
        The node, empty without a file or without a node.
    """
    path = conf_dir() / group / f"{name}.yaml"
    if not _NAME.fullmatch(name) or not path.is_file():
        return {}
    node = _NODE.search(path.read_text(encoding="utf-8"))
    block = (yaml.safe_load(node.group())[PAPER] or {}) if node else {}
    is_open = block.get("tuning") == _TUNED_DATA
    return {**block, "tuning": OWN_WORLD} if is_open else block


def list_named_parts(group: str) -> list[str]:
    """List the names of the installed files of a group."""
    return [path.stem for path in sorted(Path(conf_dir() / group).glob("*.yaml"))]


def plan_installed_pairs(labels: Collection[str]) -> list[tuple[str, str]]:
    """List the planned pairs of filters by the baselines that installed files state.

    Args:
        labels: Labels of filters.
    """
    methods = {parse_label(label)[0] for label in labels}
    blocks = {method: read_paper_block("filter", method) for method in methods}
    tuned = sorted(method for method, block in blocks.items() if block.get("tuning"))
    return list_planned_pairs(
        labels, {method: block.get("baselines", ()) for method, block in blocks.items()}, tuned
    )
