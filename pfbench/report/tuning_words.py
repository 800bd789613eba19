"""Filters with tuned parameters: their numbers, and the sentences that state them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from pfbench.report.looks import MethodLook


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
