"""Lazy import of the public names of a package."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_attributes(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Make the functions of a package that imports its public names on first use.

    A package would otherwise import every module, torch included, for a single name. The names and
    their modules are the import statements of `__init__.pyi` in the folder of the package,
    from which type checkers and editors know them too.
    """
    stub = ast.parse(Path(file).with_name("__init__.pyi").read_text(encoding="utf-8"))
    homes = {
        alias.name: str(statement.module)
        for statement in stub.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
    names = sorted(homes)

    def get_attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(
                f"{package} does not define {name!r}. Choose a name of dir({package})."
            )
        return getattr(importlib.import_module(homes[name]), name)

    return get_attribute, names.copy, names
