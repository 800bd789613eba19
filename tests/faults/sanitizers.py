"""AddressSanitizer and UndefinedBehaviorSanitizer over random calls of the C++ operators and over their tests."""

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from types import ModuleType

from checkout import ROOT, TESTS

from faults.tally import FINE, Tally

KERNELS = TESTS / "kernels"
CALLS = 10_000
RUNS = ("random shapes", "operators' tests")
FILES = ("test_operator_checks.py", "test_philox.py", "test_cpp_library.py", "test_compilation.py")
_FOUND = re.compile(r"(AddressSanitizer|runtime error): .*")
_PASSED = re.compile(r"(\d+) passed")
TIMEOUT = 3600  # s


@cache
def load_plugin() -> ModuleType:
    """Import the plugin of the sanitizers, which lies beside the tests of the operators."""
    sys.path.append(str(KERNELS))
    return importlib.import_module("sanitized")


def run_python(*words: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the runtimes of the sanitizers."""
    return subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        env=load_plugin().make_environment(),
        cwd=ROOT,
        timeout=TIMEOUT,
        check=False,
    )


def run(name: str, count: int, seed: int) -> Tally:
    """Make `count` random calls, or run the tests of the operators."""
    tally = Tally(f"sanitizers: {name}")
    if not load_plugin().find_runtimes():
        tally.skipped = "not run: no sanitizers"
    elif name == RUNS[0]:
        _count_calls(tally, count, seed)
    else:
        _count_tests(tally)
    return tally


def _count_calls(tally: Tally, count: int, seed: int) -> None:
    done = run_python(str(KERNELS / "random_calls.py"), str(count), str(seed), "sanitize")
    if done.returncode:
        tally.add("crash", *_reason(done))
        return
    for words, number in ast.literal_eval(done.stdout.splitlines()[-1]).items():
        outcome = FINE if words in ("computed", "refused") else "false"
        for _ in range(number):
            tally.add(outcome, words, f"seed {seed}")


def _count_tests(tally: Tally) -> None:
    files = [str(KERNELS / name) for name in FILES]
    done = run_python(
        *("-m", "pytest", "-q", "-p", "sanitized", "-p", "no:cacheprovider"),
        *("-m", "not slow", "-o", "addopts=", *files),
    )
    passed = _PASSED.search(done.stdout)
    for _ in range(int(passed[1]) if passed else 0):
        tally.add(FINE, "passed")
    if done.returncode or not passed:
        tally.add("crash", *_reason(done))


def _reason(done: subprocess.CompletedProcess[str]) -> tuple[str, str]:
    found = _FOUND.search(done.stderr + done.stdout)
    return (found[0].split(" on address")[0] if found else f"exit code {done.returncode}"), (
        done.stdout + done.stderr
    )[-500:]
