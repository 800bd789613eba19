"""Small SVGs: the same picture, to a fraction of a point, in fewer letters."""

import io
import re
import xml.etree.ElementTree as ET
from urllib.parse import unquote

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from pfbench.report import vector
from pfbench.report.canvas import RC

_NUMBER = re.compile(r"-?\d*\.?\d+")


def distance(point, line):
    """From a point to a polyline [n, 2]."""
    a, b = line[:-1], line[1:]
    along = b - a
    square = np.maximum((along**2).sum(1), 1e-12)
    at = np.clip(((point - a) * along).sum(1) / square, 0, 1)
    return np.hypot(*(a + at[:, None] * along - point).T).min()


def corners(path):
    """Absolute corners of what `slim` writes: M, then steps of straight lines."""
    found = []
    for letter, said in re.findall(r"([Mlhz])([^Mlhz]*)", path):
        numbers = np.array([float(number) for number in _NUMBER.findall(said)])
        if letter == "M":
            found.append(numbers)
        elif letter == "l":
            found += list(found[-1] + np.cumsum(numbers.reshape(-1, 2), axis=0))
    return np.array(found)


def whole(figure):
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg")
    return buffer.getvalue()


@pytest.fixture(scope="module")
def figure():
    with matplotlib.rc_context(RC):
        drawn = Figure(figsize=(3.5, 2))
        axis = drawn.subplots()
        rng = np.random.default_rng(1)
        axis.plot(np.arange(200), np.cumsum(rng.standard_normal(200)), color="#0072B2", gid="walk")
        axis.scatter(np.arange(0, 200, 5), rng.standard_normal(40), s=5, color="0.15", alpha=0.55, lw=0)
        axis.plot([0, 100, 199], [1, 2, 3], marker="^", ls="none", color="#D55E00")
        axis.plot([10, 50], [0, 0], marker="o", mfc="white", color="black", ls="none")
        axis.imshow(np.eye(3), extent=(0, 20, 0, 5), aspect="auto")
        axis.set(title="50 % of <a> & b's \"c\"")
        yield drawn


@pytest.mark.parametrize("near", [0.5, 1.0, 3.0])
def test_what_a_line_loses_is_near_it(near):
    rng = np.random.default_rng(2)
    for _ in range(60):
        n = int(rng.integers(2, 60))
        walk = np.column_stack([np.cumsum(rng.integers(-2, 6, n)), np.cumsum(rng.integers(-4, 5, n))])
        kept = np.array(vector.thin([tuple(map(int, point)) for point in walk], near))
        assert (kept[0] == walk[0]).all()
        assert (kept[-1] == walk[-1]).all()
        assert max(distance(point, kept) if len(kept) > 1 else 0.0 for point in walk.astype(float)) <= near + 1e-9


def test_a_straight_line_has_two_ends_and_a_spike_stays():
    straight = [(3 * k, 2 * k) for k in range(50)]
    assert vector.thin(straight) == [straight[0], straight[-1]]
    spike = [(0, 0), (1, 0), (2, 300), (3, 0), (4, 0), (9, 0)]
    assert (2, 300) in vector.thin(spike)
    back = [(0, 0), (10, 0), (40, 0), (20, 0)]  # out along a line and back on it
    assert (40, 0) in vector.thin(back)


def test_lines_and_marks_stay_where_they_are(figure):
    with matplotlib.rc_context(RC):
        before, after = whole(figure), vector.drawn(figure)
    line = re.search(r'<g id="walk">\s*<path d="([^"]*)"', before)[1]
    there = np.array([[float(x), float(y)] for x, y in re.findall(r"[ML] (\S+) (\S+)", line)])
    paths = [corners(path) for path in re.findall(r' d="([^"]*)"', after)]
    assert any(len(p) > 20 and max(distance(point, p) for point in there) <= 0.3 for p in paths)
    dots = next(path for path in re.findall(r' d="([^"]*)"', after) if path.count("h0") == 40)
    uses = re.findall(r'<use xlink:href="(\S+)" x="(\S+)" y="(\S+)"', before)
    own = np.array([(float(x), float(y)) for name, x, y in uses if sum(name == other for other, _, _ in uses) == 40])
    np.testing.assert_allclose(corners(dots), own, atol=0.0501)
    look = re.search(re.escape(dots) + r'" class="(\w+)"|' + re.escape(dots) + r'" style="([^"]*)"', after)
    style = look[2] or re.search(rf"\.{look[1]}{{([^}}]*)}}", after)[1]
    assert "stroke-opacity:.55" in style
    wide = float(re.search(r"stroke-width:([\d.]+)", style)[1])
    assert wide == pytest.approx(np.sqrt(5), abs=0.1)  # s is the square of the diameter in points


def test_the_same_things_in_a_fifth_of_the_letters(figure):
    with matplotlib.rc_context({**RC, "svg.fonttype": "path"}):
        outlined = whole(figure)
    with matplotlib.rc_context(RC):
        svg = vector.drawn(figure)
        assert svg == vector.drawn(figure)
    assert len(svg) < len(outlined) / 3
    root = ET.fromstring(svg)
    texts = [element.text for element in root.iter() if element.tag.endswith("}text")]
    assert "50 % of <a> & b's \"c\"" in texts
    named = {element.get("id") for element in root.iter() if element.get("id")}
    used = set(re.findall(r'url\(#(\w+)\)|href="#(\w+)"', svg))
    assert {a or b for a, b in used} == named  # nothing is missing, and nothing is kept that is not used
    assert len([e for e in root.iter() if e.tag.endswith("}image")]) == 1
    hollow = [e for e in root.iter() if e.tag.endswith("}use")]
    assert len(hollow) in (0, 2)


def test_an_address_holds_the_whole_picture(figure):
    with matplotlib.rc_context(RC):
        svg = vector.drawn(figure)
    address = vector.linked(svg)
    assert '"' not in address
    assert "&" not in address
    assert "#" not in address
    head, _, data = address.partition(",")
    assert head == "data:image/svg+xml"
    assert ET.canonicalize(unquote(data)) == ET.canonicalize(svg)
