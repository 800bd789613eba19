"""The page of a study without a browser: its data, its escapes, its size and its text."""

import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import page_packs
import pytest
from omegaconf import OmegaConf

from pfbench import job
from pfbench.job.settings import DEFAULTS_NOT_IN_KEY
from pfbench.report.study_page.page_writer import (
    compress_pack,
    encode_pack,
    offer_budgets,
    render_page,
    select_equal_time,
)
from pfbench.report.writers import format_short
from pfbench.results import store
from pfbench.results.store import compute_config_key

WORDS = ("better", "equal", "identical", "not decided", "worse", "loses track", "missing")


def unpack_page(page):
    return page_packs.unpack(re.search(r'id="data">([^<]*)<', page).group(1))


def test_data_of_a_page_are_plain_json_with_all_views():
    """The standard library alone reads them."""
    pack = page_packs.build_pack(5, 2, 2, 8, missing=[(4, 0, 0)])
    data = unpack_page(render_page(pack)["index.html"])
    views = data["views"]
    assert [tuple(key) for key in views["keys"]] == list(pack["views"])
    for rows, text, view in zip(views["rows"], views["texts"], pack["views"].values(), strict=True):
        assert [dict(zip(views["columns"], row, strict=True)) for row in rows] == view["rows"]
        assert text == {key: value for key, value in view.items() if key != "rows"}
    for (world, regime), curves in pack["curves"].items():
        assert data["curves"][world][regime] == curves
    assert tuple(data["opening"]) == next(iter(pack["views"]))
    assert not {"methods", "provenance", "downloads", "facts"} & set(
        data
    )  # the page has them as text


def test_a_number_that_json_does_not_have_is_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        compress_pack({"a": np.nan})


def test_a_page_carries_fewer_tracks_rather_than_too_many_bytes():
    pack = page_packs.build_pack(6, 2, 2, 12)
    whole = len(encode_pack(pack, 10**8))
    text = encode_pack(pack, whole // 2)
    tracks = page_packs.unpack(text)["tracks"]
    assert len(text) <= whole // 2
    for part in (part for regimes in tracks.values() for part in regimes.values()):
        assert 1 <= len(part["numbers"]) < 10
        assert all(len(runs) == len(part["numbers"]) for runs in part["error"].values())


@pytest.mark.slow
def test_the_largest_page_stays_under_its_size(tmp_path):
    path = page_packs.write(page_packs.build_pack(33, 7, 4, 100), tmp_path)
    assert path.stat().st_size < 1_500_000
    assert unpack_page(path.read_text())["tracks"]
    pack = page_packs.build_pack(33, 7, 4, 100, carried=0, instants=24)  # without single runs
    assert page_packs.write(pack, tmp_path / "bare").stat().st_size < 1_000_000


class Elements(HTMLParser):
    """Counts elements and collects the text of the leaderboard."""

    def __init__(self):
        super().__init__()
        self.counts, self.texts, self.inside = {}, [], False

    def handle_starttag(self, tag, attrs):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.inside = self.inside or dict(attrs).get("id") == "rows"

    def handle_endtag(self, tag):
        self.inside = self.inside and tag != "tbody"

    def handle_data(self, data):
        if self.inside and data.strip():
            self.texts.append(data.strip())


def test_names_stay_text(tmp_path):
    hostile = {0: "</script><script>alert(1)</script>", 1: '"><img src=x>', 2: "[[a]] & <b>"}
    pack = page_packs.build_pack(4, 1, 1, 5, names=hostile)
    pack["views"][next(iter(pack["views"]))]["sentence"] = f"[[{hostile[0]}]] is first."
    elements = Elements()
    elements.feed(page_packs.write(pack, tmp_path).read_text())
    assert elements.counts["script"] == 2
    assert "img" not in elements.counts
    assert set(hostile.values()) <= set(elements.texts)
    markdown = (tmp_path / "report.md").read_text()
    assert "<script>" not in markdown.replace("\\<", "")


def test_first_lines_name_severely_overconfident_runs(tmp_path):
    """Largest share first, at most four filters by name."""
    pack = page_packs.build_pack(7)
    page_packs.write(pack, tmp_path / "none")
    assert "Severely overconfident runs" not in (tmp_path / "none" / "report.md").read_text()
    for note, count in zip(pack["filter_notes"], (2, 20, 0, 5, 9, 1, 3), strict=True):
        note["severely_overconfident"] = count
    pack["filter_notes"][5]["runs"] = 1
    page = page_packs.write(pack, tmp_path / "some").read_text()
    sentence = (
        "Severely overconfident runs: Filter 1 20 of 20, Filter 5 1 of 1, Filter 4 9 of 20, "
        "Filter 3 5 of 20 and 2 other filters."
    )
    assert sentence in page
    lines = (tmp_path / "some" / "report.md").read_text().splitlines()
    assert sentence in lines[:8]


def test_a_page_tells_exact_filters_from_bounded_weights(tmp_path):
    """A dash for what an older result does not state; no times where they hold the first steps of a process."""
    pack, parts = page_packs.build_pack(6), ('id="cost"', ">ms/step<", "<code>pfbench cost study=")
    assert [part in page_packs.write(pack, tmp_path).read_text() for part in parts] == [True, True, False]  # fmt: skip
    del pack["filter_notes"][4]["has_bounded_weights"]
    page = page_packs.write({**pack, "views": {
        key: {**view, "rows": [{**row, "ms": None} for row in view["rows"]]} for key, view in pack["views"].items()
    }}, tmp_path).read_text()  # fmt: skip
    assert [part in page for part in parts] == [False, False, True]
    rows = re.findall(r"<td>(yes|no)</td><td>(yes|no|–)</td>", page)
    bounded = ["yes", "no", "–", "yes", "–", "–"]
    assert rows == list(zip(["yes", "no"] * 3, bounded, strict=True))


def test_a_page_says_in_words_why_a_budget_is_missing(tmp_path):
    elements = page_packs.write(page_packs.build_pack(), tmp_path).read_text()
    assert "Same time: This study has no runs of that budget.</p>" in elements


def test_equal_packs_give_equal_bytes(tmp_path):
    pages = [
        page_packs.write(page_packs.build_pack(), tmp_path / name).read_bytes() for name in "ab"
    ]
    assert pages[0] == pages[1]


@pytest.mark.parametrize("colour", ["red", "#12345", "#123456;}body{display:none"])
def test_a_colour_must_be_a_colour(tmp_path, colour):
    pack = page_packs.build_pack()
    pack["filters"][0]["dark"] = colour
    with pytest.raises(ValueError, match=r"colour of f0 must have the form #rrggbb"):
        page_packs.write(pack, tmp_path)


def test_every_verdict_has_a_sign_and_a_class():
    """Of all words that a row can have, each is shown with its own sign, except the two forms of equality."""
    pack = page_packs.build_pack(7, 1, 1, 20)
    rows = next(iter(pack["views"].values()))["rows"]
    for row, word in zip(rows, WORDS, strict=True):
        row.update(verdict=word, words=word)
    page = render_page(pack)["index.html"]
    cells = re.findall(r'<td class="verdict (\w+)">(\W*)([a-z ]+)</td><td class="number">', page)
    assert [word for *_, word in cells] == list(WORDS)
    assert [name for name, *_ in cells] == [word.replace(" ", "_") for word in WORDS]
    signs = {sign.strip() for _, sign, word in cells if word != "identical"}
    assert len(signs) == len(WORDS) - 1
    assert {word for *_, word in cells if f".{word.replace(' ', '_')}" not in page} == set()


def test_sections_without_data_are_absent(tmp_path):
    pack = page_packs.build_pack(3, 1, 1, 4, carried=0)
    pack |= {"curves": {}, "calibration": {}, "runs": {}, "sweeps": [], "planned": []}
    page = page_packs.write(pack, tmp_path).read_text()
    for anchor in ("planned", "worlds", "time", "calibration", "runs", "sweeps"):
        assert f'<section id="{anchor}"' not in page
        assert f'href="#{anchor}"' not in page
    assert '<section id="table"' in page


def test_report_md_is_one_screen_with_every_filter(tmp_path):
    pack = page_packs.build_pack(6, 2, 2, 8, names={1: "A|B"})
    page_packs.write(pack, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert len(text.splitlines()) < 50
    assert all(f["name"].replace("|", "\\|") in text for f in pack["filters"])


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.0, "0"), (1.125, "1.13"), (0.6449, "0.645"), (999.9, "1000"), (12345.6, "12300"),
     (1.5e6, "1.50e6"), (2e-5, "2.00e-5"), (-0.0123, "-0.0123"), (0.9996, "1.00")],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert format_short(value) == text


TIMES = {
    "sir[particles=100]": (100, 1.0), "sir[particles=400]": (400, 2.0), "sir[particles=1600]": (1600, 7.0),
    "apf[particles=100,resampler=x]": (100, 3.0), "apf[particles=400,resampler=x]": (400, 9.0),
    "apf[resampler=y]": (100, 2.5), "pso": (100, 4.0), "ekf": (0, 0.5),
}  # fmt: skip


def make_pack(times: dict[str, tuple[int, float]] = TIMES) -> dict[str, Any]:
    rows = [{"filter": key, "ms": ms} for key, (_, ms) in times.items()]
    missing = "The study has no jobs with budget=time."
    return {
        "views": {("rmse", "all", "all", "ekf"): {"rows": rows}},
        "filter_notes": [
            {"filter": key, "particles": str(n or "")} for key, (n, _) in times.items()
        ],
        "budgets": [
            {"key": "particles", "name": "Equal N", "reason_missing": None},
            {"key": "time", "name": "Equal time", "reason_missing": missing},
        ],
    }


def test_each_filter_has_the_most_particles_below_the_limit() -> None:
    """The limit is apf with its fewest particles: 3 ms. pso, with one number, exceeds it."""
    limit, filters = select_equal_time(make_pack())
    assert limit == 3.0
    assert filters == [
        "sir[particles=400]", "apf[particles=100,resampler=x]", "apf[resampler=y]", "ekf",
    ]  # fmt: skip
    equal_n, equal_time = offer_budgets(make_pack())
    assert "filters" not in equal_n
    assert equal_time["reason_missing"] is None
    assert equal_time["filters"] == filters
    assert "up to 3.00 ms per step" in equal_time["words"]


def test_one_filter_with_several_numbers_gives_no_choice() -> None:
    times = {key: value for key, value in TIMES.items() if "apf" not in key}
    assert offer_budgets(make_pack(times)) == make_pack(times)["budgets"]
    assert select_equal_time(make_pack(times)) == (0.0, [])


def test_filters_without_a_time_are_left_out() -> None:
    pack = make_pack()
    next(iter(pack["views"].values()))["rows"][1]["ms"] = None
    assert select_equal_time(pack)[1][0] == "sir[particles=100]"


# the budget of a comparison: what a job may state is what a report knows, and the usual one changes no job's name

CONFIG = OmegaConf.load(job.conf_dir() / "config.yaml")


def test_a_job_states_what_a_report_knows():
    assert DEFAULTS_NOT_IN_KEY == {"budget": store.SAME_N}
    assert CONFIG.budget == store.SAME_N
    assert set(DEFAULTS_NOT_IN_KEY) <= set(CONFIG)


def test_the_usual_budget_is_no_part_of_a_jobs_name():
    config = {"filter": {"particles": 10}, "seed": 1, "results": "here"}
    before = compute_config_key(
        config, job.IGNORED_IN_KEY
    )  # of jobs that ran when there was no such key
    assert job.job_key(config) == job.job_key({**config, "budget": store.SAME_N}) == before
    others = {job.job_key({**config, "budget": kind}) for kind in store.BUDGETS}
    assert len(others) == 3
    assert job.job_key({**config, "seed": 2}) not in others


def test_an_unknown_budget_is_refused_before_anything_runs():
    config = OmegaConf.create({**OmegaConf.to_container(CONFIG, resolve=False), "budget": "fair"})
    with pytest.raises(
        ValueError, match="budget must be one of particles, time, likelihoods, got 'fair'"
    ):
        job.apply_global_settings(config)
