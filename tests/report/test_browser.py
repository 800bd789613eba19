"""The ledger in a real browser, without a window: no errors, the filters filter, nothing is fetched."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pfbench.claims import page as claims_page

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
CLAIMS = """(facts) => {
  facts.squares = document.querySelectorAll(".board a.square").length;
  const block = document.getElementById("003-C10");
  facts.folded = [...document.querySelectorAll("details")].filter((one) => one.open).length;
  location.hash = "#003-C10";
  dispatchEvent(new HashChangeEvent("hashchange"));
  facts.unfolded = block.open && block.parentElement.open;
  facts.wide = document.documentElement.scrollWidth > innerWidth;
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


@pytest.mark.parametrize("width", [390, 1440])
def test_the_page_of_claims_is_a_picture_whose_squares_unfold(tmp_path: Path, width: int) -> None:
    made = claims_page.write_claims(tmp_path / "none", tmp_path / "reports")
    found = facts(made, CLAIMS, dark=width == 390, width=width)
    assert found["noted"] == found["resources"] == []
    assert found["anchors"] == 0
    assert found["squares"] == 88
    assert found["folded"] == 0
    assert found["unfolded"]
    assert not found["wide"]
