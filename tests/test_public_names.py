"""What pages, YAML files and scripts name is public: listed in `__all__` of pfbench or of one of its folders."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from functools import cache
from types import ModuleType

import pytest
from checkout import ROOT

import pfbench

SHORT = [
    "Part",
    "Study",
    "check",
    "get",
    "log",
    "names",
    "own",
    "run",
    "study",
    "train",
]  # of pfbench.door
FOLDERS = [
    name
    for name in pfbench.__all__
    if name not in ("__version__", "estimate_track", "inspect_log", "load", *SHORT)
]
DOTTED = re.compile(r"(?<![\w/.])pfbench(?:\.[A-Za-z_]\w*)+")
COMMAND = re.compile(r"-m pfbench[\w.]*")
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
YAML = [file for folder in ("conf", "experiments") for file in (ROOT / folder).rglob("*.yaml")]
# they show, check or fit internals, which have no public name
SCRIPTS = [
    file
    for file in (ROOT / "experiments").rglob("*.py")
    if file.name
    not in (
        "earth_rows.py",
        "method_pictures.py",
        "site_pages.py",
        "word_rates.py",
        "urban_error_fit.py",
    )
]


@cache
def exports(module: str) -> frozenset[str]:
    return frozenset(importlib.import_module(module).__all__)


def is_public(name: str) -> bool:
    """Return whether a dotted name is pfbench, a folder, or what one of them exports (and parts of that)."""
    parts = name.split(".")
    if len(parts) < 2 or parts[1] not in exports("pfbench"):
        return len(parts) == 1 or parts[1] == "experiments"  # scripts, which import each other
    return len(parts) == 2 or parts[1] not in FOLDERS or parts[2] in exports(".".join(parts[:2]))


def names_of_code(source: str) -> set[str]:
    """Return the dotted names of pfbench that a program imports or reads, an imported module by its own name."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Attribute):
            names.add(ast.unparse(node))
    return {name for name in names if name.split(".")[0] == "pfbench"}


def names_of_text(text: str) -> set[str]:
    """Return the dotted names of pfbench in YAML or prose, without commands and names of files."""
    names = set(DOTTED.findall(COMMAND.sub("", text)))
    return {name for name in names if not name.endswith((".bib", ".py", ".__all__"))}


def names_of_page(text: str) -> set[str]:
    text = re.sub(
        r"^File `pfbench/[^`]+`:\n\n```.*?^```$", "", text, flags=re.M | re.S
    )  # of the package itself
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    return names_of_text(text).union(*map(names_of_code, blocks))


def private(names: set[str]) -> list[str]:
    return sorted(name for name in names if not is_public(name))


def test_the_finders_of_names_find_what_is_private() -> None:
    code = "from pfbench.core.record import Record\nimport pfbench\npfbench.filter.Chaos()\npfbench.load('x').index"
    assert private(names_of_code(code)) == ["pfbench.core.record.Record", "pfbench.filter.Chaos"]
    block = "```python\nfrom pfbench.core import Record\nfrom pfbench.job import plan\n```\n"
    prose = "`pfbench.nav.earth`, `pfbench.load`, `pfbench.filter.Systematic.is_exact`, `-m pfbench.a.b`"
    found = private(names_of_page(block + prose))
    assert found == ["pfbench.job.plan", "pfbench.nav.earth"]
    assert private(names_of_text("_target_: pfbench.model.sins_sar.SinsSar")) != []


def test_pages_yaml_files_and_scripts_name_public_names_only() -> None:
    assert min(len(PAGES), len(YAML) // 10, len(SCRIPTS)) > 6
    found = {str(file): private(names_of_page(file.read_text())) for file in PAGES}
    found |= {str(file): private(names_of_text(file.read_text())) for file in YAML}
    found |= {str(file): private(names_of_code(file.read_text())) for file in SCRIPTS}
    assert {file: names for file, names in found.items() if names} == {}


def test_benchmarks_import_public_names_from_the_folder() -> None:
    """They also measure internals, which have no public name."""
    wrong = {
        file.name: [
            name
            for name in private(names_of_code(file.read_text()))
            if (parts := name.split("."))[1] in FOLDERS
            and parts[-1] in exports(f"pfbench.{parts[1]}")
        ]
        for file in (ROOT / "benchmarks").glob("*.py")
    }
    assert {file: names for file, names in wrong.items() if names} == {}


@pytest.mark.parametrize("module", [pfbench, *(getattr(pfbench, name) for name in FOLDERS)])
def test_every_public_name_imports(module: ModuleType) -> None:
    assert sorted(module.__all__) == dir(module)
    assert all(hasattr(module, name) for name in module.__all__)
    if module is not pfbench:  # an attribute would be hidden by a module of the same name
        modules = {found.name for found in pkgutil.iter_modules(module.__path__)}
        assert not modules & set(module.__all__)
    with pytest.raises(AttributeError, match=r"does not define 'Chaos'\. Choose a name of "):
        module.Chaos  # noqa: B018


@pytest.mark.parametrize("file", ["__init__.py", *(f"{name}/__init__.pyi" for name in FOLDERS)])
def test_type_checkers_know_every_public_name(file: str) -> None:
    """They take an import of a package as public only if it is written `x as x`."""
    statements = ast.walk(ast.parse((ROOT / "pfbench" / file).read_text()))
    imports = [s for s in statements if isinstance(s, ast.ImportFrom)]
    names = [a for s in imports if str(s.module).startswith("pfbench") for a in s.names]
    exported = sorted(alias.name for alias in names if alias.asname == alias.name)
    assert len(set(exported)) == len(exported)
    if file == "__init__.py":
        assert exported == sorted([*FOLDERS, "Part", "Study", "estimate_track", "inspect_log"])
        aliases = {alias.asname: alias.name for alias in names if alias.asname != alias.name}
        assert {k: v for k, v in aliases.items() if k} == {
            name: pfbench._DOOR[name] for name in SHORT if name[0].islower()
        }
    else:
        assert exported == sorted(exports(f"pfbench.{file.partition('/')[0]}"))


def test_the_public_names_are_imported_on_first_use() -> None:
    code = (
        "import sys, pfbench; before = sorted(m for m in sys.modules if m.startswith('pfbench'));"
        "pfbench.filter; after = 'torch' in sys.modules; pfbench.filter.Systematic;"
        "print(before, after, 'torch' in sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "['pfbench'] False True"
