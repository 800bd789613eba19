"""Every label of every published page is whole: on a screen, a tablet and a telephone."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import page_packs
import pytest
from checkout import ROOT

from pfbench.report import RUNS_FILE, study_report

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install 'pfbench[browser]'"
)
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium"),
]
WIDTHS = (1440, 768, 390)
# pages with the most filters, the most conditions, recorded data, a dose, trained proposals, two papers
PUBLISHED = (
    "all_seven",
    "robust_simulated",
    "robust_car",
    "terrain_rough",
    "learned_passive",
    "paper_002",
    "paper_004",
)
LONG = {
    0: "COFM-AMSSRCPF (printed) [1000]",
    1: "CPSO-Escape (stopped) [IntervalStart]",
    2: "A_name_without_any_blank_that_is_longer_than_its_column",
}
# Labels that are cut: wider than their box, shortened by dots, or outside of their figure.
FIND_CUT = """() => {
  const cut = [];
  const pen = document.createElement("canvas").getContext("2d");
  const texts = "th, td, button, label, summary, dt, dd, h1, h2, h3, p, li, caption, figcaption, .name, .strip";
  for (const part of document.querySelectorAll("main *, header *")) {
    if (!part.checkVisibility() || !part.getClientRects().length) continue;
    const style = getComputedStyle(part);
    if (part instanceof SVGElement) {
      if (part.tagName !== "text" || !part.textContent.trim()) continue;
      const frame = part.ownerSVGElement.getBoundingClientRect(), box = part.getBoundingClientRect();
      const isInside = box.left >= frame.left - 2 && box.right <= frame.right + 2 && box.top >= frame.top - 2 && box.bottom <= frame.bottom + 2;
      if (part.textContent.includes("…") || !isInside) cut.push("svg " + part.closest("[id]").id + " " + part.textContent);
    } else if (part.tagName === "SELECT") {
      pen.font = style.font;
      const width = pen.measureText(part.selectedOptions[0]?.text ?? "").width;
      if (width > part.clientWidth - parseFloat(style.paddingLeft) - parseFloat(style.paddingRight)) cut.push("select " + part.selectedOptions[0].text);
    } else if ((part.matches(texts) || ["hidden", "clip"].includes(style.overflowX)) && part.scrollWidth > part.clientWidth + 1 && part.clientWidth) cut.push("css " + part.tagName + part.className + part.innerText.slice(0, 60));
    else if (!part.children.length && part.textContent.includes("…")) cut.push("html " + part.textContent.slice(0, 60));
  }
  const pageWidth = document.documentElement.scrollWidth;
  if (pageWidth > innerWidth) cut.push("page " + pageWidth);
  const board = document.querySelector("#board");
  if (innerWidth <= 640 && board.scrollWidth > board.parentElement.clientWidth) cut.push("board " + board.scrollWidth + " " + board.parentElement.clientWidth);
  return cut;
}"""
FAULTS = {
    "css": ".board tbody th, .name {white-space: nowrap; max-width: 60px !important; overflow: hidden}",
    "head": "#heads th {max-width: 20px !important; overflow-wrap: normal !important}",
    "select": ".switches select {max-width: 40px !important}",
    "svg": "#time .figure svg text {font-size: 40px !important}",
}


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


def list_cut(browser: Any, file: Path, fault: str = "", width: int = 0) -> dict[int, list[str]]:
    """Open a page with all its parts and list the labels that are cut, by width of the window."""
    page = browser.new_page()
    page.goto(file.as_uri())
    page.wait_for_selector("html[data-ready]", state="attached")
    if fault:
        page.add_style_tag(content=fault)
    page.evaluate("document.querySelectorAll('details').forEach((part) => (part.open = true))")
    found = {}
    for size in [width] if width else WIDTHS:
        page.set_viewport_size({"width": size, "height": 900})
        page.wait_for_timeout(170)  # figures follow a new width after 150 ms
        page.evaluate("refresh(true)")
        found[size] = page.evaluate(FIND_CUT)
    page.close()
    return found


def list_wide(browser: Any, file: Path) -> dict[int, list[str]]:
    """Open a page without a script and list what is wider than the window, by width of the window."""
    page = browser.new_page()
    page.goto(file.as_uri())
    found = {}
    for size in WIDTHS:
        page.set_viewport_size({"width": size, "height": 900})
        found[size] = page.evaluate(
            "[...document.querySelectorAll('body *')].filter(part => part.checkVisibility()"
            " && part.getBoundingClientRect().right > innerWidth + 1).map(part => part.tagName + part.className)"
        )
    page.close()
    return found


@pytest.mark.parametrize("study", PUBLISHED)
def test_labels_of_a_published_page_are_whole(study: str, tmp_path: Path, chromium: Any) -> None:
    folder = tmp_path / study
    folder.mkdir()
    shutil.copy(ROOT / "reports" / study / RUNS_FILE, folder)
    page = study_report.rebuild_page(folder)
    board = folder / "worlds.html"  # of a study with a first page
    file = board if board.exists() else page
    assert list_cut(chromium, file) == {width: [] for width in WIDTHS}
    if board.exists():
        assert list_wide(chromium, page) == {width: [] for width in WIDTHS}


@pytest.fixture(scope="module")
def long_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page whose filters have long names."""
    folder = tmp_path_factory.mktemp("long")
    return page_packs.write(page_packs.build_pack(9, 3, 2, 8, names=LONG), folder)


def test_long_names_are_whole(long_page: Path, chromium: Any) -> None:
    assert list_cut(chromium, long_page) == {width: [] for width in WIDTHS}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_label_that_is_cut_is_found(kind: str, long_page: Path, chromium: Any) -> None:
    assert list_cut(chromium, long_page, FAULTS[kind], 1440)[1440] != []
