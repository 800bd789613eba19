"""Readings of the papers: one table a paper, whose rows are changes of its central reading.

A row states its level of a factor: `text`, `class`, `why`, `use` (files of other groups), `set` (keys of the world) and `filters`
(settings by the names of filters, several in one key). A pair is two levels at once: what both set, for the filters that it lists.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from typing import Any

import yaml

from pfbench.results.paper_block import conf_dir

CENTRAL_READING = "central"
_OF_ITSELF = ("factor", "class", "why", "claims", "filters", "cites", "completions")


@cache
def read_reading_table(paper: str) -> Mapping[str, Mapping[str, Any]]:
    """Read the rows of a paper by name, pairs composed of their levels, the central one first."""
    path = conf_dir() / "reading" / f"paper_{paper}.yaml"
    table = yaml.safe_load(path.read_text(encoding="utf-8"))
    rows = {CENTRAL_READING: {"factor": "none", **table[CENTRAL_READING]}}
    for factor, levels in table["factors"].items():
        rows |= {name: {"factor": factor, **row} for name, row in levels.items()}
    for name, row in rows.items():
        filters = row.get("filters") or {}
        split = {
            n.strip(): settings or {} for key, settings in filters.items() for n in key.split(",")
        }
        rows[name] = {**row, "filters": split}
    for name, row in table.get("pairs", {}).items():
        rows[name] = _compose_pair(row, *(rows[level] for level in name.split("_and_")))
    return rows


def _compose_pair(
    row: Mapping[str, Any], first: Mapping[str, Any], second: Mapping[str, Any]
) -> dict[str, Any]:
    """Compose a pair of two levels."""
    both: dict[str, Any] = {"factor": "pair", "class": "ours", "why": "both turn the claim", **row}
    both["filters"] = {
        name: {**first["filters"].get(name, {}), **second["filters"].get(name, {})}
        for name in row.get("filters", ())
    }
    for key in ("use", "set"):
        both[key] = _merge(first.get(key, {}), second.get(key, {}))
    return both


def _merge(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested keys, those of the second last."""
    merged = dict(deepcopy(first))
    for key, value in second.items():
        nested = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if nested else value
    return merged


def make_reading(paper: str, name: str) -> dict[str, Any]:
    """Make the content of the file of Hydra of a row."""
    row = read_reading_table(paper)[name]
    overrides = [{f"override /{group}": choice} for group, choice in row.get("use", {}).items()]
    is_central = name == CENTRAL_READING
    defaults = [*overrides, "_self_"] if is_central else [CENTRAL_READING, "_self_", *overrides]
    stated = {key: row[key] for key in _OF_ITSELF if row.get(key)}
    return {"defaults": defaults, "reading": {paper: stated}, **row.get("set", {})}
