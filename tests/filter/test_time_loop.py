"""Walks over records and the rule for a first measurement of the initial state, from syntax trees."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from checkout import ROOT

PACKAGE = ROOT / "pfbench"


def is_walk(node: ast.AST) -> bool:
    """Whether a node loops over the time axis of measurements or of a truth."""
    if not isinstance(node, ast.For | ast.comprehension):
        return False
    call = node.iter
    if not (isinstance(call, ast.Call) and ast.unparse(call.func) == "range"):
        return False
    target, length = ast.unparse(node.target), ast.unparse(call)
    return target == "t" or "y.shape[1]" in length


def constructs(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == name


def places(source: str) -> Iterator[str]:
    """Kinds of forbidden code in a module: `walk` or `StaticModel`."""
    for node in ast.walk(ast.parse(source)):
        if is_walk(node):
            yield "walk"
        if constructs(node, "StaticModel"):
            yield "StaticModel"


def test_a_record_is_walked_and_a_model_is_held_still_in_one_place() -> None:
    found = {
        (file.relative_to(PACKAGE).as_posix(), kind)
        for file in PACKAGE.rglob("*.py")
        if "testing" not in file.parts
        for kind in places(file.read_text())
    }
    assert found == {("core/record.py", "walk"), ("model/base.py", "StaticModel")}


def test_a_second_walk_would_be_noticed() -> None:
    walks = [
        "for t in range(record.y.shape[1]): pass",
        "for s in range(y.shape[1]): pass",
        "a = [f(t) for t in range(n)]",
    ]
    assert [list(places(source)) for source in walks] == [["walk"]] * 3
    assert list(places("stage = base.StaticModel(model) if t == 0 else model")) == ["StaticModel"]
    assert (
        list(
            places(
                "for k in range(3): pass\nfor t, m, r in iterate_steps(model, record): isinstance(m, StaticModel)"
            )
        )
        == []
    )
