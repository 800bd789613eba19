"""The node `paper` of a configuration file: names and limits for reports, not for the computation.

A scenario, a noise regime or a filter may have this node. It is not passed to the class of the part
and does not enter the key of a job.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

PARTS = ("scenario", "noise", "filter")
PAPER = "paper"

# keys of the node by part
_KEYS = {
    "scenario": ("family", "divergence_threshold"),
    "noise": (),
    "filter": (),
}


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
        for key in block:
            if key not in _KEYS[group]:
                names = ", ".join(_KEYS[group]) or "no key"
                raise ValueError(
                    f"{group}.paper must have keys of {names}, got {key!r}. Remove or rename it."
                )
        threshold = block.get("divergence_threshold")
        if threshold is not None and not _is_positive(threshold):
            raise ValueError(
                "scenario.paper.divergence_threshold must be finite and positive, got "
                f"{threshold!r}. Use null for a scenario without this limit."
            )
        family = block.get("family")
        if family is not None and not (isinstance(family, str) and family.strip()):
            raise ValueError(
                f"scenario.paper.family must be a name, got {family!r}. Scenarios of one trajectory "
                "have the same name."
            )


def _is_positive(value: Any) -> bool:
    """Return whether a value is a finite positive number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return is_number and math.isfinite(value) and value > 0.0
