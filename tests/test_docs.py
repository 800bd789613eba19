"""Every Python block of the documentation runs, page by page, in the order in which it stands."""

import re
from pathlib import Path

import pytest

TOP = Path(__file__).parents[1]
# own_data.md also runs shell commands; its own test executes it whole
PAGES = [TOP / "README.md", *sorted(page for page in (TOP / "docs").glob("*.md") if page.name != "own_data.md")]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    assert blocks, f"{page.name} shows no Python"
    scope = {"__name__": "page"}
    for block in blocks:
        exec(compile(block, str(page), "exec"), scope)


def test_links_between_pages_lead_somewhere():
    for page in (TOP / "README.md", *(TOP / "docs").glob("*.md")):
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
