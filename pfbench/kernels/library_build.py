"""Build of the C++ operators: one shared library for each set of vector instructions.

The module imports neither torch nor pfbench, since `setup.py` runs it where torch is not installed. The
sources declare the functions of torch's stable interface themselves, so one library serves all versions
of torch.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path

FOLDER = Path(__file__).parent / "src"
_COMMON = ("-O3", "-fopenmp-simd", "-fPIC", "-std=c++17", "-fvisibility=hidden", "-c")
_MATHS = ("-fno-math-errno", "-fno-trapping-math")
_SUMS = ("-fno-signed-zeros", "-fassociative-math")
FLAGS = {
    # each operation rounds once, as in torch: all engines draw the same bits and choose the same ancestors
    "random_normal": (*_COMMON, *_MATHS, "-ffp-contract=off"),
    "resampling": (*_COMMON, *_MATHS, "-ffp-contract=off"),
    "weights": (*_COMMON, *_MATHS),
    "tape": (*_COMMON, *_MATHS),
    "operators": _COMMON,
    "particles": (*_COMMON, *_MATHS, *_SUMS),
    "linear_algebra": (*_COMMON, *_MATHS),
    "scores": (*_COMMON, *_MATHS, *_SUMS),
}
_X86: dict[str, tuple[str, ...]] = {
    "avx2": ("-march=x86-64-v3",),
    "baseline": ("-march=x86-64-v2",),
}


def find_variants() -> dict[str, tuple[str, ...]]:
    """Return the compiler flags of each variant of this processor's architecture.

    An AVX-512 variant gains nothing. The packages that pfbench needs require x86-64-v2 themselves.
    """
    return _X86 if platform.machine().lower() in ("x86_64", "amd64") else {"baseline": ()}


@cache
def name_library(variant: str) -> str:
    """Return the file name of a library. It contains a hash of the sources and flags."""
    files = sorted(file for file in FOLDER.iterdir() if file.suffix in (".cpp", ".h"))
    text = b"".join(file.name.encode() + file.read_bytes() for file in files)
    flags = repr((FLAGS, find_variants()[variant], sys.platform, platform.machine()))
    return f"operators_{variant}_{hashlib.sha256(text + flags.encode()).hexdigest()[:12]}.so"


def build_library(variant: str, target: Path, flags: tuple[str, ...] = ()) -> None:
    """Compile a variant."""
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None:
        raise OSError("a C++ compiler must be on the PATH (c++, g++ or clang++), got none")
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        folder = Path(scratch)
        objects = [folder / f"{source}.o" for source in FLAGS]
        more = (*find_variants()[variant], *flags)
        commands = [
            [compiler, *options, *more, "-o", str(file), str(FOLDER / f"{source}.cpp")]
            for (source, options), file in zip(FLAGS.items(), objects, strict=True)
        ]
        run = partial(subprocess.run, check=True, capture_output=True)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(run, commands))
        new = folder / target.name
        run([compiler, "-shared", "-o", new, *objects, *flags, *_link_options(compiler, folder)])
        os.replace(new, target)


def _link_options(compiler: str, folder: Path) -> list[str]:
    """Return the options that leave torch's functions to the torch of the process that loads the library."""
    if sys.platform == "darwin":
        return ["-Wl,-undefined,dynamic_lookup"]
    # an empty library of torch's name: the loader then looks into the one that Python has loaded
    stub = folder / "libtorch_cpu.so"
    empty = [compiler, "-shared", "-x", "c++", os.devnull, "-o", str(stub)]
    subprocess.run([*empty, f"-Wl,-soname,{stub.name}"], check=True, capture_output=True)
    return [f"-L{folder}", "-Wl,--no-as-needed", "-ltorch_cpu", "-lm", "-ldl"]


if __name__ == "__main__":  # while pip fetches packages; `setup.py` takes what is there
    for name in find_variants():
        path = Path(__file__).with_name(name_library(name))
        if not path.exists():
            with contextlib.suppress(
                OSError, subprocess.CalledProcessError
            ):  # `setup.py` states them
                build_library(name, path)
