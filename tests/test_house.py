"""The structure of the package: floors, sizes, single definitions and packaging, from the syntax trees."""

from __future__ import annotations

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import house_budget
import pytest
from checkout import ROOT
from house_budget import tree_of

PACKAGE = ROOT / "pfbench"
FILES = sorted(PACKAGE.rglob("*.py"))

# The floors from the ground up. A folder may import the folders of lower floors, and itself.
FLOORS = (
    ("core", "files", "kernels"),
    ("nav",),
    ("model", "noise"),
    ("filter", "scenario"),
    ("stats",),
    ("results",),
    ("report", "job", "learn", "ppl", "testing"),
    ("claims", "judge"),
    ("cli",),
    ("door",),
    ("logs",),
    ("__main__",),
)
FLOOR = {folder: height for height, floor in enumerate(FLOORS) for folder in floor}
# core and kernels form the ground floor together: draws and covariances call operators, operators use nothing above
TOGETHER = {("core", "kernels"), ("kernels", "core")}
ONLY = {  # (importing folder, imported folder): the modules that it may name
    ("filter", "model"): {"pfbench.model.base"},
}
NEVER = {("filter", "noise"), ("scenario", "results"), ("scenario", "filter"), ("nav", "kernels")}
AT_THE_SAME_FLOOR = {("learn", "job")}
FOREIGN = {"hydra": {"cli", "door", "job"}, "omegaconf": {"cli", "job"}}
NO_ENGINE = ("torch", "pyro", "hydra")  # stored files are enough for these folders
STORED = {"stats", "results", "report", "claims", "judge", "logs.judge"}
LONGEST_FUNCTION = 25


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(tree: ast.AST, package: tuple[str, ...]) -> Iterator[str]:
    """Yield the dotted names of all imports; `from a import b` gives a.b, since b may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            stem = ".".join(part for part in (base, node.module) if part)
            yield from (f"{stem}.{alias.name}" for alias in node.names)


def allowed(folder: str, name: str) -> bool:
    """Return whether a module of a folder may import a dotted name of pfbench."""
    parts = name.split(".")
    target = parts[1] if len(parts) > 1 else ""
    if target not in FLOOR:  # the package itself: its version and `load`
        return FLOOR[folder] >= FLOOR["results"]
    pair = (folder, target)
    if target == folder or pair in TOGETHER:
        return True
    if name.startswith("pfbench.core.lazy_import"):
        return True
    if pair in NEVER:
        return False
    if pair in ONLY and not any(name.startswith(module) for module in ONLY[pair]):
        return False
    return FLOOR[target] < FLOOR[folder] or pair in AT_THE_SAME_FLOOR


def violations(source: str | ast.AST, module: str) -> list[str]:
    """Return the imports that the floors forbid, for a module such as pfbench.filter.loop."""
    tree = ast.parse(source) if isinstance(source, str) else source
    parts = module.split(".")
    folder = parts[1] if len(parts) > 1 else "__main__"
    forbidden = []
    for name in imported(tree, tuple(parts[:-1])):
        top = name.split(".")[0]
        wrong = (
            not allowed(folder, name)
            if top == "pfbench"
            else (top in FOREIGN and folder not in FOREIGN[top])
            or (top in NO_ENGINE and (folder in STORED or ".".join(parts[1:3]) in STORED))
        )
        if wrong:
            forbidden.append(f"{module} imports {name}")
    return forbidden


def imported_at_import(file: Path) -> list[str]:
    """Return the imports that run with the module: not inside functions, not for the type checker only."""
    body = [
        node for node in tree_of(file).body if not isinstance(node, ast.FunctionDef | ast.ClassDef)
    ]
    body = [
        node
        for node in body
        if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
    ]
    return list(imported(ast.Module(body, []), tuple(module_name(file).split(".")[:1])))


def test_floors() -> None:
    inside = [file for file in FILES if file != PACKAGE / "__init__.py"]
    assert {module_name(file).split(".")[1] for file in inside} <= set(FLOOR)
    assert [line for file in inside for line in violations(tree_of(file), module_name(file))] == []
    first = [
        name
        for name in imported_at_import(PACKAGE / "__init__.py")
        if name.split(".")[0] in (*NO_ENGINE, "pfbench")
    ]
    assert first == []  # the lazy door


def test_the_page_for_contributors_states_floors_and_limits() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    lines = re.findall(r"^  \d+\. (`.+`)$", text, re.MULTILINE)
    stated = [tuple(re.findall(r"`(\w+)`", line)) for line in lines]
    assert stated == [tuple(sorted(floor)) for floor in FLOORS[-2::-1]]
    lint = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["lint"]
    limits = (
        f"A function has at most {LONGEST_FUNCTION} statements and complexity "
        f"{lint['mccabe']['max-complexity']}"
    )
    assert limits in " ".join(text.split())


BROKEN = {
    "pfbench.core.record": "from pfbench.nav.earth import radii",
    "pfbench.nav.earth": "import pfbench.model.base",
    "pfbench.core.chart": "from pfbench import model",
    "pfbench.model.textbook": "from pfbench.noise.base import NominalNoise",
    "pfbench.filter.loop": "from pfbench.model.textbook import UnivariateGrowth",
    "pfbench.filter.gaussian.gaussian_filter": "def f():\n    from pfbench.scenario import base",
    "pfbench.scenario.base": "from pfbench.filter import loop",
    "pfbench.filter.smoothing": "from ..model import linear_gaussian",
    "pfbench.job.plan": "from pfbench.report import page",
    "pfbench.report.study_report": "import torch",
    "pfbench.results.metrics": "from pfbench.job import plan",
    "pfbench.results.store": "from pyro import distributions",
    "pfbench.model.base": "from hydra.utils import instantiate",
}


def test_the_floor_test_finds_forbidden_imports() -> None:
    assert {
        module: len(violations(source, module)) for module, source in BROKEN.items()
    } == dict.fromkeys(BROKEN, 1)
    fine = "from pfbench.model.base import StaticModel\nfrom . import smoothing\nimport torch"
    assert violations(fine, "pfbench.filter.loop") == []
    assert violations("from pfbench.results import store\nimport hydra", "pfbench.job.plan") == []


@cache
def names_of_the_wing() -> frozenset[str]:
    """Return the names by which a door of another folder passes on a part of pfbench/logs."""
    return frozenset(
        f"{'.'.join(door.relative_to(ROOT).parent.parts)}.{alias.name}"
        for door in PACKAGE.rglob("__init__.pyi")
        for node in tree_of(door).body
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("pfbench.logs")
        for alias in node.names
    )


def reaches_into_the_wing(source: str | ast.AST, module: str) -> set[str]:
    """Return what a module outside of pfbench/logs imports of it, directly or through a door."""
    tree = ast.parse(source) if isinstance(source, str) else source
    names = set(imported(tree, tuple(module.split(".")[:-1])))
    return {n for n in names if n.startswith("pfbench.logs") or n in names_of_the_wing()}


def test_nothing_reaches_into_the_wing_of_logs() -> None:
    found = {
        module_name(file): reaches_into_the_wing(tree_of(file), module_name(file))
        for file in FILES
        if PACKAGE / "logs" not in file.parents
    }
    assert {module: names for module, names in found.items() if names} == {
        "pfbench": {
            "pfbench.door.make_log",
            "pfbench.job.estimate_track",
            "pfbench.scenario.inspect_log",
        }
    }  # lazy names that `pfbench` itself passes on
    assert reaches_into_the_wing("from pfbench.scenario import UserLog", "pfbench.job.plan")


@pytest.mark.slow
def test_without_the_wing_worlds_are_simulated_and_reported(tmp_path: Path) -> None:
    shutil.copytree(PACKAGE, tmp_path / "pfbench", ignore=shutil.ignore_patterns("logs", "*.pyc"))
    for folder in ("conf", "experiments"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    code = """
import sys; import pfbench; from pfbench.cli import main
assert pfbench.__file__.startswith(sys.argv[1])
main(["run", "-m", "scenario=linear_walk", "model=linear_walk", "filter=ekf,sir", "runs=5", "particles=20", "study=core"])
main(["report", "study=core"])
assert not [name for name in sys.modules if name.startswith("pfbench.logs")]
"""
    where = {**os.environ, "PYTHONPATH": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, cwd=tmp_path, env=where
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "reports" / "core" / "index.html").is_file()


def test_nothing_loose_at_the_top() -> None:
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} == {
        "__init__.py",
        "__main__.py",
        "py.typed",
    }
    assert [
        f for f in FILES if f.stem in ("utils", "util", "helpers", "helper", "common", "misc")
    ] == []


# what every command defines, and the logger of a module
OF_EACH_MODULE = {"COMMAND", "log"}


def defined_names(tree: ast.Module) -> Iterator[str]:
    """Yield the public names that a module defines: classes, functions, constants and types."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            names = [node.name]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            parts = [part for target in targets for part in ast.walk(target)]
            names = [part.id for part in parts if isinstance(part, ast.Name)]
        else:
            names = []
        yield from (name for name in names if not name.startswith("_"))


def test_a_public_name_is_defined_once() -> None:
    homes = defaultdict(set)
    for file in FILES:
        for name in defined_names(tree_of(file)):
            homes[name].add(module_name(file))
    assert {
        name: modules
        for name, modules in homes.items()
        if len(modules) > 1 and name not in OF_EACH_MODULE
    } == {}
    source = "A, B = 1, 2\nC: int = 3\ndef f(): ...\nclass D: ...\n_E = 4"
    assert list(defined_names(ast.parse(source))) == ["A", "B", "C", "f", "D"]


def statements(function: ast.FunctionDef) -> int:
    """Count the statements of a function without its docstring and nested functions' own."""
    body = [node for node in ast.walk(function) if isinstance(node, ast.stmt)]
    return len(body) - 1 - (ast.get_docstring(function) is not None)


def test_functions_are_short() -> None:
    functions = {
        f"{module_name(file)}.{node.name}": n
        for file in FILES
        for node in ast.walk(tree_of(file))
        if isinstance(node, ast.FunctionDef) and (n := statements(node)) > LONGEST_FUNCTION
    }
    assert functions == {}


def test_the_budget_of_the_house() -> None:
    used, ceilings = house_budget.measure(), house_budget.read_ceilings()
    assert house_budget.list_excesses(used, ceilings) == []
    one = {"statements": {**used["statements"], "filter": ceilings["statements"]["filter"] + 1}}
    assert len(house_budget.list_excesses(one, ceilings)) == 1
    new = {"statements": {"new_room": 1}}
    assert house_budget.list_excesses(new, ceilings) == ["statements, new_room: 1 of 0"]


def test_no_sum_of_ceilings_rises() -> None:
    text = house_budget.BUDGET.read_text()
    assert [house_budget.list_raised_sums(text, old) for old in house_budget.read_earlier()] == [
        [] for _ in house_budget.read_earlier()
    ]
    old = 'ruler = 1\n[statements]\n"a" = 5\n"b" = 5\n'
    moved, more = old.replace('"a" = 5', '"a" = 4'), old.replace('"b" = 5', '"b" = 6')
    assert house_budget.list_raised_sums(moved.replace('"b" = 5', '"b" = 6'), old) == []
    assert house_budget.list_raised_sums(more, old) == ["statements: 10 -> 11"]
    assert house_budget.list_raised_sums(more.replace("ruler = 1", "ruler = 2"), old) == []


def test_the_counts_of_the_house_are_of_statements() -> None:
    source = '''"""Text."""
from typing import NamedTuple
A, _B = 1, 2
class C(NamedTuple):
    """Text."""
    x: int; y: int
def f(): return A
'''
    tree = ast.parse(source)
    assert house_budget.count_statements(tree) == 7
    assert house_budget.long_records(tree) == 0
    fields = "".join(f"    x{k}: int\n" for k in range(13))
    assert house_budget.long_records(ast.parse(f"class C(NamedTuple):\n{fields}")) == 1


def test_the_command_line_imports_lazily() -> None:
    """Help of a command, and the refusal of its words, come before the libraries of its work."""
    code = (
        "import sys; from pfbench.cli.command import list_commands; [f.load() for f in list_commands().values()]; "
        "print({'torch', 'pyro', 'hydra', 'matplotlib'} & {*sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout == "set()\n", run.stderr


def test_a_report_needs_no_engine() -> None:
    modules = [
        module_name(f)
        for f in FILES
        if module_name(f).startswith(tuple(f"pfbench.{folder}" for folder in STORED))
    ]
    code = (
        f"import sys, {', '.join(modules)}; print([m for m in {NO_ENGINE!r} if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert run.stdout.strip() == "[]"


def test_the_package_list_is_what_is_on_disk() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    homes = {name: folder for name, folder in setuptools["package-dir"].items() if name}
    on_disk = {module_name(f) for f in PACKAGE.rglob("__init__.py")} | set(homes)
    assert set(setuptools["packages"]) == on_disk
    assert all(
        (ROOT / folder / "__init__.py").is_file()
        for folder in homes.values()
        if folder != "reports"
    )  # data
    assert {f.parent for f in FILES} == {
        f.parent for f in PACKAGE.rglob("__init__.py")
    }  # no folder left outside


def test_test_files_have_names_of_their_own() -> None:
    names = [f.name for f in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(
        set(names)
    )  # without __init__.py, two of one name hide each other


def test_tests_do_not_import_tests() -> None:
    for file in (ROOT / "tests").rglob("*.py"):
        tests = [name for name in imported_at_import(file) if name.startswith("test_")]
        assert not tests, f"{file.name} imports {tests}: move the shared code to a helper module"


def missing_imports(source: str) -> list[str]:
    """Return the names of pfbench that a script imports and that do not exist."""
    missing = []
    for name in imported(ast.parse(source), ()):
        module, _, attribute = name.rpartition(".")
        if name.split(".")[0] != "pfbench" or not module:
            continue
        if not hasattr(importlib.import_module(module), attribute):
            try:
                importlib.import_module(name)
            except ImportError:
                missing.append(name)
    return missing


def test_scripts_import_names_that_exist() -> None:
    """Scripts outside the package run by hand, so a moved name would be found late."""
    files = [f for folder in ("experiments", "benchmarks") for f in (ROOT / folder).rglob("*.py")]
    assert len(files) > 20
    assert {str(f.name): names for f in files if (names := missing_imports(f.read_text()))} == {}
    assert missing_imports("from pfbench.filter import Chaos") == ["pfbench.filter.Chaos"]


def test_no_file_has_the_marks_of_a_merge() -> None:
    listed = subprocess.run(["git", "grep", "-lE", "^(<{7}|>{7}) "], cwd=ROOT, capture_output=True, text=True)  # fmt: skip
    assert listed.stdout == ""
    assert listed.returncode == 1  # nothing, and no error
