"""Plants faults and checks that tests fail: `python tests/mutants.py [--check] [--baseline] [names]`; `make mutants` runs all.

Each fault of mutants.toml replaces a text that occurs once. It is applied in a temporary copy of the checkout, never in place.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("pfbench", "tests", "conf", "experiments", "benchmarks", "docs")
TIMEOUT = 600  # s for the tests of one fault


def read_faults() -> dict[str, dict[str, Any]]:
    """Return the faults by name."""
    return tomllib.loads((ROOT / "tests" / "mutants.toml").read_text())


def pattern_of(text: str) -> re.Pattern[str]:
    """Return a pattern of the text in which white space and trailing commas do not count."""
    tokens = re.findall(r"\w+|[^\w\s]", text)
    return re.compile(r"\s*(?:,\s*)?".join(re.escape(token) for token in tokens))


def break_source(fault: dict[str, Any], root: Path) -> str:
    """Return the source of the file of a fault with its text replaced.

    Raises:
        ValueError: If the text does not occur once, or this is no Python.
    """
    file, pattern = root / fault["file"], pattern_of(fault["text"])
    source, broken = file.read_text(), fault["broken"].lstrip()  # that before the text stays
    if (count := len(pattern.findall(source))) != 1:
        raise ValueError(
            f"text must occur once in {fault['file']}, got {count}: {fault['text']!r}. Adapt tests/mutants.toml"
        )
    source = pattern.sub(lambda _: broken, source)
    try:
        compile(source if file.suffix == ".py" else "", str(file), "exec")
    except SyntaxError as error:
        raise ValueError(f"broken must be Python, got {broken!r}: {error}") from error
    return source


def plant(fault: dict[str, Any], root: Path) -> None:
    """Replace the text of a fault in a copy of the checkout."""
    (root / fault["file"]).write_text(break_source(fault, root))


def run_tests(tests: list[str], root: Path) -> int:
    """Return the exit status of pytest in a copy; 1 says that a test failed."""
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "-m",
        "not nightly",  # what `make test` runs
        *tests,
    ]
    try:
        return subprocess.run(
            command, cwd=root, env=environment, capture_output=True, timeout=TIMEOUT
        ).returncode
    except subprocess.TimeoutExpired:
        return 124


def try_fault(fault: dict[str, Any], baseline: bool = False) -> str:
    """Return what became of a fault: caught, survived, or a reason why it was not decided.

    With `baseline` nothing is planted, and the tests must pass.
    """
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for name in FOLDERS:
            shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("conf", "experiments"):  # else an editable install finds those of the checkout
            (root / "pfbench" / name).symlink_to(root / name)
        shutil.copy(ROOT / "pyproject.toml", root)
        (root / "reports").mkdir()
        shutil.copy(ROOT / "reports" / "README.md", root / "reports")  # tests/checkout.py reads it
        if baseline:
            status = run_tests(fault["tests"], root)
            return "passes" if status == 0 else f"FAILS without the fault: pytest status {status}"
        try:
            plant(fault, root)
        except ValueError as error:
            return str(error)
        status = run_tests(fault["tests"], root)
    return {0: "SURVIVED", 1: "caught", 5: "no test was selected", 124: "timed out"}.get(
        status, f"pytest status {status}"
    )


def main() -> int:
    """Run the faults that are named, or all, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="faults; all by default")
    parser.add_argument(
        "--check",
        action="store_true",
        help="only check that each text occurs once, and that what replaces it is Python",
    )
    parser.add_argument(
        "--baseline", action="store_true", help="only check that the tests pass without the fault"
    )
    options, faults = parser.parse_args(), read_faults()
    unknown = set(options.names) - set(faults)
    if unknown:
        parser.error(f"names must be faults of mutants.toml, got {', '.join(sorted(unknown))}")
    failures = 0
    for name in options.names or faults:
        start = time.perf_counter()
        if options.check:
            try:
                break_source(faults[name], ROOT)
                outcome = f"in {faults[name]['file']}"
            except ValueError as error:
                outcome, failures = str(error), failures + 1
        else:
            outcome = try_fault(faults[name], options.baseline)
            failures += outcome not in ("caught", "passes")
        print(f"{name:32} {time.perf_counter() - start:6.1f} s  {outcome}", flush=True)
    print(f"{len(options.names or faults)} faults, {failures} not as they should be")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
