"""Tests that `make test` leaves to `make test-nightly`: those of tests/nightly.txt, half of the time in a few tests."""

from collections import Counter
from functools import cache
from pathlib import Path

import pytest

LIST = Path(__file__).with_suffix(".txt")


@cache
def read_list() -> dict[str, int]:
    """Return by test function which share of its cases stays: every k-th; 0 for none."""
    lines = [line for line in LIST.read_text().splitlines() if line and not line.startswith("#")]
    names = (line.partition(" 1/") for line in lines)
    return {f"tests/{name}": int(share or 0) for name, _, share in names}


def mark(items: list[pytest.Item]) -> None:
    """Mark the listed tests `nightly`, but for every k-th case where the list says so."""
    listed, counts = read_list(), Counter[str]()
    for item in items:
        name = item.nodeid.partition("[")[0]
        if name in listed:
            share = listed[name]
            if not share or counts[name] % share:
                item.add_marker(pytest.mark.nightly)
            counts[name] += 1
