"""Figures of the house that only fall: `python tests/house_figures.py --store [--capability NAME]`.

Without `--store` it prints the figures beside the stored ones (tests/house_figures.json). A figure that rose is stored
only with the name of the capability that it bought, and stays in the list of rises. Statements are counted in the
syntax trees without docstrings: wide lines, packed lines and comments change nothing. Counts of statements may rise by
1 % of what is stored without a name, so that the mend of an error needs none.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STORED = Path(__file__).with_suffix(".json")
Figures = dict[str, int]
MANY_FIELDS = MANY_IMPORTS = 12
SLACK = 0.01


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


def public_names(tree: ast.Module) -> int:
    """Count the names without underscore that a module defines."""
    names = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
    return sum(not name.startswith("_") for name in names)


def long_records(tree: ast.Module) -> int:
    """Count the named tuples and data classes with many fields."""
    found = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            kinds = {ast.unparse(b).split("(")[0] for b in [*node.bases, *node.decorator_list]}
            fields = sum(isinstance(item, ast.AnnAssign) for item in node.body)
            found += bool(kinds & {"NamedTuple", "dataclass"}) and fields > MANY_FIELDS
    return found


def list_imports(tree: ast.Module, modules: set[str]) -> set[str]:
    """List the modules of the package that a module imports, also inside functions."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in modules | {"pfbench"}:
            full = [f"{node.module}.{alias.name}" for alias in node.names]
            names |= {name if name in modules else str(node.module) for name in full}
    return names & modules


def measure() -> Figures:
    """Return the figures that the syntax trees and the list of tracked files show."""
    files = sorted((ROOT / "pfbench").rglob("*.py"))
    name_of = {
        f: ".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for f in files
    }
    figures: Figures = defaultdict(int)
    importers: dict[str, set[str]] = defaultdict(set)
    for file, name in name_of.items():
        tree, room = tree_of(file), (*name.split("."), "top")[1]
        figures[f"statements of {room}"] += count_statements(tree)
        if file.name != "__init__.py":
            figures[f"public names of {room}"] += public_names(tree)
            figures["modules"] += 1
        figures["records over 12 fields"] += long_records(tree)
        imports = list_imports(tree, set(name_of.values())) - {name}
        figures["modules that import over 12 others"] += len(imports) > MANY_IMPORTS
        for other in imports:
            importers[other].add(name)
    figures["modules with one importer, in their own folder"] = sum(
        len(importers[name]) == 1
        and file.name != "__init__.py"
        and name.rpartition(".")[0] == min(importers[name]).rpartition(".")[0]
        for file, name in name_of.items()
    )
    figures["exported names"] = sum(
        len(node.names)
        for door in (ROOT / "pfbench").rglob("__init__.pyi")
        for node in tree_of(door).body
        if isinstance(node, ast.ImportFrom)
    )
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\0")
    tracked = [ROOT / name for name in listed if name and (ROOT / name).is_file()]
    figures["tracked files"] = len(tracked)
    tests = [f for f in tracked if f.suffix == ".py" and f.is_relative_to(ROOT / "tests")]
    figures["statements of tests"] = sum(count_statements(tree_of(f)) for f in tests)
    return dict(figures)


_ENTERED = """
import sys
from pathlib import Path
import pfbench
package = str(Path(pfbench.__file__).parent) + "/"
calls, importing = {}, 0
def profile(frame, event, argument):
    global importing
    name = frame.f_code.co_filename
    if frame.f_code.co_name == "<module>":  # what an import calls is no step of the work
        importing += {"call": 1, "return": -1}.get(event, 0)
    elif event == "call" and not importing and name.startswith(package) and not frame.f_code.co_name.startswith("<"):
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
print("entered", *sorted({name for name, _ in calls if name.endswith(".py")}))
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
print("entered", *sorted({key[0] for key in long if long[key] != short.get(key)}))
"""


def _list_entered(code: str, *words: str, folder: str) -> set[str]:
    """List the modules whose functions a piece of code calls."""
    run = subprocess.run(
        [sys.executable, "-c", _ENTERED + code, *words],
        cwd=folder, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    return set(run.stdout.splitlines()[-1].split()[1:])


def measure_reading() -> Figures:
    """Return how many modules, and statements of them, a step, a run and a report enter."""
    words = ("scenario=linear_walk", "model=linear_walk", "runs=4", "particles=50", "study=toy")
    with tempfile.TemporaryDirectory() as folder:
        entered = {"a step of SIR": _list_entered(_STEP, folder=folder)}
        entered["a run"] = _list_entered(_COMMAND, "run", "filter=sir", *words, folder=folder)
        _list_entered(_COMMAND, "run", "filter=apf", *words, folder=folder)
        entered["a report"] = _list_entered(_COMMAND, "report", "study=toy", folder=folder)
    figures = {f"modules that {name} enters": len(files) for name, files in entered.items()}
    return figures | {
        f"statements of the modules that {name} enters": sum(
            count_statements(tree_of(ROOT / "pfbench" / file)) for file in files
        )
        for name, files in entered.items()
    }


def list_rises(figures: Figures, stored: Figures) -> list[str]:
    """Name the figures that rose, statements by more than the slack of a mend."""
    slack = {name: SLACK * name.startswith("statements") for name in figures}
    return [
        f"{name}: {stored.get(name, 0)} -> {value}"
        for name, value in figures.items()
        if value > (1 + slack[name]) * stored.get(name, 0)
    ]


def main() -> int:
    """Print or store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", action="store_true")
    parser.add_argument("--capability", help="what the rises bought")
    options = parser.parse_args()
    figures = dict(sorted((measure() | measure_reading()).items()))
    content = (
        json.loads(STORED.read_text()) if STORED.exists() else {"figures": figures, "rises": []}
    )
    for name, value in figures.items():
        print(f"{name:60}{content['figures'].get(name, '-'):>8}{value:8}")
    rises = list_rises(figures, content["figures"])
    if options.store and rises and not options.capability:
        print("These rose. Name what they bought: --capability NAME\n" + "\n".join(rises))
        return 1
    if options.store:
        bought = [{"capability": options.capability, "rises": rises}] if rises else []
        STORED.write_text(
            json.dumps({"figures": figures, "rises": content["rises"] + bought}, indent=1) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
