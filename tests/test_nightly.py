"""The list of nightly tests names tests that exist, and leaves the rest to each day."""

import ast
from typing import Any

import nightly
import pytest
from checkout import TESTS


def test_each_line_names_a_test() -> None:
    for name in nightly.read_list():
        path, _, function = name.partition("::")
        tree = ast.parse((TESTS.parent / path).read_text())
        assert function in {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}, name


class Item:
    """A collected test, as far as the list needs it."""

    def __init__(self, nodeid: str) -> None:
        self.nodeid, self.marks = nodeid, list[str]()

    def add_marker(self, mark: pytest.MarkDecorator) -> None:
        self.marks.append(mark.name)


def test_every_kth_case_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        nightly, "read_list", lambda: {"tests/a.py::grid": 3, "tests/a.py::long": 0}
    )
    cases: list[Any] = [Item(f"tests/a.py::grid[{k}]") for k in range(7)]
    others: list[Any] = [Item("tests/a.py::long"), Item("tests/a.py::short")]
    nightly.mark([*cases, *others])
    assert [item.nodeid[-2] for item in cases if not item.marks] == ["0", "3", "6"]
    assert [item.marks for item in others] == [["nightly"], []]
