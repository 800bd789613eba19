"""The one loop that is written in C++, compiled on the spot where there is a compiler: see normals.cpp."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_SOURCE = Path(__file__).with_name("normals.cpp")
_FLAGS = ("-O3", "-march=native", "-ffast-math", "-mno-recip", "-fopenmp-simd", "-shared", "-fPIC")
_NUMBER, _ADDRESS = ctypes.c_int64, ctypes.c_void_p


def normals(key: Tensor, step: Tensor, runs: Tensor, component: Tensor, particle: Tensor) -> Tensor:
    """Standard normals, float32 [w, R, 4 q], as draws.normals makes them, to 5e-6; arguments as there, on the CPU.

    Raises:
        OSError, subprocess.CalledProcessError: no C++ compiler, or one that does not understand the source.
    """
    out = torch.empty(len(component), len(runs), 4 * len(particle))
    axes = [part for axis in (runs, component, particle) for part in (axis.contiguous().data_ptr(), len(axis))]
    _library().normals(out.data_ptr(), *axes, int(step), *key.tolist())
    return out


@cache
def _library() -> Any:
    compiler = next((found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None)
    if compiler is None:
        raise OSError("no C++ compiler")
    source = _SOURCE.read_bytes()
    name = hashlib.sha256(source + repr((compiler, _FLAGS, os.cpu_count())).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"pfbench_{os.getuid()}"
    path = folder / f"{name}.so"
    if not path.exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            built = Path(scratch) / path.name
            subprocess.run([compiler, *_FLAGS, "-o", built, _SOURCE, "-lm"], check=True, capture_output=True)
            os.replace(built, path)
    library = ctypes.CDLL(str(path))
    library.normals.argtypes = [_ADDRESS, *(_ADDRESS, _NUMBER) * 3, *(_NUMBER,) * 3]
    library.normals.restype = None
    return library
