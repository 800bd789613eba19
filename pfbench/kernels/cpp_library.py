"""Library of the C++ operators: choice of the variant, a folder that the user alone can write, loading."""

from __future__ import annotations

import ctypes
import logging
import os
import stat
import sys
from functools import cache
from pathlib import Path
from subprocess import CalledProcessError

import torch

from pfbench.kernels.library_build import build_library, find_variants, name_library

log = logging.getLogger("pfbench")
_WITH_PACKAGE = Path(__file__).parent


def choose_variant() -> str:
    """Return the variant for this processor: `avx2`, or `baseline`."""
    has_avx2 = torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512")
    return "avx2" if has_avx2 and "avx2" in find_variants() else "baseline"


@cache
def load_library() -> None:
    """Load the operators, which registers them, after compiling them if no library came with the package."""
    variant = choose_variant()
    built = _WITH_PACKAGE / name_library(variant)
    if not built.exists():
        built = code_folder() / built.name
        if not built.exists():
            log.info("C++ operators: compiling them once for this computer, about 10 s")
            build_library(variant, built)
        check_private(built)
    ctypes.CDLL(str(built))


@cache
def is_library_loaded() -> bool:
    """Return whether the operators are loaded. If they cannot be, one line says what is lost."""
    try:
        load_library()
    except (OSError, CalledProcessError) as error:
        reason = str(error) if isinstance(error, OSError) else f"{error.cmd[0]} rejects the source"
        log.warning(
            "C++ operators: not available (%s). Filters run in torch operations, two to five "
            "times slower, with the same results to rounding. Install a C++ compiler.",
            reason,
        )
        return False
    return True


# --------------------------------------------------------------------------------------------------
# Folder of compiled code. Code is loaded only from a folder that the user alone can write.


def code_folder() -> Path:
    """Return the folder of compiled code, `pfbench` in the user's cache folder."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "pfbench"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_private(folder)
    return folder


def use_private_cache() -> None:
    """Make torch's compiler keep its code in `code_folder`, unless the user chose another folder.

    Its default is a folder of a predictable name in the system's temporary folder. An import of the
    compiler writes this default into the environment, so that it looks like the user's choice.
    """
    compiler = sys.modules.get("torch._inductor.runtime.cache_dir_utils")
    default = os.path.abspath(compiler.default_cache_dir()) if compiler else None
    if os.environ.get("TORCHINDUCTOR_CACHE_DIR") in (None, default):
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(code_folder() / "torch")


def check_private(path: Path) -> None:
    """Check that a folder or a file belongs to the user and that no other can write it."""
    status = path.lstat()
    is_plain = stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)
    is_owned = not hasattr(os, "getuid") or status.st_uid == os.getuid()
    if not is_plain or not is_owned or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(
            f"{path} must be a folder or file of this user that others cannot write. Compiled code "
            "is not loaded from it. Remove it, or set XDG_CACHE_HOME to a private folder."
        )
