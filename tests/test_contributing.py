"""The recipes of CONTRIBUTING.md are followed: files are written, blocks executed and commands run."""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkout import ROOT
from command_line import pfbench

import pfbench as package
from pfbench.report.papers import figures
from pfbench.results import metrics, store

TEXT = (ROOT / "CONTRIBUTING.md").read_text()
RECIPES = {
    title: body
    for title, body in re.findall(r"^### (.*?)\n(.*?)(?=^##|\Z)", TEXT, re.M | re.DOTALL)
}
FILE = re.compile(r"^File `([^`]+)`:\n\n```\w+\n(.*?)^```$", re.M | re.DOTALL)
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.M | re.DOTALL)
COMMAND = "python -m pfbench "


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a folder with the files of all recipes, in which Python finds `mylab`."""
    home = tmp_path_factory.mktemp("contributing")
    (home / "mylab").mkdir()
    (home / "mylab" / "__init__.py").touch()
    for name, content in FILE.findall(TEXT):
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(content)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(home))
        yield home
    for name in [name for name in sys.modules if name.partition(".")[0] == "mylab"]:
        del sys.modules[name]


def follow(title: str, folder: Path) -> dict[str, Any]:
    """Execute the blocks of a recipe and run its commands; return the names that the blocks define."""
    scope: dict[str, Any] = {"__name__": "recipe"}
    for language, block in BLOCK.findall(FILE.sub("", RECIPES[title])):
        if language == "python":
            exec(compile(block, title, "exec"), scope)
            continue
        for line in block.splitlines():
            assert line.startswith(COMMAND)
            printed = pfbench(*shlex.split(line.removeprefix(COMMAND)), home=folder)
            assert printed.code == 0, printed.err
    return scope


def results(folder: Path, study: str) -> dict[str, store.JobResult]:
    """Read the results of a study by label."""
    jobs = [store.read_result(path) for path in (folder / "results" / study).glob("*.npz")]
    return {job.meta["label"]: job for job in jobs}


@pytest.mark.parametrize(
    ("title", "study", "jobs"),
    [
        ("Add a resampling scheme", "resamplers", 2),
        ("Add a filter", "robust", 1),
        ("Add a model", "room", 2),
        ("Add a scenario", "window", 1),
        ("Add a noise regime", "growing", 2),
    ],
)
def test_a_recipe_runs(
    title: str, study: str, jobs: int, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    follow(title, folder)
    paths = list((folder / "results" / study).glob("*.npz"))
    assert len(paths) == jobs
    for path in paths:
        arrays = store.read_result(path).data
        assert arrays["error"].shape[1] == 5  # steps
        assert np.isfinite(arrays["error"]).all()
        assert not arrays["lost"].any()


def test_the_metric_appears_in_the_table(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = follow("Add a metric", folder)["MEDIAN_ERROR"]
    monkeypatch.setattr(metrics, "METRICS", (*metrics.METRICS, entry))
    small_study(tmp_path)
    table = package.load("small", tmp_path / "results")
    rows = table[(table.metric == "median_error") & (table.component == "norm")]
    (job,) = [job for job in results(tmp_path, "small").values() if "sir" in job.meta["label"]]
    error = np.linalg.norm(job.data["error"].astype(float), axis=-1)
    group_rows = rows[rows.label == job.meta["label"]]
    assert len(group_rows) == 3 * group_rows.group.nunique()
    if group_rows.group.nunique() == 1:
        np.testing.assert_allclose(group_rows.value, np.median(error, -1))


def test_the_figure_appears_in_the_report(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    entry = follow("Add a report figure", folder)["FINAL_ERROR"]
    monkeypatch.setitem(figures.FIGURES, "final-error", entry)
    small_study(tmp_path)
    printed = pfbench("report", "study=small", "report.paper_figures=[final-error]", home=tmp_path)
    assert printed.code == 0, printed.err
    report = tmp_path / "reports" / "small"
    assert len(list((report / "figures").glob("paper_final_error_*.svg"))) == 1
    text = " ".join((report / "index.html").read_text().split())
    assert re.search(r"Final error, here [\w ]+, nominal: error of state at the last step", text)


def small_study(home: Path) -> None:
    """Run two filters for five steps."""
    words = "run -m scenario=local_level scenario.steps=5 runs=3 particles=50 filter=sir,ekf study=small"
    printed = pfbench(*words.split(), home=home)
    assert printed.code == 0, printed.err


def test_every_kind_of_part_has_a_recipe() -> None:
    kinds = (
        "resampling scheme, filter, model, scenario, noise regime, metric, report figure, command"
    )
    assert list(RECIPES) == [f"Add a {kind}" for kind in kinds.split(", ")]


def test_named_files_exist() -> None:
    """Paths of the checkout exist, except those that a recipe adds."""
    added = {name for name, _ in FILE.findall(TEXT)}
    added |= {"pfbench/scenario/open_window.py", "pfbench/model/room.py"}
    paths = re.findall(r"`((?:pfbench|tests|conf|benchmarks)/[\w./]+)`", TEXT)
    assert len(paths) > 20
    assert [path for path in paths if path not in added and not (ROOT / path).exists()] == []


def test_the_functions_to_read_are_where_the_page_says() -> None:
    section = TEXT.partition("## Where to read")[2].partition("## Recipes")[0]
    places = re.findall(r"((?:`\w+`(?:,? and |, )?)+) in\s+`([\w/]+\.py)`", section)
    assert len(places) >= 7
    for names, place in places:
        code = (ROOT / "pfbench" / place).read_text()
        assert all(f"def {name}(" in code for name in re.findall(r"`(\w+)`", names)), (names, place)
    for place in re.findall(r"`([\w/]+\.py)`", section):
        assert [*(ROOT / "pfbench").rglob(place)], place


def test_versions_agree() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    (release, *_) = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert citation["version"] == release
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["tool"]["setuptools_scm"]["fallback_version"] == release
    assert package.__version__ == release  # of the last tag, or of the file where no tag is
    assert project["project"]["dynamic"] == ["version"]


def test_workflows_cover_the_allowed_versions() -> None:
    """Python versions and the oldest torch of the workflows are those of pyproject."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    jobs = yaml.safe_load((ROOT / ".github/workflows/test.yml").read_text())["jobs"]
    matrix = jobs["test"]["strategy"]["matrix"]
    low, high = re.findall(r"3\.(\d+)", project["requires-python"])
    assert matrix["python"] == [f"3.{minor}" for minor in range(int(low), int(high))]
    (torch,) = [name for name in project["dependencies"] if name.startswith("torch")]
    oldest = torch.removeprefix("torch>=").partition(",")[0]
    assert f"torch=={oldest}.*" in matrix["torch"]
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [repo["repo"] for repo in hooks] == ["local"]  # nothing is downloaded


# contributed by script in a copy of the checkout

WRITTEN = dict(FILE.findall(TEXT))


def contribute(path: Path, source: str, before: str = "") -> None:
    """Add what a source of a recipe defines to a file, before a line or at its end, and the imports that the file lacks."""
    text = path.read_text()
    has = set(re.findall(r"\w+", text.partition("\n\n\n")[0]))
    imports, _, code = source.rpartition("\n\n\n") if source.count("\n\n\n") == 1 else source.partition("\n\n\n")  # fmt: skip
    nodes = [n for n in ast.parse(imports).body if isinstance(n, ast.Import | ast.ImportFrom)]
    for node in nodes:
        node.names = [alias for alias in node.names if (alias.asname or alias.name) not in has]
    lines = [f"{ast.unparse(node)}\n" for node in nodes if node.names]
    head, mark, rest = text.partition("from __future__ import annotations\n")
    place = rest.index(before) if before else len(rest)
    path.write_text(f"{head}{mark}{''.join(lines)}{rest[:place]}\n\n{code}\n\n{rest[place:]}")


def add_entry(path: Path, table: str, end: str, entry: str) -> None:
    """Add an entry at the end of a table."""
    text = path.read_text()
    place = text.index(end, text.index(table))
    path.write_text(f"{text[:place]}\n    {entry},{text[place:]}")


def add_class(tree: Path, source: str, module: str, yaml_file: str = "") -> None:
    """Add the class of a recipe to a module, its name to the door of the folder, and a file of `conf` that names it there."""
    room, path = module.split("/")[0], tree / "pfbench" / module
    contribute(path, WRITTEN[source]) if path.exists() else path.write_text(WRITTEN[source])
    name = re.findall(r"^class (\w+)", WRITTEN[source], re.M)[-1]
    door = path.parents[module.count("/") - 1] / "__init__.pyi"
    home = f"pfbench.{module.removesuffix('.py').replace('/', '.')}"
    door.write_text(f"{door.read_text()}from {home} import {name} as {name}\n")
    if yaml_file:
        text = re.sub(rf"mylab\.\w+\.{name}", f"pfbench.{room}.{name}", WRITTEN[yaml_file])
        (tree / yaml_file).write_text(text)


def add_metric(tree: Path) -> None:
    path = tree / "pfbench" / "results" / "metrics.py"
    code, _, entry = WRITTEN_METRIC.partition("\n\n\nMEDIAN_ERROR = ")
    contribute(path, f"\n\n\n{code.partition(chr(10) * 3)[2]}", "METRICS: ")
    add_entry(path, "METRICS: ", "\n)", entry.partition("  # fmt")[0])


def add_figure(tree: Path) -> None:
    path = tree / "pfbench" / "report" / "papers" / "figures.py"
    contribute(path, WRITTEN["mylab/final_error.py"], "FIGURES: ")
    (entry,) = re.findall(r"^FINAL_ERROR = (.*?^\))", TEXT, re.M | re.DOTALL)
    add_entry(path, "FIGURES: ", "\n}  # fmt", f'"final-error": {entry}')


def add_world(tree: Path) -> None:
    """Add the scenario of the recipe, and the model that it has."""
    add_class(
        tree, "mylab/open_window.py", "scenario/open_window.py", "conf/scenario/open_window.yaml"
    )
    add_class(tree, "mylab/room.py", "model/room.py", "conf/model/room.yaml")
    (tree / "conf/scenario/room.yaml").write_text(WRITTEN["conf/scenario/room.yaml"])


def add_command(tree: Path) -> None:
    for name in ("pfbench/cli/lost.py", "tests/cli/test_lost.py"):
        (tree / name).write_text(WRITTEN[name])


WRITTEN_METRIC = dict(BLOCK.findall(RECIPES["Add a metric"]))["python"]
CONTRIBUTIONS: dict[str, tuple[Callable[[Path], None], int, str]] = {
    "resampler": (partial(add_class, source="mylab/resampling.py", module="filter/particle/resampling.py"), 2, "filter/particle/test_resampling.py"),
    "filter": (partial(add_class, source="mylab/weights.py", module="filter/particle/weights.py", yaml_file="conf/filter/robust_rpf.yaml"), 3, "test_configs.py"),
    "noise regime": (partial(add_class, source="mylab/noise.py", module="noise/time_windows.py", yaml_file="conf/noise/growing.yaml"), 3, "test_configs.py"),
    "scenario and model": (add_world, 7, "test_configs.py"),
    "metric": (add_metric, 1, "report/test_report_metrics.py"),
    "figure": (add_figure, 1, "report/test_paper_figures.py"),
    "command": (add_command, 2, "cli/test_lost.py"),
}  # fmt: skip


def ask_git(tree: Path, *words: str) -> str:
    command = ["git", "-c", "user.name=x", "-c", "user.email=x@x", *words]
    return subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True).stdout


def copy_checkout(tree: Path) -> None:
    """Copy the files of the checkout that git knows or would know, and commit them."""
    for name in ask_git(ROOT, "ls-files", "-co", "--exclude-standard", "-z").split("\0"):
        if (ROOT / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tree / name)
    ask_git(tree, "init", "-q")
    for words in (("add", "-A"), ("commit", "-qm", "x")):
        ask_git(tree, *words)


@pytest.mark.parametrize("name", CONTRIBUTIONS)
def test_a_contribution_changes_few_files_and_passes_the_checks(name: str, tmp_path: Path) -> None:
    (add, files, check), tree = CONTRIBUTIONS[name], tmp_path / "tree"
    copy_checkout(tree)
    add(tree)
    for words in (("check", "--fix", "-q"), ("format", "-q")):
        subprocess.run([sys.executable, "-m", "ruff", *words, "pfbench"], cwd=tree, check=True)
    changed = ask_git(tree, "status", "--porcelain").splitlines()
    assert len(changed) == files, changed
    paths = [f"tests/{file}" for file in ("test_house.py", "test_public_names.py", "test_language.py", check)]  # fmt: skip
    words = ["-q", "-n", "0", "-x", "-p", "no:cacheprovider", "-k"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *words, "not budget and not ceilings", *paths],
        cwd=tree, env={**os.environ, "PYTHONPATH": str(tree)}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:]
