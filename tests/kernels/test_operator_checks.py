"""The door of the C++ operators: wrong calls raise, in Python and in C++ for the same reason, and nothing crashes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import random_calls
import torch
from checkout import TESTS

from pfbench.kernels import cpp, manifest

COMPILER = shutil.which("c++") or shutil.which("g++")
compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
X, W = torch.rand(2, 3, 4), torch.rand(3, 4)
ONE = torch.ones(3, 1)


def test_the_checks_in_cpp_are_those_of_the_manifest() -> None:
    assert manifest.HEADER.read_text() == manifest.make_header()
    operators = manifest.read_operators()
    for name, arguments in operators.items():
        names = getattr(cpp, name).__annotations__
        assert [a.name for a in arguments] == [n for n in names if n != "return"], name


@compiler
def test_random_calls_are_computed_or_refused() -> None:
    """Half of the calls are wrong in a shape, a type, a device or a value."""
    counts = random_calls.run(1500, 1)
    assert counts["computed"] > 500
    assert counts["refused"] > 500
    assert counts["wrong but computed"] == counts["valid but refused"] == 0


WRONG = {
    "index above": lambda: cpp.gather_particles(X, torch.full((3, 2), 4)),
    "index below": lambda: cpp.gather_particles(X, torch.full((3, 2), -1)),
    "large index": lambda: cpp.gather_particles(X, torch.full((3, 2), 2**62)),
    "more particles than slots": lambda: cpp.resample_systematic(W, 8 * ONE, 0.5 * ONE),
    "count below 0": lambda: cpp.resample_systematic(W, -ONE, 0.5 * ONE),
    "count not a number": lambda: cpp.resample_systematic(W, torch.nan * ONE, 0.5 * ONE),
    "uniform below 0": lambda: cpp.resample_systematic(W, 4 * ONE, -9.0 * ONE),
    "uniform above 1": lambda: cpp.resample_systematic(W, 4 * ONE, 1e9 * ONE),
    "ancestor above": lambda: cpp.count_unique(torch.tensor([[0, 4]]), torch.zeros(1, 2)),
    "ancestor below": lambda: cpp.count_unique(torch.tensor([[0, -1]]), torch.zeros(1, 2)),
    "group above": lambda: cpp.group_covariance(
        torch.rand(1, 3, 2), torch.rand(1, 2), torch.rand(1, 3), torch.tensor([[0, 2]])
    ),
    "group below": lambda: cpp.group_covariance(
        torch.rand(1, 3, 2), torch.rand(1, 2), torch.rand(1, 3), torch.tensor([[-1, 0]])
    ),
    "too many numbers": lambda: cpp.philox_normals(
        torch.tensor(1), 1, torch.tensor(1), torch.arange(4), 2**29, 2**29
    ),
    "no particles": lambda: cpp.marginal_scores(
        torch.rand(1, 2), torch.rand(1, 0, 2), torch.rand(1, 0)
    ),
    "unknown step": lambda: cpp.run_steps(4096, 1, [], [], [torch.rand(2, 1)], []),
}


@compiler
def test_wrong_values_are_refused() -> None:
    for case, call in WRONG.items():
        with pytest.raises(RuntimeError) as raised:
            call()
        assert "must be" in str(raised.value) or "more than" in str(raised.value), case


@compiler
def test_a_compiled_step_takes_the_arguments_that_it_was_compiled_for() -> None:
    """The address is not called: the check comes first."""
    example = [torch.rand(3, 2), torch.rand(4, dtype=torch.float64)]
    cpp.register_step(4096, 1, example)
    wrong = {
        "outputs": (2, [torch.rand(1, 3, 2), torch.rand(1, 4).double()]),
        "arguments": (1, [torch.rand(1, 3, 2)]),
        "argument 0": (1, [torch.rand(1, 2, 3), torch.rand(1, 4).double()]),
        "argument 1": (1, [torch.rand(1, 3, 2), torch.rand(1, 4)]),
        "one row": (1, [torch.rand(1, 3, 2), torch.rand(2, 4).double()]),
    }
    for words, (outputs, inputs) in wrong.items():
        with pytest.raises(RuntimeError, match=words):
            cpp.run_steps(4096, outputs, [], [], inputs, [])
    with pytest.raises(RuntimeError, match="inputs must have at least one"):
        cpp.run_steps(4096, 1, example, [], [], [])
    strided = torch.rand(1, 2, 3).permute(0, 2, 1)
    with pytest.raises(RuntimeError, match="strides"):
        cpp.run_steps(4096, 1, [], [], [strided, torch.rand(1, 4).double()], [])


def test_the_python_check_names_the_argument() -> None:
    cases = {
        r"gather_particles must have 2 arguments, got 1": ("gather_particles", [X]),
        r"gather_particles: x must be a tensor, got int": ("gather_particles", [3, W]),
        r"ancestors must be int64, got torch.float32": ("gather_particles", [X, W]),
        r"ancestors must have shape \[R, M\], got \[2, 4\] with D = 2, R = 3, N = 4": (
            "gather_particles",
            [X, torch.zeros(2, 4, dtype=torch.int64)],
        ),
        r"n must have shape \[R or 1, 1\], got \[4\]": (
            "resample_systematic",
            [W, torch.ones(4), ONE],
        ),
        r"quarters must be a whole number from 0 on, got -1": (
            "philox_normals",
            [torch.tensor(1), 1, torch.tensor(1), torch.arange(2), 1, -1],
        ),
        r"w must be float32, got torch.float64": (
            "weighted_moments",
            [X, torch.rand(2, 3).double()],
        ),
    }
    for message, (name, arguments) in cases.items():
        with pytest.raises(ValueError, match=message):
            manifest.check_arguments(name, arguments)
    manifest.check_arguments("gather_particles", [X, torch.zeros(3, 9, dtype=torch.int64)])


def sanitizer_libraries() -> list[str]:
    """Paths of the runtimes of both sanitizers; empty without them."""
    if COMPILER is None:
        return []
    paths = []
    for name in ("libasan.so", "libubsan.so"):
        command = [COMPILER, f"-print-file-name={name}"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        path = Path(done.stdout.strip())
        if not path.is_absolute() or not path.exists():
            return []
        paths.append(str(path.resolve()))
    return paths


@pytest.mark.slow
def test_the_sanitizers_find_nothing_in_random_calls() -> None:
    libraries = sanitizer_libraries()
    if not libraries:
        pytest.skip("no runtimes of AddressSanitizer and UndefinedBehaviorSanitizer")
    environment = {
        **os.environ,
        "LD_PRELOAD": " ".join(libraries),
        "ASAN_OPTIONS": "detect_leaks=0",  # of Python and torch
    }
    command = [sys.executable, str(TESTS / "kernels" / "random_calls.py"), "10000", "2", "sanitize"]
    done = subprocess.run(
        command, capture_output=True, text=True, env=environment, check=False, timeout=1200
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "'wrong but computed': 0, 'valid but refused': 0" in done.stdout
