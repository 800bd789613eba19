"""The list of nightly tests names tests that exist, leaves the rest to each day, and with it a test of each planted fault."""

import ast
from functools import cache
from typing import Any

import mutants
import nightly
import pytest
from checkout import TESTS


@cache
def functions_of(path: str) -> set[str]:
    tree = ast.parse((TESTS.parent / path).read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_each_line_names_a_test() -> None:
    for name in nightly.read_list():
        path, *_, function = name.split("::")
        assert function in functions_of(path), name


class Item:
    """A collected test, as far as the list needs it."""

    def __init__(self, nodeid: str) -> None:
        self.nodeid, self.marks = nodeid, list[str]()

    def add_marker(self, mark: pytest.MarkDecorator) -> None:
        self.marks.append(mark.name)


def test_every_kth_case_and_named_cases_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = {
        "tests/a.py::grid": nightly.Share(3, ("-5",)),
        "tests/a.py::long": nightly.Share(0),
        "tests/a.py::one": nightly.Share(0, ("small",)),
    }
    monkeypatch.setattr(nightly, "read_list", lambda: listed)
    monkeypatch.setattr(nightly, "COLLECTED", [])
    cases: list[Any] = [Item(f"tests/a.py::grid[k-{k}]") for k in range(7)]
    names = ("long", "one[small]", "one[large]", "short")
    others: list[Any] = [Item(f"tests/a.py::{name}") for name in names]
    nightly.mark([*cases, *others])
    assert [item.nodeid[-2] for item in cases if not item.marks] == ["0", "3", "5", "6"]
    assert [item.marks for item in others] == [["nightly"], [], ["nightly"], []]
    assert [waits for _, waits in nightly.COLLECTED[-4:]] == [True, False, True, False]


def test_each_planted_fault_has_a_test_by_day(request: pytest.FixtureRequest) -> None:
    """Of those that its words select; `make mutants` then runs these alone. Checked for the files of this process."""
    if any("::" in word for word in request.config.args):
        pytest.skip("some tests of files alone are collected")
    files = {nodeid.partition("::")[0] for nodeid, _ in nightly.COLLECTED}
    for name, fault in mutants.read_faults().items():
        text, _, words = " ".join(fault["tests"]).partition(" -k ")
        paths = text.split()
        assert all((TESTS.parent / path).is_file() for path in paths), f"{name}: {text}"
        if files >= set(paths):
            tests = [
                waits
                for nodeid, waits in nightly.COLLECTED
                if nodeid.startswith(tuple(f"{path}::" for path in paths))
                and (not words or nightly.is_selected(nodeid, words))
            ]
            assert tests, f"{name}: no test has the words {words}"
            assert not all(tests), f"{name}: all its tests wait for the night"


@cache
def squeeze_file(path: str) -> str:
    return squeeze((TESTS.parent / path).read_text())


def squeeze(text: str) -> str:
    """White space and commas, which a formatter moves."""
    return "".join(text.replace(",", " ").split())


def test_each_planted_fault_is_found_once_in_its_file() -> None:
    """Else it plants nothing, and `make mutants` says so only when somebody runs it."""
    for name, fault in mutants.read_faults().items():
        count = squeeze_file(fault["file"]).count(squeeze(fault["text"]))
        assert count == 1, f"{name}: its text is found {count} times in {fault['file']}"


def test_words_select_as_pytest_does() -> None:
    test = "tests/a/test_of_it.py::test_of_that[Case-2]"
    for words in ("that", "case-2 and not other", "(other or of_it) and test_of", "not (other)"):
        assert nightly.is_selected(test, words), words
        assert nightly.is_selected(test.replace("]", "-../a.b]"), words), words
    for words in ("tests/a", "not that", "other or (that and no_case)"):
        assert not nightly.is_selected(test, words), words
