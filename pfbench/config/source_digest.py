"""Digests of the source code of a user's classes, for the key of a job, and of that of pfbench.

The code of pfbench is not part of a key: a report refuses results of several builds.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pfbench
from pfbench.config.folders import conf_dir, experiments_dir
from pfbench.config.trust import BROAD

PACKAGE = Path(pfbench.__file__).resolve().parent
_COMPILED = (".pyc", ".so", ".pyd")
_LIBRARIES = ("site-packages", "dist-packages")


def hash_user_code(values: Any) -> dict[str, str]:
    """Compute digests of the source files that the classes of a configuration consist of.

    The files are those of the modules that `_target_` names, and of all modules that these import,
    directly or through others. Installed libraries and pfbench are left out.

    Args:
        values: Resolved configuration.

    Returns:
        Hexadecimal digits by the name of the module. Empty if the configuration names no class of a user.
    """
    files: dict[str, bytes] = {}
    for target in sorted(set(_user_targets(values))):
        _collect(_module_of(target), files)
    return {name: hashlib.sha256(source).hexdigest()[:16] for name, source in sorted(files.items())}


@cache
def hash_package() -> str:
    """Compute a digest of the sources of the installed pfbench.

    It depends on the names and contents of the files only, not on times or compiled files. Configuration
    files do not count: what a job takes from them is part of its key.

    Returns:
        Hexadecimal digits.
    """
    sha256 = hashlib.sha256()
    configurations = {str(conf_dir()), str(experiments_dir())}  # inside of the package in a wheel
    for folder, below, files in os.walk(PACKAGE):  # an order of its own for each file system
        below[:] = sorted(
            name
            for name in below
            if name != "__pycache__" and f"{folder}/{name}" not in configurations
        )
        for file in sorted(files):
            if not file.endswith(_COMPILED):
                with open(f"{folder}/{file}", "rb", buffering=0) as source:
                    content = source.read()
                name = f"{folder.removeprefix(str(PACKAGE))}/{file}"
                sha256.update(f"{name} {len(content)};".encode() + content)
    return sha256.hexdigest()[:12]


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
            if _is_beside(name.split(".")[0], module.split(".")[0]):
                _collect(name, files)


def _is_beside(name: str, module: str) -> bool:
    """Return whether a top-level module is a user's own one or a helper in the same folder."""
    if name == module:
        return True
    if name in sys.stdlib_module_names or name in ("pfbench", *BROAD):
        return False
    home = _find_home(module)
    return home is not None and home == _find_home(name)


def _find_home(name: str) -> Path | None:
    """Return the folder of a top-level module, or None for an installed library."""
    file = _find_file(name)
    if file is None:
        return None
    home = (file.parent if file.name == "__init__.py" else file).parent
    return None if home.name in _LIBRARIES else home


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
