"""Library of the C++ kernels: compilation, a cache on disk, and loading."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path

import torch

from pfbench.kernels.private_folder import check_private, code_folder

_SOURCES = Path(__file__).parent / "src"
_TORCH = Path(torch.__file__).parent
_COMMON = ("-O3", "-march=native", "-fopenmp-simd", "-fPIC", "-std=c++17", "-c")
_MATHS = ("-fno-math-errno", "-fno-trapping-math")
_SUMS = ("-fno-signed-zeros", "-fassociative-math")
_FLAGS = {
    # each operation rounds once, as in torch: all engines draw the same bits and choose the same ancestors
    "random_normal": (*_COMMON, *_MATHS, "-ffp-contract=off"),
    "resampling": (*_COMMON, *_MATHS, "-ffp-contract=off"),
    "compiled_step": _COMMON,
    "particles": (*_COMMON, *_MATHS, *_SUMS),
    "linear_algebra": (*_COMMON, *_MATHS),
    "scores": (*_COMMON, *_MATHS, *_SUMS),
}


@cache
def load_library() -> None:
    """Compile the kernels unless they are cached, and load the library, which registers them.

    Raises:
        OSError: If no C++ compiler is installed, or others can write the compiled code.
        CalledProcessError: If the compiler rejects the source.
    """
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None:
        raise OSError("a C++ compiler must be on the PATH (c++, g++ or clang++), got none")
    environment = (compiler, _FLAGS, os.cpu_count(), torch.__version__)
    sources = {name: (_SOURCES / f"{name}.cpp").read_bytes() for name in _FLAGS}
    headers = (file.read_bytes() for file in sorted(_SOURCES.glob("*.h")))
    text = b"".join([*sources.values(), *headers])
    name = hashlib.sha256(text + repr(environment).encode()).hexdigest()[:16]
    folder = code_folder()
    built = folder / f"{name}.so"
    if not built.exists():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            objects = [Path(scratch) / f"{source}.o" for source in sources]
            new = Path(scratch) / built.name
            commands = [
                [
                    compiler,
                    *_FLAGS[source],
                    f"-I{_TORCH / 'include'}",
                    "-o",
                    str(file),
                    str(_SOURCES / f"{source}.cpp"),
                ]
                for source, file in zip(sources, objects, strict=True)
            ]
            with ThreadPoolExecutor() as pool:
                list(pool.map(partial(subprocess.run, check=True, capture_output=True), commands))
            libraries = [f"-L{_TORCH / 'lib'}", "-ltorch_cpu", "-lm", "-ldl"]
            if sys.platform == "darwin":  # resolve symbols of Python at loading
                libraries.append("-Wl,-undefined,dynamic_lookup")
            subprocess.run(
                [compiler, "-shared", "-o", new, *objects, *libraries],
                check=True,
                capture_output=True,
            )
            os.replace(new, built)
    check_private(built)
    ctypes.CDLL(str(built), mode=ctypes.RTLD_GLOBAL)  # compiled steps call the kernels by name
