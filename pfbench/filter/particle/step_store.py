"""Store of compiled steps on disk: a later process loads a step without torch's compiler.

The name of a step is a digest of all that decides its code. This is the source of pfbench, filter and model with their
constants, shapes and types, torch, and the processor. Nothing is recorded to compute it. Steps of classes of a user are not
stored: these may take a number from anywhere.
"""

from __future__ import annotations

import functools
import json
import logging
import os
import platform
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pfbench.files.atomic_write import DIGEST, has_valid_digest, hash_content
from pfbench.files.source_digest import BROAD, PACKAGE, UNDESCRIBED, ReachedStream, hash_folder
from pfbench.kernels.cpp_library import check_private, choose_variant, code_folder
from pfbench.kernels.library_build import name_library
from pfbench.kernels.step_compiler import NativeEntry, encode_path, register_step

log = logging.getLogger("pfbench")

_LIBRARY, _CONSTANTS, _RECORD = "step.so", "constants.pt", "step.json"
_LARGEST = 500e6  # bytes of all steps
_LONGEST_UNUSED = 90 * 86400.0  # s
_LONGEST_WRITE = 3600.0  # s; an older temporary folder is of a process that was killed
_NAME_LENGTH = 40
_SHIPPED = {"pfbench", *sys.stdlib_module_names, *BROAD} - {"__main__"}


# --------------------------------------------------------------------------------------------------
# Name of a step


def name_step(
    constants: Any, arguments: Any, uncounted: object = None, library: str | None = None
) -> str | None:
    """Return the name of a step, or None if it is not stored, since a part of it cannot be described or is of a class of a user.

    A class of a user may take a number from anywhere. A class of pfbench has its source, its attributes, and nothing else.

    Args:
        constants: Objects that are constants of the step: filter and model. Values of tensors count.
        arguments: Objects that the step takes: belief, record and draws. Only type and shape of tensors count.
        uncounted: Object that the step does not depend on, such as a counter.
        library: Name of the library of operators, the one of this process by default.
    """
    stream = ReachedStream(uncounted=uncounted)
    try:
        stream.dump(constants)
        stream.has_values = False
        stream.dump(arguments)
        packages = sorted({name.partition(".")[0] for name in stream.modules})
        if others := set(packages) - _SHIPPED:
            raise TypeError(f"{', '.join(sorted(others))} is not pfbench")
        versions = [getattr(sys.modules[name], "__version__", "") for name in packages]
        stream.dump((_describe_platform(), library or name_library(choose_variant()), versions))
    except (*UNDESCRIBED, OSError) as error:
        log.debug("engine=compiled: this step is not stored (%s)", error)
        return None
    return stream.sha256.hexdigest()[:_NAME_LENGTH]


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

    The digest covers all that is used: the name, the number of outputs and the files. A damaged step is removed.

    Shapes: those of `example`, the arguments of the step.
    """
    folder = _folder() / name
    try:
        if not has_step(name):
            return None
        for path in (folder, *folder.iterdir()):
            check_private(path)
        record = json.loads((folder / _RECORD).read_bytes())
        if not has_valid_digest({**record, **_read_files(folder)}) or record["name"] != name:
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
            record = {"name": name, "outputs": outputs}
            digest = hash_content({**record, **_read_files(folder)})
            (folder / _RECORD).write_text(json.dumps({**record, DIGEST: digest}))
            for file in folder.iterdir():
                file.chmod(0o600)  # whatever the mask of the user is
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


def _folder() -> Path:
    """Return the folder of compiled steps."""
    return code_folder() / "steps"


def _read_files(folder: Path) -> dict[str, bytes]:
    """Read the files of a step but its record."""
    return {file: (folder / file).read_bytes() for file in (_LIBRARY, _CONSTANTS)}


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
