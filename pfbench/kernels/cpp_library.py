"""Library of the C++ operators: choice of the variant, compilation where none came with the package, loading."""

from __future__ import annotations

import ctypes
import logging
from functools import cache
from pathlib import Path
from subprocess import CalledProcessError

import torch

from pfbench.kernels.library_build import build_library, find_variants, name_library
from pfbench.kernels.private_folder import check_private, code_folder

log = logging.getLogger("pfbench")
_WITH_PACKAGE = Path(__file__).parent


def choose_variant() -> str:
    """Return the variant for this processor: `avx2`, or `baseline`."""
    has_avx2 = torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512")
    return "avx2" if has_avx2 and "avx2" in find_variants() else "baseline"


@cache
def load_library() -> None:
    """Load the operators, which registers them, after compiling them if no library came with the package.

    Raises:
        OSError: If no C++ compiler is installed, or others can write the compiled code.
        CalledProcessError: If the compiler rejects the source.
    """
    variant = choose_variant()
    built = _WITH_PACKAGE / name_library(variant)
    if not built.exists():
        built = code_folder() / built.name
        if not built.exists():
            log.info("C++ operators: compiling them once for this computer, about 10 s")
            build_library(variant, built)
        check_private(built)
    ctypes.CDLL(str(built), mode=ctypes.RTLD_GLOBAL)  # compiled steps call the operators by name


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
