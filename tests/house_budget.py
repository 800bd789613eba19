"""Budget of the house: `python tests/house_budget.py [--lower]` prints use and ceiling of each room, and lowers ceilings to use.

tests/house_budget.toml has the ceilings. Statements are counted in the syntax trees without docstrings, so wide lines, packed
lines and comments change nothing. A ceiling rises only with an equal fall of others in the same commit, so no sum of a table rises
from one commit to a later one. A change of this ruler is a commit of its own and raises `ruler` in the file.
"""

import argparse
import ast
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGET = Path(__file__).with_suffix(".toml")
Table = dict[str, int]
MANY_FIELDS = 12
KINDS = {"conf": ("conf/*.yaml",), "experiments": ("experiments/*.yaml",), "templates": ("*.jinja",), "scripts of pages": ("pfbench/*.js", "pfbench/*.css"), "C++": ("pfbench/*.cpp", "pfbench/*.h", "pfbench/*.cu")}  # fmt: skip


@cache
def tree_of(file: Path) -> ast.Module:
    """Parse a file."""
    return ast.parse(file.read_text())


def count_statements(tree: ast.AST) -> int:
    """Count the statements of a tree without docstrings."""
    return sum(
        isinstance(node, ast.stmt)
        and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for node in ast.walk(tree)
    )


def long_records(tree: ast.Module) -> int:
    """Count the named tuples and data classes with many fields."""
    found = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            kinds = {ast.unparse(b).split("(")[0] for b in [*node.bases, *node.decorator_list]}
            fields = sum(isinstance(item, ast.AnnAssign) for item in node.body)
            found += bool(kinds & {"NamedTuple", "dataclass"}) and fields > MANY_FIELDS
    return found


def _list_tracked(*patterns: str) -> list[Path]:
    """List the files of the checkout that git knows."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    return [ROOT / name for name in listed if name and (ROOT / name).is_file()]


def measure() -> dict[str, Table]:
    """Return what the rooms, the tests and the other files use."""
    rooms: Table = defaultdict(int)
    counts = {"records over 12 fields": 0, "banners": 0, "tracked files": len(_list_tracked())}
    for file in sorted((ROOT / "pfbench").rglob("*.py")):
        parts = file.relative_to(ROOT / "pfbench").parts
        rooms[parts[0] if len(parts) > 1 else "top"] += count_statements(tree_of(file))
        counts["records over 12 fields"] += long_records(tree_of(file))
        counts["banners"] += len(re.findall(r"^# -{20,}$", file.read_text(), re.M))
    tests = {"all": sum(count_statements(tree_of(f)) for f in _list_tracked("tests/*.py"))}
    kinds = {name: _list_tracked(*patterns) for name, patterns in KINDS.items()}
    files = {name: len(found) for name, found in kinds.items()}
    lines = {name: sum(f.read_text().count("\n") for f in found) for name, found in kinds.items()}
    return {"statements": dict(rooms), "statements of tests": tests, "files": files, "lines": lines, "counts": counts}  # fmt: skip


_ENTERED = """
import sys
from pathlib import Path
import pfbench
package = str(Path(pfbench.__file__).parent) + "/"
calls = {}
def profile(frame, event, argument):
    name = frame.f_code.co_filename
    if event == "call" and name.startswith(package) and not frame.f_code.co_name.startswith("<"):
        key = name[len(package):], frame.f_code.co_name
        calls[key] = calls.get(key, 0) + 1
"""
_COMMAND = """
from pfbench.cli import main
sys.setprofile(profile)
try:
    main(sys.argv[1:])
except SystemExit as stop:
    assert not stop.code
sys.setprofile(None)
print("entered", len(calls))
"""
_STEP = """
import torch
from pfbench.core import PhiloxStream
from pfbench.filter import ParticleFilter, run_filter
from pfbench.model import linear_walk
from pfbench.noise import NominalNoise
from pfbench.scenario import ModelSimulation
model, runs = linear_walk(1.0, 0.3, 1.0), torch.arange(3)
def count(steps):
    record = ModelSimulation(model, steps).draw(NominalNoise(), runs, 1).record
    run_filter(ParticleFilter(100), model, record, PhiloxStream(1, runs))
    calls.clear()
    sys.setprofile(profile)
    run_filter(ParticleFilter(100), model, record, PhiloxStream(1, runs))
    sys.setprofile(None)
    return dict(calls)
short, long = count(10), count(20)
print("entered", sum(long[key] != short.get(key) for key in long))
"""


def _count_entered(code: str, *words: str, folder: str) -> int:
    """Count the functions of the package that a piece of code calls."""
    run = subprocess.run(
        [sys.executable, "-c", _ENTERED + code, *words],
        cwd=folder, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    return int(run.stdout.splitlines()[-1].split()[1])


def measure_reading() -> Table:
    """Return how many functions a step, a run and a report enter: what somebody reads who follows them."""
    words = ("scenario=linear_walk", "model=linear_walk", "runs=4", "particles=50", "study=toy")
    with tempfile.TemporaryDirectory() as folder:
        entered = {"a step of SIR": _count_entered(_STEP, folder=folder)}
        entered["a run"] = _count_entered(_COMMAND, "run", "filter=sir", *words, folder=folder)
        _count_entered(_COMMAND, "run", "filter=apf", *words, folder=folder)
        entered["a report"] = _count_entered(_COMMAND, "report", "study=toy", folder=folder)
    return entered


def read_ceilings() -> dict[str, Table]:
    """Read the ceilings by table and name."""
    return {k: v for k, v in tomllib.loads(BUDGET.read_text()).items() if isinstance(v, dict)}


def list_excesses(used: dict[str, Table], ceilings: dict[str, Table]) -> list[str]:
    """Name what is used above its ceiling."""
    return [
        f"{table}, {name}: {value} of {ceilings.get(table, {}).get(name, 0)}"
        for table, values in used.items()
        for name, value in values.items()
        if value > ceilings.get(table, {}).get(name, 0)
    ]


def list_raised_sums(text: str, earlier: str) -> list[str]:
    """Name the tables whose ceilings together rose since an earlier file of the same ruler."""
    new, old = tomllib.loads(text), tomllib.loads(earlier)
    if new["ruler"] != old["ruler"]:
        return []
    return [
        f"{name}: {sum(old[name].values())} -> {sum(new[name].values())}"
        for name in new.keys() & old.keys() - {"ruler"}
        if sum(new[name].values()) > sum(old[name].values())
    ]


def read_earlier(count: int = 12) -> list[str]:
    """Read the last versions of the file in the history, as far as the checkout has one."""

    def ask(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout

    name = BUDGET.relative_to(ROOT).as_posix()
    commits = ask("log", f"-{count}", "--format=%H", "--", name).split()
    return [text for commit in commits if (text := ask("show", f"{commit}:{name}"))]


def write_ceilings(ceilings: dict[str, Table]) -> None:
    """Write the ceilings below the head of the file."""
    head = BUDGET.read_text().partition("\n[")[0]
    tables = [
        f"\n[{table if table.isalpha() else repr(table)}]\n"
        + "".join(f'"{name}" = {value}\n' for name, value in values.items())
        for table, values in ceilings.items()
    ]
    BUDGET.write_text(head.rstrip() + "\n" + "".join(tables))


def main() -> int:
    """Print use and ceilings, and lower these."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lower", action="store_true", help="lower each ceiling to what is used")
    options = parser.parse_args()
    used, ceilings = measure(), read_ceilings()
    print("functions entered, without a ceiling:", measure_reading())
    for table, values in used.items():
        for name, value in sorted(values.items()):
            print(f"{table:20}{name:26}{value:8} of {ceilings.get(table, {}).get(name, 0):8}")
        print(f"{table:20}{'together':26}{sum(values.values()):8} of {sum(ceilings.get(table, {}).values()):8}")  # fmt: skip
    if options.lower:
        write_ceilings(
            {t: {n: min(v, used[t].get(n, 0)) for n, v in row.items()} for t, row in ceilings.items()}
        )  # fmt: skip
    excesses = list_excesses(used, ceilings)
    print("\n".join(["", "above its ceiling:", *excesses] if excesses else []))
    return bool(excesses)


if __name__ == "__main__":
    sys.exit(main())
