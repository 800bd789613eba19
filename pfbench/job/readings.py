"""Readings of the papers: one table a paper, whose rows are changes of its central reading.

A row states its level of a factor: `text`, `class`, `why`, `use` (files of other groups), `set` (keys of the world) and `filters`
(settings by the names of filters, several in one key). A name such as `grid_4_and_shift_centred` is a joint reading: levels of
several factors at once. Where two of them set one key, the later in the name counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from copy import deepcopy
from functools import cache, reduce
from typing import Any

import yaml

from pfbench.core.parameter_checks import require
from pfbench.results.paper_block import conf_dir

CENTRAL_READING = "central"
JOINER = "_and_"  # of the levels of a joint reading
_CLASSES = (
    "fitted",
    "ours",
    "cited",
    "printed",
)  # the first one that occurs is that of a joint reading
_OF_ITSELF = ("factor", "class", "why", "filters", "cites", "completions")


@cache
def read_reading_table(paper: str) -> Mapping[str, Mapping[str, Any]]:
    """Read the rows of a paper by name, the central one first."""
    path = conf_dir() / "reading" / f"paper_{paper}.yaml"
    table = yaml.safe_load(path.read_text(encoding="utf-8"))
    levels = {"none": {CENTRAL_READING: table[CENTRAL_READING]}, **table["factors"]}
    return {
        name: {"factor": factor, **row, "filters": dict(_split_names(row.get("filters")))}
        for factor, rows in levels.items()
        for name, row in rows.items()
    }


def _split_names(filters: Mapping[str, Any] | None) -> Iterator[tuple[str, Any]]:
    """Yield name and settings of each filter of keys such as `sir, apf`."""
    for names, settings in (filters or {}).items():
        yield from ((name.strip(), settings or {}) for name in names.split(","))


@cache
def read_reading(paper: str, name: str) -> Mapping[str, Any]:
    """Read a row of a paper, or compose that of a joint reading from its levels."""
    rows = [read_reading_table(paper)[level] for level in name.split(JOINER)]
    if len(rows) == 1:
        return rows[0]
    factors = [row["factor"] for row in rows]
    require(
        len({*factors, "none"}) == len(rows) + 1,
        f"reading/{paper}",
        "join levels of different factors",
        name,
        f"Their factors are {', '.join(factors)}. Leave out one level of a factor that is there twice, and the central one.",
    )
    return {
        "factor": "joint",
        "class": next(grade for grade in _CLASSES if any(row["class"] == grade for row in rows)),
        "why": "levels of several factors at once",
        "text": " ".join(row["text"] for row in rows),
        **{key: reduce(_merge, (row.get(key, {}) for row in rows)) for key in ("filters", "use", "set")},
    }  # fmt: skip


def _merge(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested keys, those of the second last. Another class takes the place of the first with its settings."""
    merged = dict(deepcopy(first))
    for key, value in second.items():
        nested = (
            isinstance(value, Mapping)
            and isinstance(merged.get(key), Mapping)
            and value.get("_target_") in (None, merged[key].get("_target_"))
        )
        merged[key] = _merge(merged[key], value) if nested else value
    return merged


def make_reading(paper: str, name: str) -> dict[str, Any]:
    """Make the content of the file of Hydra of a row."""
    row = read_reading(paper, name)
    overrides = [{f"override /{group}": choice} for group, choice in row.get("use", {}).items()]
    # a level changes the central reading, which comes first
    defaults = [*overrides, "_self_"] if name == CENTRAL_READING else [CENTRAL_READING, "_self_", *overrides]  # fmt: skip
    stated = {key: row[key] for key in _OF_ITSELF if row.get(key)}
    return {"defaults": defaults, "reading": {paper: stated}, **row.get("set", {})}
