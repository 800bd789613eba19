"""Named sets of filters, which a sweep may name in place of a list."""

from __future__ import annotations

import re
from collections.abc import Sequence

SUFFIX = "tuned"  # end of the names of the tuned filters
TUNED_METHODS = ("ekf_scaled", "gate", "huber", "student")
FILTER_SETS = {"tuned_baselines": tuple(f"{method}_{SUFFIX}" for method in TUNED_METHODS)}


def expand_filter_names(names: str) -> str:
    """Replace named sets in a list of filters.

    Args:
        names: Names of filters and sets, separated by commas.

    Returns:
        Names of filters, each once.
    """
    members = [FILTER_SETS.get(name.strip(), (name,)) for name in names.split(",")]
    return ",".join(dict.fromkeys(name for several in members for name in several))


def expand_filter_sets(words: Sequence[str]) -> list[str]:
    """Replace named sets in the overrides of a sweep.

    Args:
        words: Overrides and flags.

    Returns:
        The words, `filter=tuned_baselines` as the list of its filters.
    """
    return [
        f"filter={expand_filter_names(word.removeprefix('filter='))}"
        if re.match(r"filter=[\w,]+$", word) and set(word[7:].split(",")) & set(FILTER_SETS)
        else word
        for word in words
    ]
