"""Named sets of filters, which a sweep may name in place of a list, and the seed of tuned ones."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

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


def check_tuned_seed(
    values: Mapping[str, Any], scenario: str | None, tuned: Mapping[str, Any]
) -> None:
    """Check that a job with a tuned filter does not score the seed of the tuning in the same scenario.

    Args:
        values: Configuration of the job.
        scenario: Name of its scenario.
        tuned: Content of the file of the tuning.

    Raises:
        ValueError: If it does.
    """
    world = tuned.get("world", {})
    is_tuned = bool((values["filter"].get("paper") or {}).get("tuning"))
    if is_tuned and (world.get("scenario"), world.get("seed")) == (scenario, values.get("seed")):
        raise ValueError(
            f"seed must not be that of the tuning of the filter in {scenario}, got {values['seed']}. "
            "Set another seed."
        )
