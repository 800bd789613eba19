"""Readings of the papers: Hydra groups whose files set the world of a paper and, by name, its filters.

A word `reading/001=NAME` chooses conf/reading/paper_001/NAME.yaml: a group of Hydra must not begin with a digit. A file has the package `_global_`. It sets the world by plain keys. Under `reading.NNN` it states `factor`, `class`
(one of `CLASSES`), `why`, and `filters`: settings of named filters, since a job has one of them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

READING = "reading"
CLASSES = ("printed", "cited", "ours", "fitted")
_STATED = {"factor", "class", "why", "filters", "cites", "completions"}


def name_readings(words: Sequence[str]) -> list[str]:
    """Replace the number of a paper by its group: `reading/001=` by `reading/paper_001=`."""
    return [re.sub(r"^(\+*reading/)(\d{3}=)", r"\1paper_\2", word) for word in words]


def apply_readings(tree: Any, choices: Mapping[str, str]) -> None:
    """Apply the settings that the chosen readings have for the filter of a job, and remove their node."""
    from omegaconf import OmegaConf, flag_override

    if READING not in tree:
        return
    node: Any = OmegaConf.to_container(tree[READING], resolve=False)
    with flag_override(tree, ["struct", "readonly"], [False, False]):
        del tree[READING]
        for paper, stated in node.items():
            check_reading(paper, stated)
            settings = (stated.get("filters") or {}).get(choices.get("filter")) or {}
            for key, value in settings.items():
                OmegaConf.update(tree["filter"], key, value, merge=False, force_add=True)


def check_reading(paper: str, stated: Any) -> None:
    """Check what a reading states of itself."""
    key = f"{READING}.{paper}"
    if not isinstance(stated, Mapping) or not {"factor", "class", "why"} <= set(stated) <= _STATED:
        raise ValueError(
            f"{key} must state factor, class and why, perhaps filters, cites and completions, got {stated!r:.120}. "
            "Correct the file."
        )
    if stated["class"] not in CLASSES:
        raise ValueError(
            f"{key}.class must be one of {', '.join(CLASSES)}, got {stated['class']!r}. Choose one."
        )
    filters = stated.get("filters") or {}
    if not isinstance(filters, Mapping) or not all(
        isinstance(v, Mapping) for v in filters.values()
    ):
        raise ValueError(
            f"{key}.filters must give keys and values to names of filters, got {filters!r:.80}. "
            "Write sir: {resampler.ess_threshold: 0.5}."
        )
