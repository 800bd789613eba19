"""Store of compiled steps on disk: a later process loads a step without torch's compiler.

The name of a step is a digest of all that decides its code. This is the source of pfbench and of the user, filter and model
with their constants, shapes and types, torch, and the processor. Nothing is recorded to compute it.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import json
import logging
import os
import platform
import shutil
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.files.source_digest import BROAD, PACKAGE, hash_folder, hash_modules
from pfbench.kernels.cpp_library import check_private, choose_variant, code_folder
from pfbench.kernels.library_build import name_library
from pfbench.kernels.step_compiler import NativeEntry, encode_path, register_step

log = logging.getLogger("pfbench")

_LIBRARY, _CONSTANTS, _RECORD = "step.so", "constants.pt", "step.json"
_LARGEST = 500e6  # bytes of all steps
_LONGEST_UNUSED = 90 * 86400.0  # s
_LONGEST_WRITE = 3600.0  # s; an older temporary folder is of a process that was killed
_NAME_LENGTH = 40
_PLAIN = (
    type(None), bool, int, float, complex, str, bytes, range, slice, type(Path()), type(...),
    torch.dtype, torch.device, torch.Size, torch.layout,
)  # fmt: skip
_STANDARD = {"pfbench", *sys.stdlib_module_names} - {"__main__"}


class UnnamableError(TypeError):
    """A value without a description that decides the code of a step."""


# --------------------------------------------------------------------------------------------------
# Name of a step


def name_step(
    constants: Any, arguments: Any, uncounted: object = None, library: str | None = None
) -> str | None:
    """Return the name of a step, or None if a part of it cannot be described, as a class without a source file.

    Args:
        constants: Objects that are constants of the step: filter and model. Values of tensors count.
        arguments: Objects that the step takes: belief, record and draws. Only type and shape of tensors count.
        uncounted: Object that the step does not depend on, such as a counter.
        library: Name of the library of operators, the one of this process by default.
    """
    digest = _Digest(uncounted)
    try:
        digest.add(constants)
        digest.has_values = False
        digest.add(arguments)
        digest.text(_describe_platform(), library or name_library(choose_variant()))
        digest.text(*digest.hash_sources())
    except (UnnamableError, OSError, SyntaxError, RecursionError) as error:
        log.debug("engine=compiled: this step is not stored (%s)", error)
        return None
    return digest.sha256.hexdigest()[:_NAME_LENGTH]


@functools.cache
def _describe_platform() -> str:
    """Describe versions, processor and threads, which decide the code that the compiler writes."""
    flags = ""
    if sys.platform == "linux":
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith(("flags", "Features"))), "")
    versions = torch.__version__, sys.version_info[:2], platform.machine(), hash_folder(PACKAGE)
    settings = torch.backends.cpu.get_cpu_capability(), torch.get_num_threads()
    return f"{versions} {settings} {torch.get_default_dtype()} {flags}"


class _Digest:
    """Digest of a tree of objects by structure. Objects that occur again, and cycles, count by position."""

    def __init__(self, uncounted: object) -> None:
        self.sha256, self.has_values, self.uncounted = hashlib.sha256(), True, uncounted
        self.positions: dict[
            int, tuple[int, Any]
        ] = {}  # keeps the objects, so that no number is given twice
        self.modules: set[str] = set()

    def text(self, *words: object) -> None:
        """Add words, each with its length, so that their limits count."""
        for word in map(str, words):
            self.sha256.update(f"{len(word)}:{word};".encode())

    def hash_sources(self) -> list[str]:
        """Return digests of the modules of the user, and versions of the libraries, that define the objects."""
        modules = sorted(name for name in self.modules if name.split(".")[0] not in BROAD)
        digests = hash_modules(modules)
        if missing := set(modules) - set(digests):
            raise UnnamableError(f"{', '.join(sorted(missing))} must have a source file")
        libraries = sorted({name.split(".")[0] for name in self.modules} & set(BROAD))
        if "__main__" in libraries:
            raise UnnamableError(
                "classes must be in a module that can be imported, got one of a script or notebook"
            )
        versions = [f"{name} {getattr(sys.modules[name], '__version__', '')}" for name in libraries]
        return [*versions, *(f"{name} {digest}" for name, digest in digests.items())]

    def add(self, value: Any) -> None:
        """Add a value and all that it consists of."""
        if type(value) in _PLAIN or isinstance(value, np.dtype):
            self.text(type(value).__name__, repr(value))
            return
        if value is self.uncounted:
            return
        if id(value) in self.positions:
            self.text("again", self.positions[id(value)][0])
            return
        self.positions[id(value)] = len(self.positions), value
        for kinds, add in _WAYS:
            if isinstance(value, kinds):
                add(self, value)
                return
        self._add_object(value)

    def add_all(self, values: Iterable[Any]) -> None:
        """Add values in order."""
        for value in values:
            self.add(value)

    def add_origin(self, value: Any) -> None:
        """Add the name of a class or function, and remember the module that defines it."""
        self.text(value.__module__, value.__qualname__)
        if value.__module__ and value.__module__.split(".")[0] not in _STANDARD:
            self.modules.add(value.__module__)

    def add_classes(self, kind: type) -> None:
        """Add the names of a class and of its bases."""
        for base in kind.__mro__:
            self.add_origin(base)

    def add_tensor(self, value: Tensor) -> None:
        """Add type and shape of a tensor, and its strides and numbers if they are constants of the step.

        A step takes its arguments in storage layout. Strides of a record depend on its length, so they do not count.
        """
        a = value.detach()
        self.text("tensor", a.dtype, tuple(a.shape), a.device, value.requires_grad)
        if self.has_values:
            self.text(a.stride())
            flat = a.cpu().contiguous().reshape(-1).view(torch.uint8)
            self.sha256.update(flat.numpy().tobytes())

    def add_array(self, value: np.ndarray | np.generic) -> None:
        """Add an array of NumPy."""
        if value.dtype.hasobject:
            raise UnnamableError("an array must have numbers, got objects")
        self.text("array", value.dtype, value.shape)
        self.sha256.update(value.tobytes())

    def add_mapping(self, value: Mapping[Any, Any]) -> None:
        """Add names and values in their order."""
        self.add_classes(type(value))
        self.text(len(value))
        for name, item in value.items():
            self.add(name)
            self.add(item)

    def add_sequence(self, value: list[Any] | tuple[Any, ...]) -> None:
        """Add a list or a tuple."""
        self.add_classes(type(value))
        self.text(len(value))
        self.add_all(value)

    def add_set(self, value: frozenset[Any]) -> None:
        """Add a set of plain values."""
        if not all(type(item) in _PLAIN for item in value):
            raise UnnamableError("a set must have plain values, got objects")
        self.text("set", *sorted(map(repr, value)))

    def add_function(self, value: types.FunctionType) -> None:
        """Add a function with its defaults and the values that it takes from outside."""
        self.add_origin(value)
        self.text(value.__code__.co_firstlineno)
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        self.add_all((value.__defaults__, value.__kwdefaults__, *cells))

    def add_method(self, value: types.MethodType) -> None:
        """Add a bound method."""
        self.add(value.__func__)
        self.add(value.__self__)

    def add_builtin(self, value: types.BuiltinFunctionType) -> None:
        """Add a function of Python or of a library."""
        self.text("builtin", value.__module__, value.__qualname__)
        if not isinstance(value.__self__, types.ModuleType | None):
            self.add(value.__self__)

    def add_partial(self, value: functools.partial[Any]) -> None:
        """Add a function with arguments."""
        self.text("partial")
        self.add_all((value.func, value.args, dict(value.keywords)))

    def add_enum(self, value: enum.Enum) -> None:
        """Add a member of an enumeration."""
        self.add_origin(type(value))
        self.text(value.name)

    def _add_object(self, value: Any) -> None:
        """Add an object by its class and attributes, those of `__slots__` included."""
        if not hasattr(value, "__dict__") and not hasattr(type(value), "__slots__"):
            raise UnnamableError(f"a value must have attributes, got {type(value).__qualname__}")
        self.add_classes(type(value))
        if isinstance(value, int | float | complex | str | bytes):
            self.text(repr(value))
        attributes = dict(getattr(value, "__dict__", {}))
        for base in type(value).__mro__:
            slots = getattr(base, "__slots__", ())
            for name in (slots,) if isinstance(slots, str) else slots:
                if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                    attributes[name] = getattr(value, name)
        for name, item in sorted(attributes.items()):
            if not (isinstance(value, torch.nn.Module) and "_hooks" in name and not item):
                self.text(name)
                self.add(item)


_WAYS: tuple[tuple[Any, Callable[[_Digest, Any], None]], ...] = (
    (Tensor, _Digest.add_tensor),
    ((np.ndarray, np.generic), _Digest.add_array),
    (enum.Enum, _Digest.add_enum),
    ((dict, types.MappingProxyType), _Digest.add_mapping),
    ((list, tuple), _Digest.add_sequence),
    ((set, frozenset), _Digest.add_set),
    (functools.partial, _Digest.add_partial),
    (types.FunctionType, _Digest.add_function),
    (types.MethodType, _Digest.add_method),
    (types.BuiltinFunctionType, _Digest.add_builtin),
    (type, _Digest.add_classes),
)


# --------------------------------------------------------------------------------------------------
# Files of a step


def has_steps() -> bool:
    """Return whether the store has a step."""
    try:
        return any(_folder().iterdir())
    except OSError:
        return False


def has_step(name: str) -> bool:
    """Return whether the store has a step of a name."""
    try:
        return (_folder() / name).is_dir()
    except OSError:
        return False


def load_step(name: str, example: list[Tensor]) -> NativeEntry | None:
    """Load a step; return None if the store does not have it, or has it damaged.

    Shapes: those of `example`, the arguments of the step.
    """
    folder = _folder() / name
    try:
        if not has_step(name):
            return None
        check_private(folder)
        content = {file: (folder / file).read_bytes() for file in (_LIBRARY, _CONSTANTS)}
        record = json.loads((folder / _RECORD).read_text())
        if record["digests"] != _hash(content):
            raise ValueError("its files must be those that were written")
        constants = torch.load(folder / _CONSTANTS, weights_only=True)
        arguments = [*constants, *example]
        number = register_step(encode_path(folder / _LIBRARY), record["outputs"], arguments)
        os.utime(folder)
    except PermissionError as error:
        log.warning("engine=compiled: stored steps are not used (%s)", error)
        return None
    except Exception as error:  # damaged files raise many kinds
        log.warning("engine=compiled: a stored step is damaged and removed (%s)", error)
        remove_step(name)
        return None
    return NativeEntry(number, constants, str(folder / _LIBRARY))


def save_step(name: str, entry: NativeEntry, outputs: int) -> None:
    """Store a compiled step. If that fails, one line says so, and nothing is left behind."""
    try:
        _remove_old_steps()
        _folder().mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=_folder(), ignore_cleanup_errors=True) as scratch:
            folder = Path(scratch) / name
            folder.mkdir(mode=0o700)
            shutil.copyfile(entry.library, folder / _LIBRARY)
            torch.save([a.clone() for a in entry.constants], folder / _CONSTANTS)
            content = {file: (folder / file).read_bytes() for file in (_LIBRARY, _CONSTANTS)}
            record = {"outputs": outputs, "digests": _hash(content)}
            (folder / _RECORD).write_text(json.dumps(record))
            try:
                os.rename(folder, _folder() / name)
            except OSError:
                if not has_step(name):  # else another process was faster
                    raise
    except (OSError, RuntimeError) as error:  # torch raises the latter on a full disk
        log.warning("engine=compiled: the step is not stored (%s)", error)


def remove_step(name: str) -> None:
    """Remove a step from the store."""
    shutil.rmtree(_folder() / name, ignore_errors=True)


def workshop() -> Path:
    """Return the folder where torch's compiler works for a build in the background."""
    return code_folder() / "build"


def clear_workshop() -> None:
    """Remove the files of a build."""
    shutil.rmtree(workshop(), ignore_errors=True)


def _folder() -> Path:
    """Return the folder of compiled steps."""
    return code_folder() / "steps"


def _hash(content: Mapping[str, bytes]) -> dict[str, str]:
    """Return the digest of each file."""
    return {name: hashlib.sha256(data).hexdigest() for name, data in content.items()}


def _remove_old_steps() -> None:
    """Remove steps that were not used for long, and the oldest ones above the largest size."""
    if not has_steps():
        return
    ages = {folder: folder.stat().st_mtime for folder in _folder().iterdir()}
    size, now = 0, time.time()
    for folder in sorted(ages, key=ages.__getitem__, reverse=True):
        size += sum(file.stat().st_size for file in folder.rglob("*"))
        longest = _LONGEST_UNUSED if len(folder.name) == _NAME_LENGTH else _LONGEST_WRITE
        if size > _LARGEST or now - ages[folder] > longest:
            shutil.rmtree(folder, ignore_errors=True)
