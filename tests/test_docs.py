"""Every Python block of the documentation runs, page by page, in order. Every link has a target."""

import re

import pytest
from checkout import ROOT, list_published

# use_your_data.md and write_a_scenario.md also run shell commands: their own tests run all blocks
# glossary.md, index.md, release.md, results.md and data_sets.md have no Python; tests/test_site.py runs notebooks; tests/door/test_python_page.py runs README.md and python.md as scripts
ALL_PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
METHODS = (
    page
    for page in sorted((ROOT / "docs" / "methods").glob("*.md"))
    if "```python" in page.read_text()
)
NOT_RUN = {
    "README.md",
    "glossary.md",
    "index.md",
    "release.md",
    "results.md",
    "data_sets.md",
    "use_your_data.md",
    "python.md",
}
PAGES = [*(page for page in ALL_PAGES if page.name not in NOT_RUN), *METHODS]
LINKING_PAGES = (
    ROOT / "README.md",
    ROOT / "reports" / "README.md",
    *(folder / "report.md" for folder in list_published()),
    *(page for name in ("docs", "benchmarks") for page in (ROOT / name).rglob("*.md")),
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    assert blocks, f"{page.name} shows no Python"
    scope = {"__name__": "page"}
    for block in blocks:
        exec(compile(block, str(page), "exec"), scope)


def heading_anchors(page):
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", ["trust.md", "reliability.md"])
def test_each_test_that_a_page_names_exists(name):
    text = (ROOT / "docs" / name).read_text().partition("\n## Tests\n")[2]
    named = re.findall(r"`([\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) > 10
    assert [
        n for n in named if f"def {n[1] or 'test_'}" not in (ROOT / "tests" / n[0]).read_text()
    ] == []


def test_links_and_images_exist():
    for page in LINKING_PAGES:
        for target, anchor in re.findall(r"\]\((?!http)([^)#\s]*)#?([^)]*)\)", page.read_text()):
            path = page.parent / target if target else page
            assert path.exists(), f"{page.name} links to {target}"
            if anchor and path.suffix == ".md":
                assert anchor in heading_anchors(path), f"{page.name} links to {target}#{anchor}"


def test_pages_show_every_picture_and_stand_alone_in_docs():
    files = [f for name in ("docs", "benchmarks") for f in (ROOT / name).rglob("*.*")]
    others = [f for f in files if f.is_relative_to(ROOT / "docs") and f.name != "conf.py"]
    assert {f.suffix for f in others} == {
        ".md",
        ".png",
        ".svg",
    }  # conf.py has the settings of the site
    pages = " ".join(page.read_text() for page in LINKING_PAGES)
    pictures = [f for f in files if f.suffix in (".png", ".svg")]
    assert [
        f.name for f in pictures if not re.search(rf"\]\((docs/)?{re.escape(f.name)}\)", pages)
    ] == []
