"""The stored simulation of decisions: the page shows it, and all wrong words keep their rates."""

from __future__ import annotations

import json
import math
import sys

from checkout import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))  # scripts, not a package
import decisions

STORED = json.loads(decisions.STORE.read_text())


def excess(key: str, names: tuple[str, ...], p: float) -> float:
    """Standard errors by which a stored rate exceeds p."""
    entry = STORED[key]
    rate = sum(entry["counts"].get(name, 0) for name in names) / entry["studies"]
    return (rate - p) / math.sqrt(p * (1 - p) / entry["studies"])


def test_the_page_shows_the_stored_counts() -> None:
    text = decisions.PAGE.read_text()
    assert decisions.page(text, STORED) == text
    assert len(decisions.table(STORED).splitlines()) > 40


def test_wrong_words_keep_their_rates() -> None:
    """All settings were simulated; over 50 of them, 3.5 standard errors allow for chance.

    Skewed noise moves the error of levels to one side, as the page says: two sides together keep it.
    """
    for setting in decisions.SETTINGS:
        for question in decisions.QUESTIONS:
            if question == "b" and setting.worlds == 1:
                continue
            head = f"{decisions.name_of(setting)} | {question}"
            assert STORED[f"{head} | none"]["studies"] >= 500
            assert excess(f"{head} | none", ("pair decided",), 0.05) < 3.5, head
            assert excess(f"{head} | none", ("error better",), 0.025) < 3.5, head
            assert excess(f"{head} | margin", ("error equivalent",), 0.025) < 3.5, head
            if setting.noise == "exponential" and setting.estimate == "levels":
                both = ("more than margin", "claim fails")
                assert excess(f"{head} | margin", both, 0.05) < 3.5, head
                continue
            assert excess(f"{head} | margin", ("more than margin",), 0.025) < 3.5, head
            assert excess(f"{head} | margin", ("claim fails",), 0.025) < 3.5, head


def test_a_chunk_is_repeatable_and_has_power() -> None:
    """The stored counts contain the first chunk, and a large effect is decided."""
    setting = decisions.SETTINGS[0]
    key = f"{decisions.name_of(setting)} | a | large"
    first = decisions.count_words(setting, "a", "large", 0)
    assert first == decisions.count_words(setting, "a", "large", 0)
    assert all(STORED[key]["counts"].get(name, 0) >= count for name, count in first.items())
    assert first["error better"] > 0.9 * decisions.CHUNK
