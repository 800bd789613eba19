"""Names and prose of the package and its documents.

The rules are those of the house: nouns for values, one word per concept, `Args:` for public functions,
sentences of at most 30 words and plain words. Each check is a function of a syntax tree or a text.
"""

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from checkout import ROOT, list_published

PACKAGE = ROOT / "pfbench"
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *(f / "report.md" for f in list_published() if f.name.startswith("learn_")),  # no template
]
TEMPLATES = sorted(PACKAGE.rglob("*.jinja"))
PICTURES = ROOT / "experiments" / "analyses" / "method_pictures.py"
SCRIPTS = [*sorted((ROOT / "experiments").glob("*.py")), PICTURES]
PROSE_CHECKS = ("long sentences", "openings", "archaic phrases", "messages")
LONGEST_SENTENCE = 30  # words

CHECK_NAMES = (
    "banned names",
    "single letters",
    "functions without Args",
    "long sentences",
    "openings",
    "archaic phrases",
    "messages",
    "long sentences in documents",
    "archaic phrases in documents",
)

BANNED = set(
    [
        "found",
        "seen",
        "own",
        "known",
        "kept",
        "left",
        "held",
        "one",
        "other",
        "each",
        "whole",
        "part",
        "told",
        "said",
        "asked",
        "heard",
        "there",
        "here",
        "apart",
        "beside",
        "beyond",
        "together",
        "wanted",
        "given",
        "chosen",
        "drawn",
        "shown",
        "made",
        "taken",
        "sent",
        "moved",
        "named",
        "begun",
        "what",
        "who",
        "why",
        "which",
        "how",
        "heft",
        "hit",
        "place",
        "law",
        "like",
        "metas",
        "arrays",
    ]
)
# symbols of the field, as defined in the guide of names; `_` stands for an unused value
LETTERS = set(
    [
        "x",
        "y",
        "u",
        "w",
        "p",
        "q",
        "r",
        "f",
        "h",
        "s",
        "t",
        "n",
        "k",
        "i",
        "j",
        "z",
        "d",
        "m",
        "a",
        "b",
        "c",
        "g",
        "e",
        "v",
        "_",
    ]
)
OPENINGS = re.compile(r"(Of|What|Whether|The same|How|Where|Who|That)\b")
ARCHAIC = re.compile(
    r"\b(?:(?:is|are|was|has|have) no (?!more|less)|of which|whose own|by which|nobody|whoever|"
    r"what (?:it|they) (?:is|are|was)|what is seen|anew|apiece|beside|likewise|but for|save for|"
    r"for want of|to be had|as it is|knows|tells|told|beaten by|goes on|stands)\b",
    re.IGNORECASE,
)
MESSAGE = re.compile(r"\b(must|is not|are not|does not|do not|cannot|expected|needs?|requires?)\b")
COMMENT = re.compile(r"(?:^|\s)# ([^\n]*)$", re.MULTILINE)

Function = ast.FunctionDef | ast.AsyncFunctionDef


@cache
def nodes_of(tree: ast.AST) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree))


def stored_names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of all variables, arguments and attributes that are assigned."""
    for node in nodes_of(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg


def banned_names(tree: ast.AST) -> Iterator[str]:
    yield from (f"{line}: {name}" for line, name in stored_names(tree) if name in BANNED)


def single_letters(tree: ast.AST) -> Iterator[str]:
    for line, name in stored_names(tree):
        if len(name) == 1 and name.islower() and name not in LETTERS:
            yield f"{line}: {name}"


def public_functions(tree: ast.AST) -> Iterator[Function]:
    """Yield the public functions and methods, without overrides, overloads and nested functions."""
    for node in getattr(tree, "body", []):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node)
        elif isinstance(node, Function) and not node.name.startswith("_") and not inherits(node):
            yield node


def inherits(function: Function) -> bool:
    """Return whether a function takes its documentation from another one."""
    marks = [ast.unparse(decorator) for decorator in function.decorator_list]
    return any(mark.endswith(("override", "overload")) for mark in marks)


def functions_without_args(tree: ast.AST) -> Iterator[str]:
    for function in public_functions(tree):
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
        count = len([argument for argument in arguments if argument.arg not in ("self", "cls")])
        if count >= 2 and "Args:" not in (ast.get_docstring(function) or ""):
            yield f"{function.lineno}: {function.name}"


@cache
def docstrings(tree: ast.AST) -> list[tuple[int, str]]:
    texts = []
    for node in nodes_of(tree):
        if isinstance(node, ast.Module | ast.ClassDef | Function):
            text = ast.get_docstring(node)
            if text is not None:
                texts.append((getattr(node, "lineno", 1), text))
    return texts


def openings(tree: ast.AST) -> Iterator[str]:
    yield from (
        f"{line}: {text.splitlines()[0]}" for line, text in docstrings(tree) if OPENINGS.match(text)
    )


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a docstring or a Markdown text; code and tables are left out."""
    text = re.sub(r"```.*?```|<!--.*?-->|\{%.*?%\}|\{#.*?#\}", "\n\n", text, flags=re.DOTALL)
    text = re.sub(r"`[^`]*`|\{\{.*?\}\}", "code", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    text = re.sub(r"^\s*(\||#|>>>|\.\.\. ).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^\s*([-*]|\d+\.|\*{0,2}\w+( \([^)]*\))?:)\s", "\n\n", text, flags=re.MULTILINE)
    for paragraph in re.split(r"\n\s*\n", text):
        yield from re.split(r"(?<=[.!?:])\s+(?=[A-Z\[(0-9]|code)", " ".join(paragraph.split()))


def long_sentences(text: str) -> Iterator[str]:
    for sentence in sentences(text):
        words = [word for word in sentence.split() if re.search(r"[A-Za-z0-9]", word)]
        if len(words) > LONGEST_SENTENCE:
            yield f"{len(words)} words: {sentence[:60]}"


def archaic_phrases(text: str) -> Iterator[str]:
    prose = re.sub(r"```.*?```|`[^`\n]*`", "code", text, flags=re.DOTALL)
    for match in ARCHAIC.finditer(prose):
        yield " ".join(prose[max(0, match.start() - 20) : match.end() + 20].split())


def long_docstring_sentences(tree: ast.AST) -> Iterator[str]:
    for line, text in docstrings(tree):
        yield from (f"{line}: {sentence}" for sentence in long_sentences(text))


def literal(text: ast.expr) -> str:
    """Return the text of a literal; a value in it becomes {}."""
    if isinstance(text, ast.JoinedStr):
        return "".join(map(literal, text.values))
    return text.value if isinstance(text, ast.Constant) and isinstance(text.value, str) else "{}"


def messages(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the literal texts of raised errors; a value in a text becomes {}."""
    for node in nodes_of(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "require":
            key, must, got, *remedy = (literal(argument) for argument in node.args[1:])
            yield node.lineno, f"{key} must {must}, got {got}. {''.join(remedy)}"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            text = literal(node.exc.args[0])
            yield from [(node.lineno, text)] if text != "{}" else ()


def messages_without_requirement(tree: ast.AST) -> Iterator[str]:
    yield from (f"{line}: {text}" for line, text in messages(tree) if not MESSAGE.search(text))


def archaic_docstrings_and_messages(tree: ast.AST) -> Iterator[str]:
    for line, text in (*docstrings(tree), *messages(tree)):
        yield from (f"{line}: {phrase}" for phrase in archaic_phrases(text))


def archaic_comments(source: str) -> Iterator[str]:
    yield from archaic_phrases("\n\n".join(COMMENT.findall(source)))


CHECKS: dict[str, Callable[[ast.AST], Iterator[str]]] = {
    "banned names": banned_names,
    "single letters": single_letters,
    "functions without Args": functions_without_args,
    "long sentences": long_docstring_sentences,
    "openings": openings,
    "archaic phrases": archaic_docstrings_and_messages,
    "messages": messages_without_requirement,
}


@cache
def tree_of(source: str) -> ast.Module:
    return ast.parse(source)


def violations_of_source(source: str, name: str = "") -> dict[str, list[str]]:
    """Return the violations of a module by check."""
    tree = tree_of(source)
    results = {check: [f"{name}:{item}" for item in run(tree)] for check, run in CHECKS.items()}
    results["archaic phrases"] += [f"{name}: {item}" for item in archaic_comments(source)]
    return results


def violations_of_page(text: str, name: str = "") -> dict[str, list[str]]:
    """Return the violations of a document or a template by check."""
    checks = {
        "long sentences in documents": long_sentences,
        "archaic phrases in documents": archaic_phrases,
    }
    return {check: [f"{name}: {item}" for item in run(text)] for check, run in checks.items()}


@cache
def exported_names() -> set[tuple[str, str]]:
    """Return module and name of all that the doors export."""
    names = {("pfbench", "load")}
    for door in PACKAGE.rglob("__init__.pyi"):
        for node in tree_of(door.read_text()).body:
            if isinstance(node, ast.ImportFrom):
                names |= {(str(node.module), alias.name) for alias in node.names}
    return names


def exported_lines(file: Path) -> set[int]:
    """Return the lines of the exported functions and classes of a module."""
    module = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return {
        line
        for node in tree_of(file.read_text()).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef)
        and (module, node.name) in exported_names()
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }


@cache
def violations() -> dict[str, list[str]]:
    """Return the violations of the package and its documents: one parse of each file."""
    results: dict[str, list[str]] = {check: [] for check in CHECK_NAMES}
    for file in sorted(PACKAGE.rglob("*.py")):
        for check, items in violations_of_source(
            file.read_text(), str(file.relative_to(ROOT))
        ).items():
            if check == "functions without Args":  # only exported names need them
                lines = exported_lines(file)
                items = [item for item in items if int(item.split(":")[1]) in lines]
            results[check] += items
    for file in SCRIPTS:  # docstrings of scripts have no Args
        for check, items in violations_of_source(
            file.read_text(), str(file.relative_to(ROOT))
        ).items():
            results[check] += items if check in PROSE_CHECKS else []
    for page in (*PAGES, *TEMPLATES):
        for check, items in violations_of_page(
            page.read_text(), str(page.relative_to(ROOT))
        ).items():
            results[check] += items
    return results


def test_package_and_documents_follow_the_rules() -> None:
    for check, items in violations().items():
        assert items == [], f"{check}:\n" + "\n".join(items[-20:])


PLANTED = {
    "banned names": [
        "found = 1",
        "def f(seen): return seen",
        "class A:\n    kept: int = 0",
        "self.told = 2",
        "for one in range(3): pass",
    ],
    "single letters": ["l = 1", "def f(o): return o"],
    "functions without Args": [
        'def f(a, b):\n    """Add."""',
        'class A:\n    def g(self, a, b):\n        """Add."""',
        "def f(a, *, b): return a",
    ],
    "long sentences": [f'"""{"word " * 30}word."""', f'"""Short.\n\nArgs:\n    a: {"x " * 31}."""'],
    "openings": ['def f():\n    """What a filter does."""', '"""Whether it is."""'],
    "archaic phrases": [
        '"""A filter that has no weights."""',
        "# what the filter tells\nx = 1",
        'raise ValueError("nobody must do this")',
        '"""A state beside its\n    weights."""',
    ],
    "messages": ['raise ValueError("bad value")', 'raise ValueError(f"a={a}: give one")'],
}
PLANTED_PAGES = {
    "long sentences in documents": [f"# Title\n\n- {'word ' * 31}.", f"Short one. {'word ' * 31}."],
    "archaic phrases in documents": ["A method of which\n`code` is a part: nobody.", "It knows."],
}
PLAIN_SOURCE = '''
"""Sums of numbers."""


def add(first: float, second: float) -> float:
    """Add two numbers.

    Args:
        first: First number, m.
        second: Second number, m.

    Returns:
        The sum.
    """
    if first < 0.0:
        raise ValueError(f"first must be positive, got {first}. Change it.")
    x = first + second  # no rounding
    return x
'''
PLAIN_PAGE = "# Told\n\nA filter. `told beside` it.\n\n```\nnobody\n```\n\n| seen | of what |\n"


def test_planted_violations_are_found() -> None:
    for check, source in ((check, source) for check, all_ in PLANTED.items() for source in all_):
        assert len(violations_of_source(source)[check]) == 1, source
    for check, texts in PLANTED_PAGES.items():
        assert all(violations_of_page(text)[check] for text in texts), check


def test_plain_text_passes() -> None:
    assert not any(violations_of_source(PLAIN_SOURCE).values())
    assert not any(violations_of_page("A filter.\n" + PLAIN_PAGE.split("\n", 1)[1]).values())
