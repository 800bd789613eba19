"""The recipes of CONTRIBUTING.md are followed: files are written, blocks executed and commands run."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from checkout import ROOT
from command_line import pfbench

import pfbench as package
from pfbench.core.lazy_import import lazy_attributes
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


@pytest.mark.parametrize("title", [title for title, body in RECIPES.items() if "_target_" in body])
def test_the_named_door_makes_the_class_of_a_recipe_public(
    title: str, folder: Path, tmp_path: Path
) -> None:
    """One line in the stub that the last sentence names, and the short `_target_` finds the class."""
    body = RECIPES[title]
    (door,) = re.findall(r"`(pfbench/\w+/__init__\.\w+)`", body.partition("To contribute it")[2])
    home, name = re.findall(r"_target_: (mylab\.\w+)\.(\w+)", body)[0]
    stub = (ROOT / door).read_text() + f"from {home} import {name} as {name}\n"
    (tmp_path / Path(door).name).write_text(stub)
    package_name = str(Path(door).parent).replace("/", ".")
    get, _, names = lazy_attributes(package_name, str(tmp_path / "__init__.py"))
    assert get(name).__module__ == home
    assert names == sorted({*import_module(package_name).__all__, name})


def test_every_kind_of_part_has_a_recipe() -> None:
    kinds = "resampling scheme, filter, model, scenario, noise regime, metric, report figure"
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
