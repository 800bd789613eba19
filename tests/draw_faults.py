"""Draws candidates for mutants.toml: `python tests/draw_faults.py [--seed N] [--count N] [rooms]`.

A room is a folder of pfbench, or of pfbench/filter. Rooms with few faults come first. Each candidate changes one
number or decision of a function, and no function has more than two faults. Try each before you keep it: a fault that
no test catches asks for an assertion, and one that changes no behaviour is dropped.
"""

from __future__ import annotations

import argparse
import ast
import random
from collections import Counter
from collections.abc import Iterator
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

from mutants import ROOT, pattern_of, read_faults

SEED = 300
TURNED: dict[type[ast.AST], str] = {
    ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in",
}  # fmt: skip
SIGNS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
}  # fmt: skip
TWINS = {
    twin: other
    for pair in (
        *(("min", "max"), ("minimum", "maximum"), ("amin", "amax"), ("argmin", "argmax")),
        *(("any", "all"), ("sin", "cos"), ("ceil", "floor"), ("idxmin", "idxmax")),
        *(("zeros_like", "ones_like"), ("zeros", "ones"), ("nanmin", "nanmax"), ("first", "last")),
        *(("logical_and", "logical_or"), ("cummin", "cummax")),
    )
    for twin, other in (pair, pair[::-1])
}
DROPPED = {"abs", "sqrt", "square", "clamp", "clamp_min", "cumsum", "exp", "log", "nan_to_num"}
DROPPED |= {"sort", "sort_values", "dropna", "flip", "diff", "round", "sorted", "drop_duplicates"}
HARMLESS = (
    "strict",
    "validate_args",
    "keepdim",
    "keepdims",
    "dtype",
    "leave",
    "rtol",
    "atol",
    "indexing",
)
WORDS = ("warn", "print", "echo", "log_", "message", "describe", "write", "error", "text", "format")
SILENT = (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom)


class Candidate(NamedTuple):
    """One fault: the room, file and function, the kind of change, and the text before and after."""

    room: str
    file: str
    function: str
    kind: str
    text: str
    broken: str


class Mutation(NamedTuple):
    """One change of a node: the file, the function, the node, the kind of change and the new text."""

    file: Path
    function: str
    node: ast.expr
    kind: str
    broken: str


@cache
def read(file: Path) -> str:
    """Return the text of a file."""
    return file.read_text()


@cache
def _starts(source: str) -> list[int]:
    return [0, *accumulate(map(len, source.splitlines(keepends=True)))]


def source_of(node: ast.expr, source: str) -> str:
    """Return the text of an expression."""
    start, end = span(node, source)
    return source[start:end]


def span(node: ast.expr, source: str) -> tuple[int, int]:
    """Return where the text of an expression starts and ends."""
    starts = _starts(source)
    ends = (
        (node.lineno, node.col_offset),
        (node.end_lineno or node.lineno, node.end_col_offset or node.col_offset),
    )
    start, end = (
        starts[line - 1]
        + len(source[starts[line - 1] : starts[line]].encode()[:column].decode(errors="ignore"))
        for line, column in ends
    )
    return start, end


def room_of(file: str) -> str:
    """Return the room of a file relative to the checkout."""
    parts = Path(file).parts
    return "/".join(parts[1:3]) if parts[1] == "filter" and len(parts) > 3 else parts[1]


def is_word(node: ast.AST) -> bool:
    """Return whether a node is a message, a note to the reader or a piece of text."""
    if isinstance(node, SILENT):
        return True
    name = ast.unparse(node.func).rsplit(".", 1)[-1] if isinstance(node, ast.Call) else ""
    return any(word in name for word in WORDS) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def walk(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes below one node that can change behaviour, without those of inner functions."""
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "args") and not isinstance(
            node, ast.Call
        ):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not is_word(child):
                yield child
                if not isinstance(child, ast.FunctionDef | ast.ClassDef | ast.Slice):
                    yield from walk(child)


def is_text(node: ast.AST) -> bool:
    """Return whether an expression adds texts."""
    return any(
        isinstance(n, ast.JoinedStr | ast.List | ast.Tuple | ast.Dict | ast.Set)
        or (isinstance(n, ast.Call) and ast.unparse(n.func) in ("Path", "str", "list", "tuple"))
        or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.iter_child_nodes(node)
    )


def _of_binary(node: ast.BinOp, left: str, right: str, whole: str) -> Iterator[tuple[str, str]]:
    if is_text(node):
        return
    between = whole[len(left) : len(whole) - len(right)]
    old, new = SIGNS.get(type(node.op), ("", ""))
    if old and between.count(old) == 1 and whole.startswith(left) and whole.endswith(right):
        yield "sign", left + between.replace(old, new) + right
    if isinstance(node.op, ast.Mult | ast.Div) and isinstance(node.right, ast.Constant):
        yield "factor", left
    if isinstance(node.op, ast.Mult) and isinstance(node.left, ast.Constant):
        yield "factor", right
    if isinstance(node.op, ast.Pow):
        yield "power", left


def _of_call(node: ast.Call, source: str) -> Iterator[tuple[str, str]]:
    function, whole = ast.unparse(node.func), source
    owner, _, name = function.rpartition(".")
    if name in TWINS and whole.count(f"{name}(") == 1:
        yield "twin", whole.replace(f"{name}(", f"{TWINS[name]}(")
    if name in DROPPED:
        operand = node.args[0] if owner in ("", "torch", "math", "np") and node.args else None
        if operand is None and isinstance(node.func, ast.Attribute):
            operand = node.func.value
        if operand is not None:
            yield "dropped", ast.unparse(operand)
    for keyword in node.keywords:
        if (
            keyword.arg not in (None, *HARMLESS)
            and not is_word(keyword.value)
            and len(node.keywords) + len(node.args) > 1
        ):
            rest = [k for k in node.keywords if k is not keyword]
            yield "argument", ast.unparse(ast.Call(node.func, node.args, rest))


def _of_subscript(node: ast.Subscript) -> Iterator[tuple[str, str]]:
    parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    for index in parts:
        if isinstance(index, ast.Constant) and type(index.value) is int:
            number = index.value
            index.value = number - 1 if number else 1
            yield "index", ast.unparse(node)
            index.value = number


def changes(node: ast.AST, source: str) -> Iterator[tuple[ast.expr, str, str]]:
    """Yield the changed node, the kind and the new text of each mutation of one node."""

    def code(part: ast.expr) -> str:
        return source_of(part, source)

    def parts_of(pair: ast.BinOp) -> tuple[ast.BinOp, str, str, str]:
        return pair, code(pair.left), code(pair.right), code(pair)

    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in TURNED:
        sign = TURNED[type(node.ops[0])]
        yield node, "turned", f"{code(node.left)} {sign} {code(node.comparators[0])}"
    elif isinstance(node, ast.BinOp):
        yield from ((node, *change) for change in _of_binary(*parts_of(node)))
    elif isinstance(node, ast.Call):
        yield from ((node, *change) for change in _of_call(node, code(node)))
    elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
        yield from ((node, *change) for change in _of_subscript(node))
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.operand, ast.Constant):
        yield node, "unary", code(node.operand)
    elif isinstance(node, ast.BoolOp):
        word = " or " if isinstance(node.op, ast.And) else " and "
        yield node, "junction", word.join(code(value) for value in node.values)
    elif isinstance(node, ast.IfExp):
        yield node.test, "condition", f"not ({code(node.test)})"
    elif isinstance(node, ast.If):
        check = isinstance(node.body[-1], ast.Raise)
        yield (
            node.test,
            *(("check", "False") if check else ("condition", f"not ({code(node.test)})")),
        )


def place(node: ast.expr, broken: str, source: str) -> tuple[str, str] | None:
    """Return a text that occurs once and holds the node, and that text with the node changed."""
    start, end = span(node, source)
    line_start, line_end = source.rfind("\n", 0, start) + 1, source.find("\n", end)
    above, below = source.rfind("\n", 0, line_start - 1) + 1, source.find("\n", line_end + 1)
    for first, last in ((start, end), (line_start, line_end), (above, line_end), (above, below)):
        text = source[first:last].strip()
        if len(text) > 8 and len(pattern_of(text).findall(source)) == 1:
            return text, (source[first:start] + broken + source[end:last]).strip()
    return None


def mutations(file: Path) -> Iterator[Mutation]:
    """Yield all mutations of a file."""
    source = read(file)
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef) or function.name in ("__repr__", "__str__"):
            continue
        for node in walk(function):
            for change in changes(node, source):
                yield Mutation(file, function.name, *change)


def candidate(mutation: Mutation) -> Candidate | None:
    """Return the entry of a mutation, if it has a text that occurs once and changes it."""
    found = place(mutation.node, mutation.broken, read(mutation.file))
    if not found or pattern_of(found[0]).pattern == pattern_of(found[1]).pattern:
        return None
    name = mutation.file.relative_to(ROOT).as_posix()
    return Candidate(room_of(name), name, mutation.function, mutation.kind, *found)


def holder(fault: dict[str, str], source: str) -> str:
    """Return the function that holds the text of a fault."""
    match = pattern_of(fault["text"]).search(source)
    line = source[: match.start()].count("\n") + 1 if match else 0
    names = [
        f.name
        for f in ast.walk(ast.parse(source))
        if isinstance(f, ast.FunctionDef) and f.lineno <= line <= (f.end_lineno or 0)
    ]
    return names[-1] if names else ""


def draw(seed: int, count: int, rooms: list[str]) -> list[Candidate]:
    """Return up to `count` candidates per room, the rooms with fewest faults first."""
    faults = read_faults().values()
    known = Counter(room_of(f["file"]) for f in faults)
    full = Counter((f["file"], holder(f, (ROOT / f["file"]).read_text())) for f in faults)
    found: dict[str, list[Mutation]] = {}
    for file in sorted((ROOT / "pfbench").rglob("*.py")):
        room = room_of(file.relative_to(ROOT).as_posix())
        if not rooms or room in rooms:
            found.setdefault(room, []).extend(mutations(file))
    chosen: list[Candidate] = []
    for room in sorted(found, key=lambda room: (known[room], room)):
        generator, left = random.Random(f"{seed} {room}"), count
        generator.shuffle(found[room])
        files: Counter[str] = Counter()
        for mutation in found[room]:
            place_of = (mutation.file.relative_to(ROOT).as_posix(), mutation.function)
            if not left or full[place_of] or files[place_of[0]] > count // 4:
                continue
            if one := candidate(mutation):
                chosen.append(one)
                full[place_of] += 1
                files[one.file] += 1
                left -= 1
    return chosen


def main() -> None:
    """Print the seed and the candidates as entries, without their tests."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "rooms", nargs="*", help="folders of pfbench, or filter/<folder>; all by default"
    )
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--count", type=int, default=10, help="candidates per room")
    options = parser.parse_args()
    print(f"# seed {options.seed}")
    for one in draw(options.seed, options.count, options.rooms):
        name = f"{one.function.strip('_')}_{one.kind}"
        print(f'\n[{name}]  # {one.room}: {one.function}\nfile = "{one.file}"')
        print(f"text = '''{one.text}'''\nbroken = '''{one.broken}'''")


if __name__ == "__main__":
    main()
