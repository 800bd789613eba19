"""The script of the page runs no text of another person, whatever is clicked."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import page_packs
import pytest
from hostile_report import write_hostile_report

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install 'pfbench[browser]'"
)
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium"),
]
EVIL = "\"'><img src=x onerror=window.evil=1></text></svg><svg onload=window.evil=1>"
CONTROLS = ("button", "summary", "[data-dot]", "[data-tip]", "[data-sort]")
# texts that are shown; all others name a filter, a world or a form
SHOWN = (
    "bibtex", "caption", "commit", "direction", "group", "long", "name", "note", "provenance", "question",
    "reason_missing", "replay", "scenarios", "sentence", "small_print", "study", "title", "unit", "value_unit", "version", "words",
)  # fmt: skip


def disguise(node: Any, key: str = "") -> Any:
    """Append the hostile text to all texts of a pack that are shown."""
    if isinstance(node, dict):
        return {name: disguise(value, name) for name, value in node.items()}
    if isinstance(node, (list, tuple)):
        return [disguise(value, key) for value in node]
    return node + EVIL if isinstance(node, str) and key in SHOWN else node


def count_runs(folder: Path, script: tuple[str, str] = ("", "")) -> tuple[int, int]:
    """Open a page, use its controls, and return the pictures it made and the scripts it ran."""
    page_file = folder / "index.html"
    if script[0]:
        text = page_file.read_text()
        assert script[0] in text
        page_file.write_text(text.replace(*script))
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(f"file://{page_file}")
        page.wait_for_selector("html[data-ready]", state="attached", timeout=5000)
        for control in CONTROLS:
            page.evaluate(
                "s => [...document.querySelectorAll(s)].slice(0, 30).forEach((e) => {"
                "for (const kind of ['mousemove', 'pointermove', 'focusin', 'click'])"
                "e.dispatchEvent(new MouseEvent(kind, {bubbles: true}));})",
                control,
            )
        for select in page.query_selector_all("select"):
            for value in select.evaluate("s => [...s.options].map((o) => o.value)"):
                select.select_option(value)
        made = page.evaluate("document.querySelectorAll('img').length")
        page.wait_for_timeout(200)
        ran = page.evaluate("window.evil || 0")
        browser.close()
    return made, ran


def test_no_text_of_a_pack_is_run(tmp_path: Path) -> None:
    pack = disguise(page_packs.build_pack(6, 2, 2, 12, carried=4))
    page_packs.write(pack, tmp_path)
    text = (tmp_path / "index.html").read_text()
    (data,) = re.findall(r'id="data">([^<]*)<', text)
    assert (text + json.dumps(page_packs.unpack(data))).count("onerror") > 200
    assert count_runs(tmp_path) == (0, 0)
    made, _ = count_runs(tmp_path, ("escapes[sign])", "sign)"))  # without the escape
    assert made > 0


def test_no_text_of_a_study_is_run(tmp_path: Path) -> None:
    assert count_runs(write_hostile_report(tmp_path)) == (0, 0)
