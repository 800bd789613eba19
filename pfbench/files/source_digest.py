"""Digests of source code: of folders, and of modules with all that they import; and of the values that code reaches.

They enter the key of a job and the record of its build.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import os
import pickle
import sys
import threading
import types
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

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

    Args:
        top: Folder.
        omitted: Paths of folders below it, each beginning with that of `top`.

    Returns:
        Twelve hexadecimal digits.
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


# Values that the code of a user reaches: a source that stays the same may read another number.
_NAMED = (
    types.GetSetDescriptorType, types.MemberDescriptorType, types.WrapperDescriptorType, types.MethodDescriptorType,
    types.ClassMethodDescriptorType, types.MethodWrapperType, type(threading.Lock()), type(threading.RLock()),
)  # fmt: skip
_HOLDERS = (
    property, staticmethod, classmethod, functools.cached_property, functools.partialmethod,
    type(functools.cache(len)),
)  # fmt: skip
_HELD = ("__func__", "__wrapped__", "fget", "fset", "func", "args", "keywords")
# of a class: its text has them, or Python computes them from the others
_DERIVED = (
    "__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__abstractmethods__", "_abc_impl",
    "__dataclass_fields__", "__firstlineno__", "__static_attributes__",
)  # fmt: skip
_UNDESCRIBED = pickle.PicklingError, AttributeError, TypeError, ValueError, RecursionError
_ENVIRONMENT = {"environ", "environb", "getenv", "getenvb"}


def hash_reached(target: str, thing: Any) -> str:
    """Compute a digest of all that a class or function of a user reaches.

    That is code in memory, globals, closures, defaults, attributes of classes, arrays, and the variables of the environment
    that the code names. Of modules that are neither in its package nor in its folder only names count.

    Raises:
        ValueError: If a value cannot be described, as a generator or an open file.
    """
    stream = ReachedStream(target.partition(".")[0])
    try:
        stream.dump(thing)
    except _UNDESCRIBED as error:
        raise ValueError(
            f"{target} must reach values that the key of a job can contain, as numbers, arrays, functions and classes, "
            f"got another kind ({error}). Make such a value inside of the function that uses it."
        ) from error
    for name in sorted(os.environ) if stream.reads_environment else ():
        if any(word == name or (len(word) > 2 and word in name) for word in stream.words):
            stream.sha256.update(f"{name}={os.environ[name]};".encode())
    return stream.sha256.hexdigest()[:16]


class ReachedStream(pickle.Pickler):
    """Digest of a pickle that is never read, which follows the code of a user. The module `pickle` handles all other kinds of values.

    Args:
        package: Package of the user.

    Attributes:
        sha256: The digest.
        words: Texts in the code, which may name variables of the environment.
        reads_environment: Whether the code names the environment.
    """

    def __init__(self, package: str) -> None:
        self.sha256, self.reads_environment = hashlib.sha256(), False
        super().__init__(types.SimpleNamespace(write=self.sha256.update), protocol=5)
        self.words: set[str] = set()
        self._tensors: dict[
            int, tuple[int, Any]
        ] = {}  # keeps them, so that no number is given twice
        self._is_own = functools.cache(lambda name: _is_beside(name, package))

    def is_own(self, module: Any) -> bool:
        """Return whether a module is of the user."""
        return self._is_own(str(module).partition(".")[0])

    def persistent_id(self, value: Any) -> Any:
        """Return the content of a text, a set or a tensor, which pickles do not write alike in two processes; None for others."""
        if isinstance(value, str):
            self.words.add(value)
            return value.encode(errors="surrogatepass")
        if isinstance(value, set | frozenset):
            return "set", sorted(value, key=repr)
        if isinstance(value, getattr(sys.modules.get("torch"), "Tensor", ())):
            index, _ = self._tensors.setdefault(id(value), (len(self._tensors), value))
            a: Any = value
            kind = index, str(a.dtype), str(a.device), tuple(a.shape), a.requires_grad
            flat = a.detach().cpu().contiguous().reshape(-1).view(sys.modules["torch"].uint8)
            return kind, a.stride(), flat.numpy().tobytes()
        return None

    def reducer_override(self, value: Any) -> Any:
        """Return name and content of a value: all that code of the user reaches, and names of what others define."""
        kind = type(value)
        if value is str:  # the start of all that follows
            return NotImplemented
        if value is os.environ or value is os.getenv:
            self.reads_environment = True
            return str, ("environment",)
        if isinstance(value, types.CodeType):
            self.reads_environment |= not _ENVIRONMENT.isdisjoint(value.co_names)
            return (
                str,
                ("code",),
                [value.co_code, value.co_names, value.co_varnames, value.co_consts],
            )
        if isinstance(value, _HOLDERS):
            return str, (kind.__name__,), [getattr(value, name, None) for name in _HELD]
        if isinstance(value, types.ModuleType | types.FunctionType | type):
            return str, (_name(value),), self._list_content(value)
        is_named = (
            callable(value)
            and isinstance(getattr(value, "__qualname__", None), str)
            and not (self.is_own(kind.__module__) or self.is_own(value.__module__))
        )
        is_free = isinstance(getattr(value, "__self__", None), types.ModuleType | type | None)
        if isinstance(value, _NAMED) or (is_named and is_free):
            return str, (_name(value),)
        home = {} if self.is_own(kind.__module__) else vars(sys.modules.get(kind.__module__, types))
        names = [key for key, item in list(home.items()) if item is value]
        if names:  # an object that a library keeps, as a type of numbers or a distribution of scipy
            return str, (f"{_name(kind)} {names[0]}",)
        return NotImplemented

    def _list_content(self, value: Any) -> Any:
        """List what a module, a function or a class of the user consists of; of a function of others its arguments."""
        if isinstance(value, types.FunctionType):
            reached = [value.__defaults__, value.__kwdefaults__, vars(value)]
            reached += [cell.cell_contents for cell in value.__closure__ or ()]
            if not self.is_own(value.__module__):
                return reached
            names = sorted(_list_names(value.__code__) & set(value.__globals__))
            return [*reached, value.__code__, {name: value.__globals__[name] for name in names}]
        is_class = isinstance(value, type)
        if not self.is_own(value.__module__ if is_class else value.__name__):
            return None
        content = {
            name: item
            for name, item in vars(value).items()
            # a protocol writes object.__init__ into a class when its first object is made
            if name not in _DERIVED and item is not vars(object).get(name, value)
        }
        if is_class:
            return [value.__mro__[1:], content]
        return {name: item for name, item in content.items() if not name.startswith("__")}


def _name(value: Any) -> str:
    """Return the name of a module, a function or a class with its module."""
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", type(value).__name__)
    return f"{getattr(value, '__module__', '')}.{name}"


def _list_names(code: types.CodeType) -> set[str]:
    """List the names that a function and those inside of it use."""
    inner = [_list_names(item) for item in code.co_consts if isinstance(item, types.CodeType)]
    return set(code.co_names).union(*inner)
