"""The sanitizers in a short form, and what the harness makes of their reports."""

from subprocess import CompletedProcess

import pytest

from faults import sanitizers
from faults.tally import FINE

REPORT = "==7==ERROR: AddressSanitizer: heap-buffer-overflow on address 0x1"


@pytest.mark.slow
def test_the_sanitizers_find_nothing_in_random_calls() -> None:
    tally = sanitizers.run("random shapes", 1000, 2)
    if tally.skipped:
        pytest.skip(tally.skipped)
    assert tally.bad == {}, tally.examples
    assert tally.trials == 1000  # `make faults` makes 100 times as many


@pytest.mark.parametrize(
    ("name", "code", "output", "error", "counts"),
    [
        ("random shapes", 1, "", REPORT, {"crash": 1}),
        ("random shapes", 0, "{'computed': 2, 'wrong but computed': 1}", "", {FINE: 2, "false": 1}),
        ("operators' tests", 0, "7 passed, 2 skipped in 1 s", "", {FINE: 7}),
        ("operators' tests", 1, "1 failed, 6 passed in 1 s", REPORT, {FINE: 6, "crash": 1}),
        ("operators' tests", 0, "no tests ran", "", {"crash": 1}),
    ],
)
def test_reports_of_the_sanitizers_are_counted(
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    code: int,
    output: str,
    error: str,
    counts: dict[str, int],
) -> None:
    monkeypatch.setattr(sanitizers.load_plugin(), "find_runtimes", lambda: ["runtime"])
    done = CompletedProcess([], code, output, error)
    monkeypatch.setattr(sanitizers, "run_python", lambda *_: done)
    tally = sanitizers.run(name, 3, 0)
    assert tally.counts == counts
    if error:
        assert next(iter(tally.examples["crash"])).startswith("AddressSanitizer")
