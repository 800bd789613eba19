"""Builds the C++ operators with AddressSanitizer and UndefinedBehaviorSanitizer, as a plugin of pytest or an import.

Their runtimes must be preloaded: run the process with `make_environment()`.
"""

import os
import shutil
import subprocess
from functools import partial
from pathlib import Path

from checkout import TESTS

from pfbench.kernels import cpp_library, library_build

FLAGS = (
    "-fsanitize=address,undefined,float-cast-overflow",
    "-fno-sanitize-recover=undefined",
    "-g1",  # lines for the reports
    "-O0",  # compiles in half the time of -O1, and no undefined operation is optimised away
)


def find_runtimes() -> list[str]:
    """Paths of the runtimes of both sanitizers; empty without them or without a compiler."""
    compiler = shutil.which("c++") or shutil.which("g++")
    paths = []
    for name in ("libasan.so", "libubsan.so") if compiler else ():
        command = [str(compiler), f"-print-file-name={name}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        path = Path(done.stdout.strip())
        if not path.is_absolute() or not path.exists():
            return []
        paths.append(str(path.resolve()))
    return paths


def make_environment() -> dict[str, str]:
    """Environment of a process that uses the sanitized operators."""
    python_path = os.pathsep.join([str(TESTS / "kernels"), str(TESTS), str(TESTS.parent)])
    return {
        **os.environ,
        "PYTHONPATH": python_path,
        "LD_PRELOAD": " ".join(find_runtimes()),
        "ASAN_OPTIONS": "detect_leaks=0",  # of Python and torch
        "OMP_NUM_THREADS": "1",
    }


def check_library() -> None:
    """Check that this process has loaded the sanitized operators."""
    name = cpp_library.name_library(cpp_library.choose_variant())
    assert name.startswith("sanitized")
    assert name in Path("/proc/self/maps").read_text()


def pytest_sessionfinish() -> None:
    """Check it after the tests, too."""
    check_library()


if os.environ.get("LD_PRELOAD"):
    cpp_library.name_library = lambda variant: f"sanitized_{library_build.name_library(variant)}"  # type: ignore[assignment]
    cpp_library.build_library = partial(library_build.build_library, flags=FLAGS)
