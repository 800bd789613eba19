"""Digest of the source code of a user's classes, for the key of a job.

Classes of pfbench are not part of it: a report refuses results of several versions or commits.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.config.trust import BROAD


def hash_user_code(values: Any) -> str:
    """Compute a digest of the source files that the classes of a configuration consist of.

    The files are those of the modules that `_target_` names, and of all modules of the same package
    that they import, directly or through others. Libraries and pfbench are left out.

    Args:
        values: Resolved configuration.

    Returns:
        Hexadecimal digits, or an empty text if the configuration names no class of a user.
    """
    files: dict[str, bytes] = {}
    for target in sorted(set(_user_targets(values))):
        _collect(_module_of(target), files)
    if not files:
        return ""
    sha256 = hashlib.sha256()
    for name, source in sorted(files.items()):
        sha256.update(f"{name} {len(source)};".encode() + source)
    return sha256.hexdigest()[:16]


def list_user_packages(values: Any, trusted: Sequence[str]) -> list[str]:
    """List the trusted packages that define a class of a configuration.

    Args:
        values: Resolved configuration.
        trusted: Packages that the user trusts.
    """
    targets = list(_user_targets(values))
    return [name for name in trusted if any(t.startswith(f"{name}.") for t in targets)]


def _user_targets(node: Any) -> Iterator[str]:
    """Yield the names of classes that are defined by neither pfbench nor a general library."""
    if isinstance(node, Mapping):
        target = node.get("_target_")
        if isinstance(target, str) and target.split(".")[0] not in ("pfbench", *BROAD):
            yield target
        for value in node.values():
            yield from _user_targets(value)
    elif isinstance(node, list | tuple):
        for value in node:
            yield from _user_targets(value)


def _find_file(module: str) -> Path | None:
    """Return the file of a module, or None if the module or its file does not exist."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, AttributeError, ValueError):  # a parent is missing, or is not a package
        return None
    origin = None if spec is None or not spec.has_location else spec.origin
    return None if origin is None else Path(origin)


def _module_of(target: str) -> str:
    """Return the module of a class: the longest part of its name that is a module."""
    parts = target.split(".")[:-1]
    while len(parts) > 1 and _find_file(".".join(parts)) is None:
        parts.pop()
    return ".".join(parts)


def _collect(module: str, files: dict[str, bytes]) -> None:
    """Add the source of a module and of the modules of its package that it needs."""
    file = _find_file(module)
    if module in files or file is None:
        return
    files[module] = source = file.read_bytes()
    parent = module.rpartition(".")[0]
    if parent:
        _collect(parent, files)  # Python runs the packages first
    if file.suffix == ".py":
        package = module if file.name == "__init__.py" else parent
        for name in _imports(ast.parse(source), package):
            if name.split(".")[0] == module.split(".")[0]:
                _collect(name, files)


def _imports(tree: ast.AST, package: str) -> Iterator[str]:
    """Yield the names that a module imports. `from a import b` gives a and a.b, which may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = parts[: len(parts) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from (stem, *(f"{stem}.{alias.name}" for alias in node.names))
