"""The page of a study in a real browser: nothing is fetched, nothing fails, every control does what it says."""

import os
import re
import shutil
from functools import cache, partial
from pathlib import Path

import numpy as np
import page_packs
import pytest

from pfbench.report.writers import format_short

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install 'pfbench[browser]'"
)
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
AXE = Path(__file__).parents[2] / ".cache/axe/node_modules/axe-core/axe.min.js"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="no Chromium: apt-get install chromium"),
]
HOSTILE = {0: "</script><script>alert(1)</script>", 1: 'A "long" & <b>bold</b> name of a filter'}
PACKS = {
    "usual": partial(page_packs.build_pack, 12, 2, 2, 20, carried=4),
    "gaps": partial(page_packs.build_pack, 8, 3, 2, 12, lost=(2,), missing=[(3, 0, 0), (4, 1, 0), *((5, w, r) for w in range(3) for r in range(2))], names=HOSTILE, plane=False),
    "few": partial(page_packs.build_pack, 4, 2, 2, 12, carried=0),
    "single": partial(page_packs.build_pack, 1, 1, 1, 1),
    "lost": partial(page_packs.build_pack, 4, 2, 1, 6, lost=range(4)),
    "equal": partial(page_packs.build_pack, 5, 2, 2, 8, equal=True),
    "budget": partial(page_packs.build_pack, 8, 1, 1, 8, names=dict.fromkeys(range(8), "DMC-PF (printed) [1000]")),
    "many": partial(page_packs.build_pack, 33, 7, 4, 4, carried=0, instants=10, numbered=True),
}  # fmt: skip
FITTING = ["f1", "f4", "f6"]  # filters at equal time


@cache
def pack_of(name):
    pack = PACKS[name]()
    if name == "budget":
        pack["budgets"][1] |= {"reason_missing": None, "filters": FITTING, "words": "up to 2 ms"}
        for view in pack["views"].values():  # times of rounds make the widest board
            for row in view["rows"]:
                row |= {"ms_low": 10.8 * row["ms"], "ms_high": 11.2 * row["ms"]}
                row["ms"] *= 11.0
    return pack


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(
            executable_path=BROWSER, args=["--no-sandbox", "--disable-gpu"]
        )
        yield browser
        browser.close()


@pytest.fixture
def visit(chromium, folder):
    contexts, faults = [], []

    def open_page(name="usual", width=1440, height=900, address="", script=True, **settings):
        if not (folder / name).exists():
            page_packs.write(pack_of(name), folder / name)
        context = chromium.new_context(
            viewport={"width": width, "height": height}, java_script_enabled=script, **settings
        )
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: faults.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: faults.append(f"error: {error}"))
        page.on("request", lambda request: note_request(request.url))
        page.goto(f"file://{folder / name}/index.html{address}")
        if script:
            page.wait_for_selector("html[data-ready]", state="attached")
        return page

    def note_request(url):
        if not url.startswith(("file://", "data:")):
            faults.append(f"request: {url}")

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


def board(page):
    """Return the texts of the leaderboard as rows of cells."""
    return page.evaluate(
        "() => [...document.querySelectorAll('#rows > tr')].map((row) => [...row.cells].map((cell) => cell.textContent.trim()))"
    )


@pytest.mark.parametrize("name", PACKS)
def test_every_page_is_whole_and_never_wider_than_the_window(visit, name):
    page = visit(name)
    for width in (1440, 768, 390):
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_timeout(170)  # figures follow a new width after 150 ms
        page.evaluate("refresh(true)")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    drawn = page.evaluate("figures.filter((figure) => !figure.part.innerHTML).length")
    assert drawn == 0
    assert "NaN" not in page.evaluate("document.querySelector('main').innerHTML")
    anchors = page.evaluate(
        "[...document.links].map((a) => a.getAttribute('href')).filter((h) => h.startsWith('#') && !document.getElementById(h.slice(1)))"
    )
    assert anchors == []


def test_the_first_screen_has_the_answer(visit):
    page = visit("usual", 390, 844)
    rows = page.evaluate(
        "[...document.querySelectorAll('#rows > tr')].filter((row) => row.getBoundingClientRect().bottom <= innerHeight).length"
    )
    assert rows >= 11
    shown = page.evaluate(
        "[...document.querySelector('#rows > tr').cells].filter((cell) => cell.offsetWidth).length"
    )
    assert shown == 5
    page.set_viewport_size({"width": 1440, "height": 900})
    page.wait_for_timeout(170)
    for part in ("#answer", "#metric", "#rows > tr:nth-child(12)", "#cost svg"):
        box = page.locator(part).bounding_box()
        assert box["y"] + box["height"] <= 900, part


EVERY_VIEW = """() => viewKeys.map((key) => {
  const wish = key;
  for (const id of ["metric", "world", "baseline"]) {
    const select = document.getElementById(id);
    if (select.value === wish[axes.indexOf(id)]) continue;
    select.value = wish[axes.indexOf(id)];
    select.dispatchEvent(new Event("change", { bubbles: true }));
  }
  [...document.querySelectorAll("[data-regime]")].find((button) => button.dataset.regime === wish[2] && button.ariaPressed === "false")?.click();
  const rows = [...document.querySelectorAll("#rows > tr")].map((row) => [row.dataset.filter, ...[...row.cells].map((cell) => cell.textContent.trim())]);
  return [key, location.hash, document.querySelector("#answer").textContent, rows];
})"""


def test_the_table_has_the_numbers_of_every_view(visit):
    pack = pack_of("few")
    shown = visit("few").evaluate(EVERY_VIEW)
    assert [tuple(key) for key, *_ in shown] == list(pack["views"])
    for key, address, sentence, rows in shown:
        view = pack["views"][tuple(key)]
        metric, world, regime, baseline = key
        assert address == f"#metric={metric}&world={world}&regime={regime}&baseline={baseline}"
        assert sentence == view["sentence"].replace("[[", "").replace("]]", "")
        assert [row[0] for row in rows] == [row["filter"] for row in view["rows"]]
        for cells, row in zip(rows, view["rows"], strict=True):
            ratio = [float(text) for text in re.findall(r"[\d.e-]+", cells[4])]
            expected = [row["ratio"], row["ratio_low"], row["ratio_high"]]
            np.testing.assert_allclose(ratio, expected, rtol=5e-3)
            assert cells[6].endswith(row["words"])
            assert (row["calibration"] or "") in cells[8]
            assert float(cells[7].rstrip(" %")) == pytest.approx(100 * row["track"], abs=0.51)
            assert float(cells[9]) == pytest.approx(row["ms"], rel=5e-3)
            if row["value"] is not None:
                assert float(cells[3].split()[0]) == pytest.approx(row["value"], rel=5e-3)


def test_numbers_of_script_and_writer_agree(visit):
    rng = np.random.default_rng(3)
    values = [float(f"{v:.4g}") for v in np.exp(rng.uniform(-12, 16, 4000))] + [1.125, 0.5, 9995.0]
    texts = visit("single").evaluate("(values) => values.map((v) => short(v))", values)
    assert texts == [format_short(v) for v in values]


@pytest.mark.parametrize(("low", "high"), [(0.94, 1.11), (3.05, 4.2), (0.1, 30), (1e-4, 2e5)])
def test_axes_have_round_numbers(visit, low, high):
    texts = visit("single").evaluate(f"logTicks({low}, {high}, 7).map(tidy)")
    assert 2 <= len(texts) <= 8
    assert all(low <= float(text) <= high and len(text) <= 6 for text in texts)


@pytest.mark.parametrize("name", ["usual", "gaps", "lost"])
def test_the_page_is_complete_without_script(visit, name):
    page = visit(name, script=False)
    static = board(page)
    scripted = board(visit(name))
    assert len(static) == len(pack_of(name)["filters"])
    for plain, full in zip(static, scripted, strict=True):
        kept = [full[k] for k in (0, 1, 3, 5, 6, 7, 8)]
        assert [plain[k] for k in (0, 1, 3, 4, 5, 6, 7)] == [text.strip() for text in kept]
    assert page.locator("#answer").is_visible()
    assert not page.locator(".switches").is_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.locator("html").bounding_box()["width"] <= 390


def test_heads_sort(visit):
    page = visit("gaps")
    button = page.locator("[data-sort=ms]")
    orders = []
    for direction in ("ascending", "descending"):
        button.press("Enter")
        assert page.locator("th[aria-sort]").get_attribute("aria-sort") == direction
        orders.append([float(row[8]) for row in board(page) if row[8] != "–"])
    assert orders[0] == sorted(orders[0])
    assert orders[1] == orders[0][::-1]
    page.locator("[data-sort=ratio]").click()
    ratios = [row[3] for row in board(page)]
    assert ratios[-2:] == ["–", "–"]  # filters without an error stay last
    page.locator("[data-sort=ratio]").click()
    assert [row[3] for row in board(page)][-2:] == ["–", "–"]


def test_a_name_opens_all_numbers(visit):
    page = visit()
    page.locator("[data-row]").nth(2).press("Enter")
    assert page.locator(".all dd").count() > 10
    assert page.locator("[aria-expanded=true]").count() == 1
    page.locator("[data-row]").nth(2).click()
    assert page.locator(".all").count() == 0


def test_filters_are_toggled(visit):
    page = visit()
    page.locator("#time").scroll_into_view_if_needed()
    lines = page.locator("#time > .figure path[stroke-dasharray], #time > .figure path[tabindex]")
    before = lines.count()
    page.locator("[data-toggle][aria-pressed=false]").first.click()
    assert lines.count() > before
    page.locator("[data-toggle='*none']").click()
    assert "Select a filter" in page.locator("#time > .figure").inner_text()
    page.locator("[data-toggle='*all']").click()
    assert page.locator("#time > .figure path[tabindex]").count() == 12


def test_runs_are_selected_by_keys_and_clicks(visit):
    page = visit()
    page.locator("#runs").scroll_into_view_if_needed()
    dot = page.locator("#dot")
    dot.focus()
    names = [dot.get_attribute("aria-label")]
    for key in ("ArrowRight", "ArrowDown", "ArrowLeft", "ArrowUp"):
        page.keyboard.press(key)
        names.append(page.evaluate("document.activeElement.getAttribute('aria-label')"))
    assert len(set(names[:4])) == 4
    assert page.locator("#tip").is_visible()
    page.locator("[data-dot='3 1']").dispatch_event("click")
    words = page.locator("#runwords").inner_text()
    assert "Run 1 of World 0, Nominal" in words
    key = page.evaluate("state.filter")
    assert f"pfbench replay study=invented scenario=w0 noise=r0 filter={key} run=1" in words
    assert page.locator("#plane svg").count() == 1
    assert page.locator("#runtimes svg").count() >= 1
    page.locator("[data-dot='3 15']").dispatch_event("click")
    assert "No track of this run" in page.locator("#planenote").inner_text()


@pytest.mark.parametrize(("name", "key"), [("usual", "f2"), ("many", "7")])
def test_curves_and_runs_of_the_page_are_those_of_the_pack(visit, name, key):
    """Labels that are numbers have another order in a browser than in the pack."""
    pack = pack_of(name)
    curve, run = visit(name).evaluate(
        "(key) => [data.curves.w1.r0.filters[key], data.runs.w1.r0.values[key]]",
        key,
    )
    assert curve == pack["curves"]["w1", "r0"]["filters"][key]
    assert run == pack["runs"]["w1", "r0"]["values"][key]


def test_tracks_of_the_page_are_those_of_the_pack(visit):
    found = visit().evaluate("() => data.tracks.w1.r0.plane.f2['1']")
    truth = np.ravel(pack_of("usual")["tracks"]["w1", "r0"]["plane"]["f2"]["1"])
    np.testing.assert_allclose(found, truth, rtol=6e-3)


@pytest.mark.parametrize("name", ["gaps", "many"])
def test_rows_of_the_page_are_those_of_the_pack(visit, name):
    pack = pack_of(name)
    rows = visit(name).evaluate("() => viewKeys.map((key) => viewOf(key).rows)")
    for found, view in zip(rows, pack["views"].values(), strict=True):
        assert found == view["rows"]


def test_the_address_holds_the_view(visit):
    address = "#metric=crps&world=w1&regime=r1&baseline=f1&sort=-ms"
    page = visit(address=address)
    assert page.evaluate("location.hash") == address
    rows = board(page)
    assert [row[8] for row in rows] == sorted((row[8] for row in rows), key=float, reverse=True)
    assert page.locator("#caption").inner_text() == "CRPS; World 1; Outliers; ratio to Filter 1."
    strange = visit(address="#metric=none&world=<img>&sort=__proto__")
    shown = strange.evaluate("axes.map((axis) => state[axis])")
    assert tuple(shown) == next(iter(pack_of("usual")["views"]))


def test_equal_time_shows_its_filters_alone(visit):
    page = visit("budget")
    shown = "[...document.querySelectorAll('#rows > tr')].map((row) => row.dataset.filter)"
    assert len(page.evaluate(shown)) == 8
    page.click("[data-budget=time]")
    assert sorted(page.evaluate(shown)) == FITTING
    assert "budget=time" in page.evaluate("location.hash")
    address = page.evaluate("location.hash")
    assert sorted(visit("budget", address=address).evaluate(shown)) == FITTING
    page.click("[data-budget=particles]")
    assert len(page.evaluate(shown)) == 8
    assert "budget" not in page.evaluate("location.hash")


def test_the_front_has_all_that_no_other_beats(visit):
    rng = np.random.default_rng(2)
    rows = [{"ms": m, "ratio": r} for m, r in rng.uniform(0, 1, (40, 2)).tolist()]
    front = [
        row
        for row in sorted(rows, key=lambda row: row["ms"])
        if not any(o["ms"] < row["ms"] and o["ratio"] < row["ratio"] for o in rows)
    ]
    assert visit("single").evaluate("(rows) => frontOf(rows)", rows) == front


def test_dark_colours_follow_the_system_and_the_button(visit):
    colour = "getComputedStyle(document.body).backgroundColor"
    light, dark = visit(), visit(color_scheme="dark")
    paper = light.evaluate(colour)
    assert paper == "rgb(255, 255, 255)" != dark.evaluate(colour)
    mark = "getComputedStyle(document.querySelector('#rows .c0')).stroke"
    assert light.evaluate(mark) != dark.evaluate(mark)
    light.locator("#theme").click()
    dark.locator("#theme").click()
    assert light.evaluate(colour) != paper == dark.evaluate(colour)


def test_the_print_has_every_figure_and_no_switch(visit):
    page = visit()
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert not page.locator(".switches").is_visible()
    assert page.evaluate("[...document.querySelectorAll('details')].every((part) => part.open)")
    assert page.evaluate("figures.every((figure) => figure.part.innerHTML)")
    assert page.pdf().startswith(b"%PDF")


def test_nothing_moves_where_the_system_asks_for_rest(visit):
    page = visit(reduced_motion="reduce")
    moving = "[...document.querySelectorAll('*')].filter((part) => getComputedStyle(part).transitionDuration !== '0s').length"
    assert page.evaluate(moving) == 0


@pytest.mark.skipif(
    not AXE.exists(), reason="no axe-core: npm install --prefix .cache/axe axe-core"
)
def test_axe_has_no_serious_finding(visit):
    page = visit(bypass_csp=True, reduced_motion="reduce")  # colours of a transition are not final
    page.evaluate("refresh(true)")
    page.locator("[data-row]").first.click()
    page.add_script_tag(path=os.fspath(AXE))
    run = """(rules) => axe.run(document, { resultTypes: ["violations"], ...rules }).then((result) =>
        result.violations.filter((v) => ["serious", "critical"].includes(v.impact))
        .map((v) => [v.id, v.nodes.slice(0, 3).map((n) => n.html.slice(0, 200))]))"""
    assert page.evaluate(run, {}) == []
    page.locator("#theme").click()
    assert page.evaluate(run, {"runOnly": ["color-contrast"]}) == []


def test_pairs_in_advance_are_drawn_by_kind_and_legends_name_only_what_is_drawn(folder, chromium):
    planned = pack_of("usual")["planned"]
    page_packs.write(pack_of("usual"), folder / "usual")
    for has_script in (True, False):
        page = chromium.new_context(java_script_enabled=has_script).new_page()
        page.goto((folder / "usual" / "index.html").as_uri())
        part = page.locator("#planned")
        part.scroll_into_view_if_needed()
        text = page.locator("main").inner_text()
        assert ("Thick: these worlds" in text) == has_script
        assert ("filled marks" in text) == has_script
        rows = part.locator("tbody tr").all_text_contents()
        for row, pair in zip(rows, planned, strict=True):
            assert pair["word"] in row
        if has_script:
            part.locator("svg g[role=img]").first.wait_for()  # drawn when it is in view
            labels = part.locator("svg g[role=img]").evaluate_all(
                "(all) => all.map((g) => g.getAttribute('aria-label'))"
            )
            kinds = [
                label.split(".")[0] for label in labels if "against Filter" in label.split(".")[1]
            ]
            assert kinds == sorted(kinds, key=["Against the baselines of the paper", "Against tuned baselines", "Pairs"].index)  # fmt: skip
            assert len(kinds) == len(planned)
            assert "null" not in " ".join(labels)
        page.context.close()


def test_a_page_made_without_results_says_that_the_command_needs_them(tmp_path, chromium):
    pack = page_packs.build_pack(3, 1, 1, 4, carried=0)
    texts = []
    for name, more in (("with", {}), ("without", {"replay_first": "pfbench run -m +experiment=x"})):
        page_packs.write({**pack, **more}, tmp_path / name)
        page = chromium.new_context().new_page()
        page.goto((tmp_path / name / "index.html").as_uri())
        page.locator("#runs").scroll_into_view_if_needed()
        page.wait_for_selector("#runwords code")
        texts.append(page.locator("#runwords code").all_inner_texts())
        page.context.close()
    assert [text.split()[1] for text in texts[0]] == ["replay"]
    assert texts[1] == [*texts[0], "pfbench run -m +experiment=x"]


LONG = {0: "COFM-AMSSRCPF", 1: "COFM-AMSSRCPF (printed)", 2: "Scaled EKF (tuned)"}


def test_long_names_are_whole_on_a_telephone_and_labels_stay_in_the_window(tmp_path, chromium):
    page_packs.write(page_packs.build_pack(9, 2, 2, 8, names=LONG), tmp_path)
    page = chromium.new_context(viewport={"width": 390, "height": 844}).new_page()
    page.goto((tmp_path / "index.html").as_uri())
    page.wait_for_selector("#cost svg text")
    cut = "nodes => nodes.filter(node => node.scrollWidth > node.clientWidth + 1).map(node => node.innerText)"
    assert page.eval_on_selector_all("#rows .name, #rows th", cut) == []
    names = page.locator("#rows .name").all_inner_texts()
    assert {" ".join(name.split()) for name in names} >= set(LONG.values())
    heads = " ".join(" ".join(page.locator("#heads").inner_text().split()).split())
    assert "…" not in heads
    right = "nodes => Math.max(...nodes.map(node => node.getBoundingClientRect().right))"
    assert page.eval_on_selector_all("#cost svg text", right) <= 390
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.context.close()
