"""Filters with tuned parameters: their numbers, and the sentences that state them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from pfbench.report.looks import MethodLook

NOT_TUNED_HERE = "Not tuned here:"  # start of the line on knobs of another world


def count_tuned(looks: Mapping[str, MethodLook]) -> dict[str, int]:
    """Count the filters with tuned parameters, by the data on which they were tuned.

    Args:
        looks: Looks of all filters of a study.
    """
    return dict(sorted(Counter(look.tuning for look in looks.values() if look.tuning).items()))


def describe_tuning(tuned: Mapping[str, int], filters: int) -> str:
    """Say how many filters have tuned parameters, and on which data; empty if none has.

    Args:
        tuned: Numbers of tuned filters, by the data on which they were tuned.
        filters: Number of all filters.
    """
    return " ".join(
        f"Parameters of {number} of {filters} filters were tuned on {data}."
        for data, number in tuned.items()
    )


def describe_foreign_knobs(worlds: Collection[str]) -> str:
    """Say that tuned filters of a page were tuned on other worlds; empty if none was.

    Args:
        worlds: Words for the other world of each filter, empty for one that was not tuned on another.
    """
    names = sorted({world for world in worlds if world})
    number = sum(bool(world) for world in worlds)
    return (
        f"{NOT_TUNED_HERE} {number} {'filter has' if number == 1 else 'filters have'} the knobs of another world, "
        f"{', '.join(names)}. What is said of them holds for these knobs, until the study has run again with its own."
        if names else ""
    )  # fmt: skip
