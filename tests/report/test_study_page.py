"""The page of a study without a browser: its data, its escapes, its size and its text."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser

import numpy as np
import page_packs
import pytest

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.study_page import write_page
from pfbench.report.study_page.encoding import (
    encode_decimals,
    encode_levels,
    encode_pack,
    encode_views,
)
from pfbench.report.study_page.page_writer import format_short


def write(pack, path):
    with RecordedFolder(path) as folder:
        return write_page(pack, folder)


def read_levels(code):
    """Decode levels by the rule of the format, value by value."""
    raw = code["code"]
    bits = code.get("w", 8)
    levels = list(raw)
    if bits > 8:
        half = len(raw) // 2
        levels = [256 * high + low for high, low in zip(raw[:half], raw[half:], strict=True)]
    if code.get("d"):
        total, sums = 0, []
        for level in levels:
            total = (total + level) % 2**bits
            sums.append(total)
        levels = sums
    middle = 2 ** (bits - 1) if code.get("s") else 0
    top = 2 ** (bits - 1) - 1 if code.get("s") else 2**bits - 1
    step = (code["h"] / code["l"]) ** (1 / (top - 1))
    numbers = []
    for level in levels:
        size = abs(level - middle)
        value = code["l"] * step ** (size - 1) if size else 0.0
        numbers.append(np.nan if level == 0 else value * np.sign(level - middle))
    return np.array(numbers)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("is_smooth", [False, True])
def test_levels_keep_numbers_to_half_a_step(bits, is_smooth):
    rng = np.random.default_rng(1)
    numbers = np.exp(rng.normal(0, 2, 400))
    numbers[[3, 50]] = np.nan
    code = encode_levels(numbers, bits, is_smooth=is_smooth)
    ratio = np.log(read_levels(code) / numbers)
    half = np.log(code["h"] / code["l"]) / (2**bits - 2) / 2
    assert np.nanmax(np.abs(ratio)) < half + 2e-3  # the ends are rounded to four digits
    assert np.isnan(ratio).sum() == 2


def test_signed_levels_keep_sign_and_zero():
    numbers = np.array([0.0, 3.0, -3.0, 120.0, -0.5, np.nan])
    decoded = read_levels(encode_levels(numbers, is_signed=True))
    assert decoded[0] == 0
    assert np.isnan(decoded[5])
    np.testing.assert_allclose(decoded[1:5], numbers[1:5], rtol=0.04)


@pytest.mark.parametrize("values", [[None], [2.0, 2.0], [None, None, 1e-9]])
def test_levels_of_few_numbers(values):
    decoded = read_levels(encode_levels(values))
    np.testing.assert_allclose(decoded, np.array(values, float), rtol=1e-3)


def unpack(text):
    """Return the data of a page, with lengths in place of the bytes of codes."""
    packed = text.translate(str.maketrans(",.", "<&"))
    content = gzip.decompress(base64.b85decode(packed))
    end = 4 + int.from_bytes(content[:4], "big")
    return json.loads(content[4:end])


def unpack_page(page):
    return unpack(re.search(r'id="data">([^<]*)<', page).group(1))


def test_decimals_are_exact():
    values = [0.2335, None, 0.0, 9999.0, 1e-7, 1.234e200, 12.3, 5e-324]
    code = encode_decimals(values)
    raw, count = code["code"], code["c"]
    words = [[256 * raw[k] + raw[k + count] for k in range(n, n + count)] for n in (0, 2 * count)]
    decoded = [
        [None, 0.0][shift] if shift < 2 else float(f"{mantissa}e{shift - 515}")
        for mantissa, shift in zip(*words, strict=True)
    ]
    assert decoded == values


@pytest.mark.parametrize("value", [-1.0, 1.23456])
def test_decimals_that_cannot_be_exact_are_refused(value):
    with pytest.raises(ValueError, match="positive and have at most four digits"):
        encode_decimals([1.0, value])


def test_views_are_columns_of_their_places_scopes_and_own():
    pack = page_packs.build_pack(5, 2, 2, 8)
    views = encode_views(pack["views"], [look["key"] for look in pack["filters"]])
    assert set(views["fixed"]) >= {"coverage", "track", "ms"}
    assert set(views["shared"]) >= {"filter", "value", "words"}
    assert set(views["separate"]) == {"ratio", "ratio_low", "ratio_high"}
    assert all(len(column) == 9 for column in views["fixed"].values())  # (2 + 1) x (2 + 1) places
    assert views["shared"]["value"]["c"] == 5 * len(views["keys"])
    assert views["separate"]["ratio"]["c"] == 5 * len(pack["views"])
    for key, view in pack["views"].items():
        scope, base = views["keys"].index(list(key[:3])), views["baselines"].index(key[3])
        assert views["texts"][scope][base]["sentence"] == view["sentence"]


def test_a_page_carries_fewer_tracks_rather_than_too_many_bytes():
    pack = page_packs.build_pack(6, 2, 2, 12)
    whole = len(encode_pack(pack, 10**8))
    text = encode_pack(pack, whole // 2)
    tracks = unpack(text)["tracks"]
    assert len(text) <= whole // 2
    for part in (part for regimes in tracks.values() for part in regimes.values()):
        assert 1 <= len(part["numbers"]) < 10
        assert all(len(runs) == len(part["numbers"]) for runs in part["error"].values())


@pytest.mark.slow
def test_the_largest_page_stays_under_its_size(tmp_path):
    path = write(page_packs.build_pack(33, 7, 4, 100), tmp_path)
    assert path.stat().st_size < 1_500_000
    assert unpack_page(path.read_text())["tracks"]
    pack = page_packs.build_pack(33, 7, 4, 100, carried=0, instants=24)
    assert write(pack, tmp_path / "bare").stat().st_size < 400_000


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
    elements.feed(write(pack, tmp_path).read_text())
    assert elements.counts["script"] == 2
    assert "img" not in elements.counts
    assert set(hostile.values()) <= set(elements.texts)
    markdown = (tmp_path / "report.md").read_text()
    assert "<script>" not in markdown.replace("\\<", "")


def test_first_lines_name_severely_overconfident_runs(tmp_path):
    """Largest share first, at most four filters by name."""
    pack = page_packs.build_pack(7)
    write(pack, tmp_path / "none")
    assert "Severely overconfident runs" not in (tmp_path / "none" / "report.md").read_text()
    for note, count in zip(pack["filter_notes"], (2, 20, 0, 5, 9, 1, 3), strict=True):
        note["severely_overconfident"] = count
    pack["filter_notes"][5]["runs"] = 1
    page = write(pack, tmp_path / "some").read_text()
    sentence = (
        "Severely overconfident runs: Filter 1 20 of 20, Filter 5 1 of 1, Filter 4 9 of 20, "
        "Filter 3 5 of 20 and 2 other filters."
    )
    assert sentence in page
    lines = (tmp_path / "some" / "report.md").read_text().splitlines()
    assert sentence in lines[:8]


def test_a_page_tells_exact_filters_from_bounded_weights(tmp_path):
    """A dash for what an older result does not state, and for a page stored before there was the flag."""
    pack = page_packs.build_pack(6)
    del pack["filter_notes"][4]["has_bounded_weights"]
    page = write(pack, tmp_path).read_text()
    rows = re.findall(r"<td>(yes|no)</td><td>(yes|no|–)</td>", page)
    bounded = ["yes", "no", "–", "yes", "–", "–"]
    assert rows == list(zip(["yes", "no"] * 3, bounded, strict=True))


def test_a_page_says_in_words_why_a_budget_is_missing(tmp_path):
    elements = write(page_packs.build_pack(), tmp_path).read_text()
    assert "Same time: This study has no runs of that budget.</p>" in elements


def test_equal_packs_give_equal_bytes(tmp_path):
    pages = [write(page_packs.build_pack(), tmp_path / name).read_bytes() for name in "ab"]
    assert pages[0] == pages[1]


@pytest.mark.parametrize("colour", ["red", "#12345", "#123456;}body{display:none"])
def test_a_colour_must_be_a_colour(tmp_path, colour):
    pack = page_packs.build_pack()
    pack["filters"][0]["dark"] = colour
    with pytest.raises(ValueError, match=r"colour of f0 must have the form #rrggbb"):
        write(pack, tmp_path)


def test_sections_without_data_are_absent(tmp_path):
    pack = page_packs.build_pack(3, 1, 1, 4, carried=0)
    pack |= {"curves": {}, "calibration": {}, "runs": {}, "sweeps": [], "planned": []}
    page = write(pack, tmp_path).read_text()
    for anchor in ("planned", "worlds", "time", "calibration", "runs", "sweeps"):
        assert f'<section id="{anchor}"' not in page
        assert f'href="#{anchor}"' not in page
    assert '<section id="table"' in page


def test_report_md_is_one_screen_with_every_filter(tmp_path):
    pack = page_packs.build_pack(6, 2, 2, 8, names={1: "A|B"})
    write(pack, tmp_path)
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
