"""One form of refusal, and ranges of numbers."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from refusals import check_refused

from pfbench.core import require, require_range, require_ranges


class Unprintable:
    """A value whose text costs."""

    def __str__(self) -> str:
        raise AssertionError("formatted without need")


def test_what_holds_formats_nothing() -> None:
    require(True, "key", "be so", Unprintable())
    with pytest.raises(AssertionError, match="without need"):
        require(False, "key", "be so", Unprintable())


def test_a_refusal_names_key_requirement_value_and_remedy() -> None:
    check_refused(
        [
            (
                r"^a\.b must be so, got 3\. Do this\.$",
                lambda: require([], "a.b", "be so", 3, "Do this."),
            ),
            (r"^a\.b must be so, got 3\. Change a\.b\.$", lambda: require(0, "a.b", "be so", 3)),
        ],
        remedy=False,
    )


RANGES: dict[str, tuple[list[Any], list[Any], str]] = {
    "(0, 1]": ([1e-300, 1, 1.0], [0, -1, 1.5, math.nan, math.inf, None, "0.5", [0.5]], r"in \(0, 1\]"),
    "[-1, 1) Use 0.": ([-1, 0.9], [1, -2], r"in \[-1, 1\), got .*\. Use 0\."),
    "[0, inf]": ([0, math.inf], [-1e-9, math.nan], "at least 0, got"),
    "(0, inf)": ([5e-324], [0, math.inf], "positive and finite, got"),
    "(2, inf]": ([2.1, math.inf], [2], "above 2, got"),
    "whole [2, inf) Use 3.": ([2, 10**9], [1, 2.0, True, None, "2"], r"a whole number of at least 2, got .* Use 3\."),
    "null or whole [1, inf)": ([None, 1], [0, 1.0, True], "a whole number of at least 1, got"),
    "null or [1e-6, 1e6]": ([None, 1e-6, 1e6], [1e-7, 2e6], r"in \[1e-6, 1e6\], got"),
}  # fmt: skip


@pytest.mark.parametrize("rule", RANGES)
def test_a_range_has_its_numbers_and_no_others(rule: str) -> None:
    inside, outside, words = RANGES[rule]
    for value in inside:
        require_range("key", value, rule)
        require_ranges("part", SimpleNamespace(key=value), key=rule)
    for value in outside:
        with pytest.raises(ValueError, match=rf"^key must be {words}"):
            require_range("key", value, rule)
        with pytest.raises(ValueError, match=rf"^part\.key must be {words}"):
            require_ranges("part", SimpleNamespace(key=value), key=rule)
        with pytest.raises(ValueError, match=rf"^key must be {words}"):
            require_ranges("", SimpleNamespace(key=value), key=rule)


def test_a_rule_that_is_no_interval_is_told_at_once() -> None:
    with pytest.raises(AssertionError, match="must be an interval"):
        require_range("key", 1, "positive")
