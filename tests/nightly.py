"""Tests that `make test` leaves to `make test-nightly`: those of tests/nightly.txt, most of the time in a few tests."""

import re
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

LIST = Path(__file__).with_suffix(".txt")
COLLECTED: list[tuple[str, bool]] = []  # names of all tests of this process, and whether they wait


class Share(NamedTuple):
    """Cases of a test function that stay: every k-th, or none of them for 0, and those whose names hold a word."""

    each: int
    words: tuple[str, ...] = ()


@cache
def read_list() -> dict[str, Share]:
    """Return by test function which of its cases stay."""
    lines = [line for line in LIST.read_text().splitlines() if line and not line.startswith("#")]
    found = {}
    for name, *rest in map(str.split, lines):
        each = int(rest.pop(0)[2:]) if rest and rest[0].startswith("1/") else 0
        assert name not in found, f"tests/nightly.txt: {name} twice"
        assert not rest or rest[0] == "+", f"tests/nightly.txt: {name} {rest}"
        found[f"tests/{name}"] = Share(each, tuple(rest[1:]))
    return found


def mark(items: list[pytest.Item]) -> None:
    """Mark the listed tests `nightly`, but for the cases that stay."""
    listed, counts = read_list(), Counter[str]()
    COLLECTED.clear()
    for item in items:
        name, _, case = item.nodeid.partition("[")
        waits = False
        if name in listed:
            share = listed[name]
            waits = not share.each or bool(counts[name] % share.each)
            waits &= not any(word in case for word in share.words)
            counts[name] += 1
        if waits:
            item.add_marker(pytest.mark.nightly)
        COLLECTED.append((item.nodeid, waits))


def is_selected(nodeid: str, words: str) -> bool:
    """Return whether `-k` with these words selects a test, by the names of its file and function."""
    file, _, test = nodeid.lower().partition("::")  # an id may hold a slash
    parts = [file.rpartition("/")[2], test]
    terms = re.sub(
        r"[^\s()]+",
        lambda term: (
            term[0]
            if term[0] in ("and", "or", "not")
            else str(any(term[0].lower() in part for part in parts))
        ),
        words,
    )
    return bool(eval(terms))  # True, False, and, or, not and brackets alone
