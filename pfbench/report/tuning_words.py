"""Filters with tuned parameters: their numbers, and the sentences that state them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping

from pfbench.config.tuned_knobs import list_tuned_worlds
from pfbench.report.looks import MethodLook
from pfbench.results.job_labels import parse_label

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


def describe_foreign_knobs(tunings: Collection[str], worlds: Collection[str]) -> str:
    """Say that tuned filters of a page were tuned on other worlds; empty if all were tuned on its own.

    Args:
        tunings: Data of the tuning of each filter, empty for a filter without knobs.
        worlds: Keys of the scenarios of the page.
    """
    scenarios = sorted({parse_label(key)[0] for key in worlds})
    stated = {text: list_tuned_worlds(text) for text in tunings}
    foreign = {
        text: [s for s in scenarios if s not in known] for text, known in stated.items() if known
    }
    number = sum(bool(lacking) for lacking in (foreign.get(text) for text in tunings))
    if not number:
        return ""
    names = sorted(
        f"{name} (model {model})"
        for text, lacking in foreign.items() if lacking for name, model in stated[text].items()
    )  # fmt: skip
    several = len({name for lacking in foreign.values() for name in lacking})
    is_single = len(scenarios) == 1
    where = (
        "the world of this study"
        if is_single
        else f"at least {several} of {len(scenarios)} scenarios"
    )
    return (
        f"{NOT_TUNED_HERE} {number} filters have the knobs of {', '.join(names)}, which are not those of {where}. "
        "What is said of them holds for these knobs, until the study has run again with its own."
    )
