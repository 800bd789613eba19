"""The site: pages that are written from the code have all names, tutorials run and are short, every page is in a list."""

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from checkout import ROOT
from notebook_cells import Notebook

import pfbench

ANALYSES = ROOT / "experiments" / "analyses"
sys.path.insert(0, str(ANALYSES))  # scripts, not a package
import build_site  # noqa: E402
import site_pages  # noqa: E402

DOCS = ROOT / "docs"
NOTEBOOKS = [page for page in sorted(DOCS.rglob("*.md")) if "{code-cell}" in page.read_text()]
CELL = re.compile(r"```\{code-cell\} ipython3\n(?::tags:[^\n]*\n)?(.*?)```", re.DOTALL)
TREE = re.compile(r"```\{toctree\}\n(.*?)```", re.DOTALL)


def cells(page: Path) -> list[str]:
    return CELL.findall(page.read_text())


def own_lines(source: str) -> list[str]:
    """Lines that a reader writes: without imports and empty lines."""
    imports = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Import | ast.ImportFrom)]
    left_out = {line for n in imports for line in range(n.lineno, (n.end_lineno or 0) + 1)}
    lines = enumerate(source.splitlines(), 1)
    return [text for number, text in lines if text.strip() and number not in left_out]


@pytest.fixture(scope="module")
def written() -> dict[str, str]:
    return site_pages.write_pages()


# public names


def test_every_public_name_is_documented_and_on_the_page_of_its_folder(
    written: dict[str, str],
) -> None:
    rooms = {"": [n for n in pfbench.__all__ if n not in (*site_pages.list_rooms(), "__version__")]}
    rooms |= {f".{room}": getattr(pfbench, room).__all__ for room in site_pages.list_rooms()}
    assert sum(map(len, rooms.values())) > 480
    missing = []
    for room, names in rooms.items():
        page = written[f"reference/api/{room[1:] or 'pfbench'}.rst"]
        for name in names:
            value = getattr(importlib.import_module(f"pfbench{room}"), name)
            text = vars(value).get("__doc__") if inspect.isclass(value) else inspect.getdoc(value)
            is_plain = not (inspect.isclass(value) or inspect.isfunction(value))
            has_text = is_plain or (text and not text.startswith(f"{name}("))  # of a NamedTuple
            if not has_text or not re.search(rf":: pfbench{room}\.{name}$", page, re.MULTILINE):
                missing.append(f"pfbench{room}.{name}")
    assert missing == []


def test_a_constant_without_a_comment_is_refused() -> None:
    assert site_pages.describe_constant("pfbench.results.plotting", "COLUMN").startswith("inches")
    assert "matplotlib" in site_pages.describe_constant("pfbench.results.plotting", "RC")
    with pytest.raises(ValueError, match=r"plotting\.SMALL must have a comment `#:`"):
        site_pages.describe_constant("pfbench.results.plotting", "SMALL")


# keys and commands


def test_keys_and_commands_are_those_of_the_code(written: dict[str, str]) -> None:
    from omegaconf import OmegaConf

    from pfbench import job
    from pfbench.cli.command import list_commands

    keys = {key: (value, text) for key, value, text in site_pages.read_keys()}
    assert all(text for _, text in keys.values())  # each key says what it is
    values = OmegaConf.load(job.conf_dir() / "config.yaml")
    stated = {key for key in values if key not in ("defaults", "hydra")}
    assert {key.split(".")[0] for key in keys} == stated
    for name, names in job.list_groups().items():
        page = written[f"reference/keys/{name}.md"]
        assert re.findall(r"^## (\S+)$", page, re.MULTILINE) == names
    commands = written["reference/commands.md"]
    assert re.findall(r"^## pfbench (\S+)$", commands, re.MULTILINE) == list(list_commands())


# pages


def test_every_page_is_in_a_list_of_pages(written: dict[str, str]) -> None:
    listed = [
        line
        for block in TREE.findall((DOCS / "index.md").read_text())
        for line in block.splitlines()
        if line and not line.startswith(":")
    ]
    assert len(listed) == len(set(listed))
    pages = {str(build_site.place(page).with_suffix("")) for page in build_site.list_pages()}
    made = {name.rpartition(".")[0] for name in written} | {"benchmarks/index"}
    assert set(listed) <= pages | made
    in_folders = (
        "methods/",
        "reports/",
        "benchmarks/",
        "reference/",
    )  # their first page has a list
    left = {page for page in pages - set(listed) if not page.startswith(in_folders)}
    assert left == {"index"}


def test_links_lead_to_the_places_of_the_site() -> None:
    page = DOCS / "methods" / "README.md"
    text = "[a](../glossary.md#studies) [b](../../reports/README.md) [c](gpf.md) x[0](y) [d](https://a.b)"
    changed, targets = build_site.change_links(page, text)
    assert changed == (
        "[a](../glossary.md#studies) [b](../reports/index.md) [c](gpf.md) x[0](y) [d](https://a.b)"
    )
    assert targets == {DOCS / "glossary.md", ROOT / "reports" / "README.md", page.parent / "gpf.md"}
    changed, _ = build_site.change_links(DOCS / "python.md", "[a](../reports/README.md)")
    assert changed == "[a](reports/index.md)"


# notebooks


def test_notebooks_are_short() -> None:
    assert len([page for page in NOTEBOOKS if page.parent.name == "tutorials"]) == 8
    for page in NOTEBOOKS:
        shown = re.sub(
            r"```\{code-cell\} ipython3\n:tags: \[remove-cell\].*?```",
            "",
            page.read_text(),
            flags=re.S,
        )
        assert 0 < len(own_lines("\n".join(CELL.findall(shown)))) <= 40, page.name
    learned = cells(DOCS / "tutorials" / "train_a_proposal.md")[0]
    assert len(own_lines(learned)) == 10
    for page in (DOCS / "howto").glob("*.md"):
        assert len(page.read_text().splitlines()) <= 60, page.name


REVERSED = {
    "train_a_proposal": (
        ("has not paid", "has paid"), ("not paid at equal", "paid at equal"), ("no learned proposal had a smaller", "each learned proposal had a smaller"),
        ("had a smaller error", "had a larger error"), ("takes at most", "takes at least"), ("In six published", "In 6 of 7 published"),
        ("26 of 30", "4 of 30"), ("already has 0.99", "has less than 0.99"), ("best proposal without", "worst proposal without"),
        ("network does not reach", "network does reach"), ("network does not reach", "network reaches"), ("one of the others:", "one of the best:"),
        ("not yet a smaller", "also a smaller"), ("so more particles:", "so fewer particles:"),
    ),
    "compare_filters": (
        ("give a narrower", "give a wider"), ("give a narrower", "do not give a narrower"), ("filter is worse", "filter is better"),
        ("noise and with outliers:", "noise and not with outliers:"), ("is worse than the UKF", "is equal to the UKF"),
    ),
    "infer_noise": (("above 1.05 they need more", "below 1.05 they need more"),),
}  # fmt: skip


def test_each_comparison_of_a_notebook_is_asserted_and_a_reversed_one_is_refused() -> None:
    assert {page.stem: build_site.list_unchecked(page.read_text()) for page in NOTEBOOKS} == {page.stem: [] for page in NOTEBOOKS}  # fmt: skip
    planted = [(name, pair) for name, pairs in REVERSED.items() for pair in pairs]
    caught = 0
    for name, (old, new) in planted:
        text = (DOCS / "tutorials" / f"{name}.md").read_text()
        assert old in text, old
        caught += len(build_site.list_unchecked(text.replace(old, new, 1))) > 0
    assert caught == len(planted) == 20


@pytest.mark.slow
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_the_cells_of_a_notebook_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    notebook = Notebook(monkeypatch)
    for cell in cells(page):  # whose asserts are what its text says
        notebook.run(cell)


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="pip install 'pfbench[site]'")
    pytest.importorskip("myst_nb", reason="pip install 'pfbench[site]'")
    command = [sys.executable, str(ANALYSES / "build_site.py"), "--to", str(tmp_path)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    site = tmp_path / "site"
    for name in ("index", "tutorials/own_filter", "reference/api/filter", "methods/mcmc_rpf"):
        assert (site / f"{name}.html").is_file()
    index = (site / "searchindex.js").read_text()
    assert "mcmc_rpf" in index
