"""Pages in a real browser, without a window: no errors, every figure loaded, the filter filters, nothing is fetched."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results as synthetic
from PIL import Image

from pfbench import job
from pfbench.claims import page as claims_page
from pfbench.report import page

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        BROWSER is None,
        reason=f"there is none of {', '.join(NAMES)} on the path; apt-get install chromium",
    ),
]
# Whatever the page would fetch is refused and noted; what goes wrong in its script is noted too.
RECORDER = """
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<script>
window.noted = [];
addEventListener("error", (event) => noted.push(event.message || "not loaded: " + (event.target.src || event.target.href)), true);
addEventListener("securitypolicyviolation", (event) => noted.push("fetched: " + event.blockedURI));
for (const kind of ["error", "warn"]) console[kind] = (...words) => noted.push(kind + ": " + words.join(" "));
</script>
"""
FACTS = """
<script>
addEventListener("load", () => {
  const facts = {
    dark: matchMedia("(prefers-color-scheme: dark)").matches,
    paper: getComputedStyle(document.body).backgroundColor,
    images: [...document.images].map((image) => [image.naturalWidth, image.naturalHeight, image.clientWidth]),
    captions: [...document.querySelectorAll("figure")].map((figure) => figure.querySelector("figcaption").textContent.length),
    broad: document.documentElement.scrollWidth - innerWidth,
    resources: performance.getEntriesByType("resource").map((entry) => entry.name).filter((name) => !name.startsWith("data:")),
    anchors: [...document.links].filter((link) => link.getAttribute("href").startsWith("#"))
      .filter((link) => !document.getElementById(link.getAttribute("href").slice(1))).length,
  };
  (%s)(facts);
  facts.noted = noted;
  const said = document.createElement("pre");
  said.id = "facts";
  said.textContent = JSON.stringify(facts);
  document.body.append(said);
});
</script>
"""
STUDY = """(facts) => {
  const rows = () => [...document.querySelectorAll(".sift tbody tr")].filter((row) => !row.hidden).map((row) => row.textContent);
  const put = (part, value) => { part.value = value; part.dispatchEvent(new Event("input")); };
  const box = document.querySelector(".bar input"), [cell, group] = document.querySelectorAll(".bar select");
  facts.all = rows().length;
  put(box, "ukf position");
  facts.words = rows();
  put(box, "");
  put(group, "velocity");
  facts.group = rows();
  facts.said = document.querySelector(".bar output").textContent;
  put(group, "all");
  facts.again = rows().length;
  const head = [...document.querySelectorAll(".sift th")].find((one) => one.textContent.startsWith("RMSE change"));
  head.click();
  facts.sorted = [...document.querySelectorAll(".sift tbody tr")].map((row) => Number(row.cells[head.cellIndex].textContent));
}"""
CLAIMS = """(facts) => {
  const shown = () => [...document.querySelectorAll("tr[data-verdict]")].filter((row) => !row.hidden);
  const find = document.getElementById("find"), which = document.getElementById("which");
  facts.all = shown().length;
  find.value = "002-1";
  find.dispatchEvent(new Event("input"));
  facts.words = shown().map((row) => row.id);
  find.value = "";
  which.value = "reproduced";
  which.dispatchEvent(new Event("change"));
  facts.verdicts = shown().map((row) => row.dataset.verdict);
}"""


def browse(*words: str) -> subprocess.CompletedProcess[str]:
    quiet = (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--hide-scrollbars",
        "--enable-logging=stderr",
        "--v=0",
    )
    alone = (
        "--no-first-run",
        "--disable-background-networking",
        "--disable-extensions",
        "--disable-dev-shm-usage",
    )
    done = subprocess.run(
        [str(BROWSER), *quiet, *alone, *words],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done


def scheme(dark: bool) -> str:
    return f"--blink-settings=preferredColorScheme={0 if dark else 1}"


def facts(made: Path, action: str, dark: bool, width: int = 1280) -> dict[str, Any]:
    """What the page looks like to its own script, after the action."""
    text = made.read_text()
    assert text.count("<head>") == text.count("</body>") == 1
    seen = made.with_name(f"seen_{dark}_{width}.html")
    seen.write_text(
        text.replace("<head>", "<head>" + RECORDER).replace("</body>", FACTS % action + "</body>")
    )
    done = browse(
        "--dump-dom",
        "--virtual-time-budget=10000",
        scheme(dark),
        f"--window-size={width},900",
        seen.as_uri(),
    )
    assert "CONSOLE" not in done.stderr
    said = re.search(r'<pre id="facts">(.*?)</pre>', done.stdout, re.S)
    assert said, done.stdout[-2000:]
    return json.loads(html.unescape(said[1]))


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("browser")
    for noise in ("nominal", "surge"):
        for method in synthetic.METHODS[1:]:
            synthetic.write(root / "results" / "demo", method, noise=noise, runs=12, steps=30)
    options = page.ReportOptions(figure_formats=("png",), groups=("velocity", "position"))
    made = page.write_report("demo", root / "results", root / "reports", options)
    return made.with_name("details.html")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_report_opens_whole_and_its_filter_filters(report: Path, dark: bool) -> None:
    found = facts(report, STUDY, dark, 1280 if dark else 420)
    assert found["noted"] == []
    assert found["resources"] == []
    assert found["dark"] is dark
    assert found["paper"] == ("rgb(17, 22, 27)" if dark else "rgb(255, 255, 255)")
    assert found["anchors"] == 0  # links to a place on the page that is not there
    figures = len(list((report.parent / "figures").glob("*.png")))
    assert len(found["images"]) == len(found["captions"]) == figures > 20
    assert all(size > 100 for image in found["images"] for size in image)
    assert all(length > 20 for length in found["captions"])
    assert found["broad"] <= 0  # the page itself does not scroll sideways, on a phone either
    assert found["all"] == found["again"] == 2 * 2 * 3
    assert len(found["words"]) == 2 * 2
    assert all("ukf" in row and "position" in row for row in found["words"])
    assert len(found["group"]) == 2 * 3
    assert all("velocity" in row for row in found["group"])
    assert found["said"] == "6 of 12 shown"
    assert found["sorted"] == sorted(found["sorted"])


def test_a_brief_report_in_its_usual_formats_opens_whole(tmp_path: Path) -> None:
    """A large study shows figures of one group, each embedded in the smaller of its formats."""
    for noise in ("nominal", "surge", "heavy"):
        for method in synthetic.METHODS:
            synthetic.write(tmp_path / "results" / "demo", method, noise=noise, runs=8, steps=12)
    options = page.ReportOptions(groups=("velocity", "position"), show_all=False)
    made = page.write_report("demo", tmp_path / "results", tmp_path / "reports", options)
    made = made.with_name("details.html")
    text = made.read_text()
    assert re.search(r'src="data:image/(svg\+xml|png);base64,', text)
    found = facts(made, "(facts) => {}", dark=False, width=420)
    assert found["noted"] == found["resources"] == []
    assert found["anchors"] == 0
    names = {path.stem for path in (made.parent / "figures").iterdir()}
    assert {path.suffix for path in (made.parent / "figures").iterdir()} == {".svg", ".png"}
    assert not any(name.endswith("_nis") for name in names)  # what only the full form has
    assert len(found["images"]) == len(found["captions"]) == len(names)
    assert all(
        size > 100 for image in found["images"] for size in image
    )  # an SVG that is not well formed has no size
    assert found["broad"] <= 0


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_picture_of_a_report_is_not_blank(report: Path, dark: bool, tmp_path: Path) -> None:
    file = tmp_path / "page.png"
    browse(
        f"--screenshot={file}",
        "--window-size=1280,2400",
        "--virtual-time-budget=10000",
        scheme(dark),
        report.as_uri(),
    )
    seen = np.asarray(Image.open(file).convert("RGB")).astype(int)
    assert seen.shape == (2400, 1280, 3)
    paper = np.array([17, 22, 27] if dark else [255, 255, 255])
    ink = np.abs(seen - paper).max(-1) > 60
    assert (seen[:5, :5] == paper).all()
    for part in np.split(ink, 6):  # text, tables or figures all the way down
        assert 0.005 < part.mean() < 0.9
    assert (seen.max(-1) - seen.min(-1) > 80).mean() > 0.001  # the filters have colours


def test_the_ledger_opens_and_its_filters_filter(tmp_path: Path) -> None:
    places = tmp_path / "none", tmp_path / "reports", 0.05, job.conf_dir(), job.experiments_dir()
    made = claims_page.write_claims(*places, formats=("png",))
    found = facts(made, CLAIMS, dark=False)
    assert found["noted"] == found["resources"] == []
    assert found["anchors"] == 0
    assert found["all"] == 71
    assert found["words"] == [f"002-{k}" for k in range(10, 20)]
    assert found["verdicts"] == ["reproduced"] * 2  # what tests of the package show; nothing ran
