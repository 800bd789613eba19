"""Digests of source code: of folders, and of modules with all that they import.

They enter the key of a job, the record of its build, and the names of compiled steps.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import os
import sys
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]  # pfbench
# packages that are too large to be trusted as a whole: each can read, write or run files
BROAD = (
    "__main__", "cloudpickle", "fsspec", "hydra", "hydra_plugins", "jinja2", "joblib", "matplotlib", "numpy",
    "omegaconf", "pandas", "pip", "pkg_resources", "pyro", "ray", "scipy", "seaborn", "setuptools", "sympy",
    "torch", "triton", "yaml",
)  # fmt: skip
_COMPILED = (".pyc", ".so", ".pyd")
_LIBRARIES = ("site-packages", "dist-packages")


def hash_modules(modules: Iterable[str]) -> dict[str, str]:
    """Compute digests of the source files of modules, and of the user's modules that they import, by module."""
    files: dict[str, bytes] = {}
    for module in modules:
        _collect(module, files)
    return {name: hashlib.sha256(source).hexdigest()[:16] for name, source in sorted(files.items())}


def hash_folder(top: Path, omitted: Collection[str] = ()) -> str:
    """Compute a digest of the files of a folder, except compiled ones and those in the folders `omitted`.

    It depends on the names and contents of the files only, not on times.
    """
    sha256 = hashlib.sha256()
    for folder, below, files in os.walk(top):  # an order of its own for each file system
        below[:] = sorted(
            name for name in below if name != "__pycache__" and f"{folder}/{name}" not in omitted
        )
        for file in sorted(files):
            if not file.endswith(_COMPILED):
                with open(f"{folder}/{file}", "rb", buffering=0) as source:
                    content = source.read()
                name = f"{folder.removeprefix(str(top))}/{file}"
                sha256.update(f"{name} {len(content)};".encode() + content)
    return sha256.hexdigest()[:12]


def _find_file(module: str) -> Path | None:
    """Return the file of a module, or None if the module or its file does not exist."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, AttributeError, ValueError):  # a parent is missing, or is not a package
        return None
    origin = None if spec is None or not spec.has_location else spec.origin
    return None if origin is None else Path(origin)


def find_module(target: str) -> str:
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
