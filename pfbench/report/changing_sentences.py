"""Sentences of the methods paragraph that a stored page writes again: particles, and what decides the pairs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

_PARTICLES = re.compile(
    r"Particle filters used .*? particles(, with these exceptions: .*?\))?(?=\. |, chosen)"
)
_EQUAL = re.compile(r"The filters were not given equal time(: particle filters have [^.]*)?\.")
_UNITS = re.compile(
    r"the differences of (these trimmed means|the shares of runs won)(, [^;]*?are not kept)?(?=, paired by run)"
)


def describe_particles(numbers: Mapping[str, Sequence[int]]) -> str:
    """Describe the numbers of particles, with the names of filters that differ.

    Args:
        numbers: Numbers of particles by name of the filter, one filter at least.

    Returns:
        Sentence without its full stop.
    """
    filters: dict[tuple[int, ...], list[str]] = {}
    for name, counts in sorted(numbers.items()):
        filters.setdefault(tuple(sorted(set(counts))), []).append(name)
    usual = max(filters, key=lambda counts: len(filters[counts]))
    listed = {
        counts: f"{_format_counts(counts)} ({', '.join(names)})"
        for counts, names in sorted(filters.items())
    }
    if len(filters) > 1 and 2 * len(filters[usual]) <= len(numbers):
        return f"Particle filters used {join_texts(list(listed.values()), 'and')} particles"
    others = "; ".join(text for counts, text in listed.items() if counts != usual)
    text = f"Particle filters used {_format_counts(usual)} particles"
    return f"{text}, with these exceptions: {others}" if others else text


def describe_equal_particles(numbers: Mapping[str, Sequence[int]]) -> str:
    """State that filters were not given equal time, and whether their numbers of particles are equal.

    Args:
        numbers: Numbers of particles by filter.
    """
    text = "The filters were not given equal time"
    if len(numbers) < 2:
        return f"{text}."
    is_equal = len({frozenset(counts) for counts in numbers.values()}) == 1
    kind = "equal" if is_equal else "different"
    return f"{text}: particle filters have {kind} numbers of particles."


def describe_units(pairs: int, won: int) -> str:
    """Describe the differences that decide the planned pairs.

    Args:
        pairs: Number of planned pairs.
        won: Number of these pairs that are decided by the shares of runs won.
    """
    means, shares = "these trimmed means", "the shares of runs won, since tracks are not kept"
    if won in (0, pairs):
        return f"the differences of {shares if won else means}"
    return f"the differences of {means}, or for {won} of them of {shares}"


def renew_methods(pack: Mapping[str, Any]) -> str:
    """Write the sentences of a stored paragraph again that follow from its particles and its pairs.

    Args:
        pack: Data of the page, with its paragraph.

    Returns:
        The paragraph. Sentences on other facts, which need the results, stay.
    """
    names = {look["key"]: look["name"] for look in pack["filters"]}
    numbers = {
        names[note["filter"]]: list(map(int, note["particles"].split(" or ")))
        for note in pack["filter_notes"]
        if note["particles"]
    }
    won = sum(bool(pair.get("won")) for pair in pack["planned"])
    units = describe_units(len(pack["planned"]), won)
    text = _UNITS.sub(lambda _: units, pack["methods_paragraph"])
    text = _EQUAL.sub(lambda _: describe_equal_particles(numbers), text)
    return _PARTICLES.sub(lambda _: describe_particles(numbers), text) if numbers else text


def join_texts(texts: Sequence[str], word: str) -> str:
    """List texts with a word before the last one.

    Args:
        texts: Texts, one at least.
        word: Word, such as "and".
    """
    return f" {word} ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def _format_counts(counts: Sequence[int]) -> str:
    """Format the numbers of particles of a filter."""
    return join_texts(list(map(str, counts)), "or")
