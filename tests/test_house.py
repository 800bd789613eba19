"""The rules of the house: who may import whom, what is packaged, how files are called. Read from the syntax trees."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pfbench"
FILES = sorted(PACKAGE.rglob("*.py"))

# what each part of the house may import; a part may always import itself
FAST = {"fusion", "native"}
GROUND = {"record", "draws", "covariance", "derivatives"}
CHARTED = GROUND | {"nav", "chart"}
MODELLED = CHARTED | {"model", "noise"}
PLAIN = {"metrics", "store"}
MAY_IMPORT: dict[str, set[str]] = {
    **{part: FAST | {"cuda"} for part in GROUND},
    **{part: set() for part in PLAIN | {"cuda"}},
    **{part: {"cuda"} for part in FAST},
    "nav": GROUND,
    "chart": GROUND | {"nav"},
    "model": CHARTED | FAST,
    "noise": CHARTED,
    "filter": CHARTED | FAST | {"model.base"},
    **{part: CHARTED | {"model.base", "filter"} for part in ("bound", "memory")},
    "judge": CHARTED | FAST | {"model.base", "filter"},
    "budget": CHARTED | {"model.base", "filter", "judge", "memory", "store"},
    "scenario": MODELLED,
    "lessons": MODELLED | {"scenario"},
    "train": MODELLED | PLAIN | {"filter", "scenario", "lessons"},
    "job": MODELLED | PLAIN | FAST | {"filter", "bound", "judge", "memory", "budget", "scenario"},
    "ppl": MODELLED | {"filter", "report.canvas"},
    "survey": MODELLED | PLAIN | FAST | {"filter", "bound", "judge", "scenario", "job"},
    "report": PLAIN,
    "cli": MODELLED | PLAIN | {"filter", "scenario", "job", "survey", "train", "ppl", "report"},
    "pieces": set(),
    "__main__": {"cli"},
}
UPSTAIRS = {"job", "train", "cli"}  # may ask the package itself, for its version
FOREIGN = {"hydra": {"cli", "job"}, "omegaconf": {"cli", "job"}}
NO_ENGINE = ("torch", "pyro", "hydra")  # for a report, files are enough


def imported(tree: ast.AST, package: tuple[str, ...]) -> Iterator[str]:
    """Dotted names of all imports, wherever they stand; `from a import b` gives a.b, since b may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            stem = ".".join(part for part in (base, node.module) if part)
            yield from (f"{stem}.{alias.name}" for alias in node.names)


def violations(source: str, module: str) -> list[str]:
    """Imports that the floors forbid, for a module such as pfbench.filter.loop."""
    parts = module.split(".")
    part = parts[1]
    found = []
    for name in imported(ast.parse(source), tuple(parts[:-1])):
        top, *rest = name.split(".")
        if top == "pfbench":
            inside = rest[0] if rest else ""
            allowed = MAY_IMPORT[part] | {part}
            at_the_door = inside in ("", "__version__", "load") and part in UPSTAIRS
            if not ({inside, ".".join(rest[:2])} & allowed or at_the_door):
                found.append(f"{module} imports {name}")
        elif (top in FOREIGN and part not in FOREIGN[top]) or (top in NO_ENGINE and part in PLAIN | {"report"}):
            found.append(f"{module} imports {name}")
    return found


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_floors(file: Path) -> None:
    if file == PACKAGE / "__init__.py":  # the lazy door
        assert not [name for name in imported_at_import(file) if name.split(".")[0] in (*NO_ENGINE, "pfbench")]
        return
    part = module_name(file).split(".")[1]
    assert part in MAY_IMPORT, f"{part} has no floor: decide who may import it"
    assert violations(file.read_text(), module_name(file)) == []


BROKEN = {
    "pfbench.record": "from pfbench.chart import Chart",
    "pfbench.nav.earth": "import pfbench.chart",
    "pfbench.chart": "from pfbench import model",
    "pfbench.model.toys": "from pfbench.noise.regimes import Nominal",
    "pfbench.filter.loop": "from pfbench.model.toys import Growth",
    "pfbench.filter.gaussian": "def f():\n    from pfbench.scenario import base",
    "pfbench.scenario.base": "from pfbench.filter import loop",
    "pfbench.filter.rules": "from ..model import linear",
    "pfbench.job": "from pfbench.report import frame",
    "pfbench.report.frame": "import torch",
    "pfbench.metrics": "from pfbench.record import Record",
    "pfbench.store": "from pyro import distributions",
    "pfbench.model.base": "from hydra.utils import instantiate",
}


@pytest.mark.parametrize("module", BROKEN)
def test_the_floors_see_what_breaks_them(module: str) -> None:
    assert len(violations(BROKEN[module], module)) == 1


def test_the_floors_let_through_what_is_allowed() -> None:
    assert violations("from pfbench.model.base import AtRest\nfrom . import rules\nimport torch", "pfbench.filter.loop") == []
    assert violations("from pfbench import store\nimport hydra", "pfbench.job") == []


def imported_at_import(file: Path) -> list[str]:
    """Imports that run when the module does: not inside functions, not for the type checker only."""
    body = [node for node in ast.parse(file.read_text()).body if not isinstance(node, ast.FunctionDef | ast.ClassDef)]
    body = [node for node in body if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))]
    return list(imported(ast.Module(body, []), module_name(file).split(".")[:1]))


def test_the_command_line_opens_its_rooms_lazily() -> None:
    names = imported_at_import(PACKAGE / "cli.py")
    assert not [n for n in names if n.split(".")[0] in ("torch", "pyro") or n.startswith(("pfbench.job", "pfbench.report"))]


def test_a_report_needs_no_engine() -> None:
    modules = [module_name(f) for f in FILES if module_name(f).startswith(("pfbench.report", "pfbench.metrics", "pfbench.store"))]
    code = f"import sys, {', '.join(modules)}; print([m for m in {NO_ENGINE!r} if m in sys.modules])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert run.stdout.strip() == "[]"


def test_the_package_list_is_what_is_on_disk() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    homes = {name: folder for name, folder in setuptools["package-dir"].items() if name}
    on_disk = {module_name(f) for f in PACKAGE.rglob("__init__.py")} | set(homes)
    assert set(setuptools["packages"]) == on_disk
    assert all((ROOT / folder / "__init__.py").is_file() for folder in homes.values())
    assert {f.parent for f in FILES} == {f.parent for f in PACKAGE.rglob("__init__.py")}  # no folder left outside


def test_no_module_without_a_subject() -> None:
    assert [f for f in FILES if f.stem in ("utils", "util", "helpers", "helper", "common", "misc")] == []


def test_test_files_have_names_of_their_own() -> None:
    names = [f.name for f in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))  # without __init__.py, two of one name hide each other
