"""Source of a script or a notebook as modules that another process can import, so that workers run its classes.

Each class is stored once, in a module that is named by a digest of its text. It has the functions and constants of the script that
the class uses, with their values at that time, and imports the other classes from theirs. So all parts of a script meet,
and a part changes only with the code that it reaches.
"""

from __future__ import annotations

import ast
import builtins
import hashlib
import importlib
import re
import symtable
import sys
import types
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import write_atomically
from pfbench.job.trust import FOLDERS, WRITTEN, split_trust

_MAIN = "__main__"
_CONSTANTS = (bool, int, float, complex, str, bytes, type(None))
_VERBS = (
    "run",
    "own",
    "study",
    "log",
)  # of pfbench, which a module must not call when it is imported
_HEAD = (
    '"""Written by pfbench from a script or a notebook. Do not change it: results name it."""\n\n'
)
_FUTURE = "from __future__ import annotations"


class _Statement(NamedTuple):
    """Top-level statement of a script that defines a name: its position, its text and its syntax."""

    position: int
    text: str
    node: ast.stmt


def write_module(cls: type) -> str:
    """Write the module of a class of a script or a notebook, and those of the classes of the script that it uses.

    Returns the name of the module. The same source gives the same module.
    """
    outer, is_local, _ = cls.__qualname__.partition(".<locals>")
    require(
        not is_local,
        cls.__name__,
        "be defined at the top level",
        f"a class inside of {outer}, whose variables no other process has",
        "Move it out, and pass what it needs as arguments.",
    )
    values = vars(sys.modules[_MAIN])
    statements = read_statements(values)
    require(
        cls.__name__ in statements,
        cls.__name__,
        "be in a file or a notebook",
        "a class without a source",
        "Save it in a module.",
    )
    require(
        values.get(cls.__name__) is cls,
        cls.__name__,
        "be the class of that name",
        "one that was defined before",
        "Make the object again.",
    )
    return _Script(values, statements).write(cls.__name__)


class _Script:
    """Script or notebook at one moment: values of its names, and the statements that define them.

    Each class is in one module, from which all others import it, so that two parts that use a class mean the same one.
    Functions and constants are repeated in each module: a part depends on nothing that it does not use.
    """

    def __init__(
        self, values: Mapping[str, Any], statements: Mapping[str, list[_Statement]]
    ) -> None:
        self.values, self.statements = values, statements
        self._modules: dict[str, str] = {}

    def write(self, cls: str) -> str:
        """Write the module of a class, once. Returns the name of the module."""
        circle = [name for name in self._reach(cls) if cls in self._reach(name)]
        classes = [name for name in (cls, *circle) if isinstance(self.values[name], type)]
        head = min(classes, key=lambda name: self.statements[name][0].position)
        if head not in self._modules:
            text = _Collector(self, {*classes, *circle}).collect(head)
            self._modules[head] = _store_module(head, text)
        return self._modules[head]

    def find_kind(self, name: str) -> str:
        """Return how a module gets a name: import, constant, class, statement, or an empty text if it cannot."""
        value = self.values[name]
        if isinstance(value, types.ModuleType) or _is_of_module(value):
            return "import"
        if _is_constant(value):
            return "constant"
        if name not in self.statements:
            return ""
        return "class" if isinstance(value, type) else "statement"

    def _reach(self, name: str) -> dict[str, None]:
        """Return the classes and statements of the script that a name uses, directly or through others."""
        reached: dict[str, None] = {}
        pending = [name]
        while pending:
            texts = [statement.text for statement in self.statements[pending.pop()]]
            used = {item for text in texts for item in list_globals(text) if item in self.values}
            own_names = {item for item in used if self.find_kind(item) in ("class", "statement")}
            pending += sorted(own_names - reached.keys())
            reached |= dict.fromkeys(sorted(own_names))
        return reached


def name_file(title: str) -> str:
    """Return the name of the file of a class or a part."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|\W+", "_", title).strip("_").lower()


def _store_module(title: str, text: str) -> str:
    """Store the text of a module under a name with its digest, and import it. Returns the name."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    name = f"own_{name_file(title)}_{digest}"
    path = Path(WRITTEN) / f"{name}.py"
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda file: file.write(text.encode()))
    split_trust([f"trust=[{name}]"])  # so that it is imported from its folder
    importlib.invalidate_caches()
    try:
        import_module(name)
    except Exception as error:
        raise ValueError(
            f"{title} must run without the rest of its script, got {type(error).__name__}: {error}. "
            f"Move it into a module of your own. The source that was collected is {path}."
        ) from error
    return name


class _Collector:
    """Collector of the names that a class uses.

    Attributes:
        lines: Imports and constants, by name.
        selected: Statements of the script, by their position.
    """

    def __init__(self, script: _Script, members: Collection[str]) -> None:
        self._script, self._together = script, members
        self.lines: dict[str, str] = {}
        self.selected: dict[int, str] = {}

    def collect(self, name: str) -> str:
        """Collect a class and all that it uses. Returns the text of the module."""
        self._add_statements(name)
        imports = "\n".join(sorted(self.lines.values()))
        body = "\n\n\n".join(text for _, text in sorted(self.selected.items()))
        return f"{_HEAD}{_FUTURE}\n\n{imports}\n\n\n{body}\n"

    def _add_statements(self, name: str) -> None:
        """Add the statements that define a name, and the names that they use."""
        for statement in self._script.statements[name]:
            if statement.position not in self.selected:
                self.selected[statement.position] = statement.text
                for needed in list_globals(statement.text):
                    self._add(needed, statement.text)

    def _add(self, name: str, user: str) -> None:
        """Add a name that a statement uses, by its present value where that can be written."""
        if name in self.lines or name not in self._script.values:
            self._check_exists(name, user)
            return
        value, kind = self._script.values[name], self._script.find_kind(name)
        if isinstance(value, types.ModuleType):
            imports = self._script.statements.get(f"import {name}", ())
            dotted = [statement.text for statement in imports]
            self.lines[name] = "\n".join([f"import {value.__name__} as {name}", *dotted])
        elif kind == "import":
            self.lines[name] = f"from {find_home(value)} import {value.__qualname__} as {name}"
        elif kind == "constant":
            self.lines[name] = f"{name} = {value!r}"
        elif kind == "class" and name not in self._together:
            self.lines[name] = f"from {self._script.write(name)} import {name}"
        elif kind:
            for statement in self._script.statements[name]:
                _check_statement(name, statement.node)
            self._add_statements(name)
        else:
            raise ValueError(
                f"{name} must be defined at the top level of the script, got a {type(value).__name__} without a "
                "source. Pass it as an argument."
            )

    def _check_exists(self, name: str, user: str) -> None:
        """Check that a name is collected, a built-in one or only an annotation."""
        if name in self.lines or hasattr(builtins, name) or name in ("__name__", "__file__"):
            return
        # a module does not evaluate annotations
        require(
            name not in list_globals(f"{_FUTURE}\n{user}"),
            name,
            "be defined before the class is passed",
            "a name that does not exist",
            "Define or import it.",
        )


def read_statements(values: Mapping[str, Any]) -> dict[str, list[_Statement]]:
    """Read the top-level statements of the main script or the cells of a notebook, by the names that they define.

    A later definition of a name replaces an earlier one. Cells count in the order in which they were executed.
    """
    by_name: dict[str, list[_Statement]] = {}
    position = 0
    for text in _list_texts(values):
        try:
            tree = ast.parse(text)
        except SyntaxError:  # a cell that never ran
            continue
        for node in tree.body:
            position += 1
            for name in _list_defined(node):
                by_name[name] = [_Statement(position, _cut_text(text, node), node)]
            for name, line in _list_dotted_imports(node):
                by_name.setdefault(name, []).append(_Statement(position, line, node))
    return by_name


def _list_texts(values: Mapping[str, Any]) -> list[str]:
    """Return the text of the main script, or those of the cells that a notebook executed."""
    if isinstance(values.get("In"), list):
        # without the commands of the notebook
        return [re.sub(r"^[ \t]*[%!].*", "", cell, flags=re.MULTILINE) for cell in values["In"]]
    file = values.get("__file__")
    is_file = isinstance(file, str) and Path(file).is_file()
    return [Path(file).read_text(encoding="utf-8")] if is_file and file else []


def _list_defined(node: ast.stmt) -> Iterator[str]:
    """Yield the names that a top-level statement defines: a class, a function, or plain assignments."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        yield node.name
    elif isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        items = [item for target in targets for item in ast.walk(target)]
        yield from (item.id for item in items if isinstance(item, ast.Name))


def _list_dotted_imports(node: ast.stmt) -> Iterator[tuple[str, str]]:
    """Yield for `import a.b` the key `import a` and the line: the module a alone would lack b in another process."""
    for alias in node.names if isinstance(node, ast.Import) else ():
        if alias.asname is None and "." in alias.name:
            yield f"import {alias.name.partition('.')[0]}", f"import {alias.name}"


def _cut_text(text: str, node: ast.stmt) -> str:
    """Return the text of a statement with its decorators."""
    first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
    return "\n".join(text.splitlines()[first - 1 : node.end_lineno])


@cache
def list_globals(text: str) -> list[str]:
    """List the global names that a statement uses, those inside of its functions included."""
    names: dict[str, None] = {}
    pending = [symtable.symtable(text, "own", "exec")]
    while pending:
        scope = pending.pop()
        pending += scope.get_children()
        is_top = scope.get_type() == "module"
        for symbol in scope.get_symbols():
            if symbol.is_referenced() and (is_top or symbol.is_global()):
                names[symbol.get_name()] = None
    return sorted(names)


def _is_of_module(value: object) -> bool:
    """Return whether a class or function is defined in a module other than the script."""
    module = getattr(value, "__module__", None)
    name = getattr(value, "__qualname__", "<locals>")
    if not isinstance(module, str) or module == _MAIN or "<" in name or "." in name:
        return False
    return getattr(sys.modules.get(module), name, None) is value


def find_home(value: Any) -> str:
    """Return the module from which a class or function is imported: of pfbench the folder whose door has it."""
    module = str(value.__module__)
    room = module.split(".")[1] if module.startswith("pfbench.") else ""
    doors = {"": (), "logs": (*FOLDERS, "job", "testing", "judge")}.get(room, (room,))
    for door in doors:  # the wing of logs has none of its own
        if getattr(import_module(f"pfbench.{door}"), value.__qualname__, None) is value:
            return f"pfbench.{door}"
    return module


def _is_constant(value: object) -> bool:
    """Return whether a value is written exactly by its text."""
    if isinstance(value, tuple | list | set | frozenset) and type(value).__module__ == "builtins":
        return all(map(_is_constant, value))
    if type(value) is dict:
        return all(_is_constant(item) for pair in value.items() for item in pair)
    is_plain = type(value) in _CONSTANTS
    return is_plain and not (isinstance(value, float | complex) and "n" in repr(value))  # inf, nan


def _check_statement(name: str, node: ast.stmt) -> None:
    """Check that a statement can be repeated when a module is imported."""
    names = [ast.unparse(item) for item in ast.walk(node) if isinstance(item, ast.Attribute)]
    calls = [call for call in names if call in {f"pfbench.{verb}" for verb in _VERBS}]
    got = f"the result of {''.join(calls[:1])}"
    require(not calls, name, "not be used by the class", got, "Pass it as an argument.")
