"""A figure as a small SVG: what matplotlib writes, without what no reader sees.

Coordinates are in points of 1/72 inch. They are rounded to a tenth of one, corners within two of the line without them are left
out, and each is written as its distance from the one before. Letters stay letters. Groups without a
property, names that nothing refers to and descriptions go. A figure of curves over time is then a sixth as large or less.
"""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from math import hypot
from urllib.parse import quote

from matplotlib.figure import Figure

_FONTS = "DejaVu Sans,Verdana,Arial,sans-serif"  # about as wide as the layout has counted on
_NEAR = 2  # tenths of a point
_NOTHING = ("Date", "Creator", "Format", "Type")
_NUMBER = re.compile(r"-?\d+\.\d+")
_STEP = re.compile(r"([MLCQz])([^MLCQz]*)")
_PIECE = re.compile(r"<[^>]+>|[^<]+")
_SHAPE = re.compile(r'<path id="([^"]*)" d="([^"]*)"(?: style="([^"]*)")?/>')
_START = re.compile(r"M(-?\d*\.?\d+) ?(-?\d*\.?\d+)")
_SIMPLE = 30  # letters of a shape that is drawn at each place rather than referred to
_MARK = re.compile(r'<use xlink:href="([^"]*)" x="([^"]*)" y="([^"]*)" style="([^"]*)"/>')
Point = tuple[int, int]
Cone = tuple[tuple[float, float], tuple[float, float], float]  # edges, right and left, and how far it must reach
_ANY: Cone = ((0.0, 0.0), (0.0, 0.0), 0.0)


def drawn(figure: Figure) -> str:
    """The figure, as it is laid out, as SVG."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata=dict.fromkeys(_NOTHING))
    return slim(buffer.getvalue())


def linked(svg: str) -> str:
    """An address that holds the whole picture, for an attribute in double quotes."""
    single = re.sub(r"""="([^"']*)\"""", r"='\1'", svg)
    return "data:image/svg+xml," + quote(single, safe=" '=:/;,.()-+*!~@[]?$|<>")


def slim(svg: str) -> str:
    """The same picture in fewer letters."""
    svg = re.sub(r"<metadata>.*?</metadata>|<!DOCTYPE[^>]*>|<\?xml[^>]*\?>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = re.sub(r"(?<=<g) id=\"[^\"]*\"", "", svg)
    svg = re.sub(r'(?<= style=")[^"]*(?=")', _styled, svg)
    svg = re.sub(r'(?<= d=")[^"]*(?=")', _path, svg)
    svg = re.sub(r' transform="rotate\(-?0 [^"]*"', "", svg)
    svg = re.sub(r'(?<= (?:x|y)=")[^"]*(?=")|(?:translate|rotate)\([^)]*\)', _rounded, svg)
    return _classed(_renamed(_marks(_flat(svg))))


def thin(points: list[Point], near: float = _NEAR) -> list[Point]:
    """Corners of a line, without those that lie near it without them.

    Args:
        points: of the line, in its order.
        near: of each stretch that is left out no corner is farther than this from the chord that stands for it.
    """
    if len(points) < 3:
        return points
    kept, cone, before = [points[0]], _ANY, points[1]
    for point in points[1:]:
        x, y = point[0] - kept[-1][0], point[1] - kept[-1][1]
        if not (cone[0][0] * y - cone[0][1] * x >= 0 <= x * cone[1][1] - y * cone[1][0] and hypot(x, y) >= cone[2]):
            kept.append(before)
            x, y, cone = point[0] - before[0], point[1] - before[1], _ANY
        cone, before = _narrowed(cone, x, y, near), point
    return [*kept, points[-1]]


def _narrowed(cone: Cone, x: float, y: float, near: float) -> Cone:
    """The cone of directions that pass near what is left out so far, and near (x, y) too."""
    length = hypot(x, y)
    if length <= near:  # near the corner where the stretch begins
        return cone
    low, high = (x + near * y / length, y - near * x / length), (x - near * y / length, y + near * x / length)
    if cone is not _ANY:
        low = low if cone[0][0] * low[1] - cone[0][1] * low[0] > 0 else cone[0]
        high = high if high[0] * cone[1][1] - high[1] * cone[1][0] > 0 else cone[1]
    return low, high, max(length, cone[2])


def _path(found: re.Match[str]) -> str:
    """Steps from corner to corner, in tenths."""
    said: list[str] = []
    at, line = (0, 0), []
    for letter, numbers in [*_STEP.findall(found[0]), ("", "")]:
        tenths = [round(10 * float(number)) for number in numbers.split()]
        points = list(zip(tenths[::2], tenths[1::2], strict=True))
        if letter == "L":
            line += points
            continue
        if line:
            corners = thin([at, *line])
            said.append("l" + _joined(_steps(corners[0], corners[1:])))
            at, line = corners[-1], []
        if letter == "M":
            said.append("M" + _joined(points[0]))
        elif letter == "z":
            said.append("z")
        elif letter:  # a curve, with all its points from where it begins
            said.append(letter.lower() + _joined([value for x, y in points for value in (x - at[0], y - at[1])]))
        at = points[-1] if points else at
    return "".join(said)


def _steps(at: Point, corners: Iterable[Point]) -> Iterator[int]:
    for corner in corners:
        yield corner[0] - at[0]
        yield corner[1] - at[1]
        at = corner


def _joined(tenths: Iterable[int]) -> str:
    """Numbers, with a space only where two would be read as one."""
    text, last = "", ""
    for value in tenths:
        own = _short(value / 10)
        joins = not text or own[0] == "-" or (own[0] == "." and "." in last)
        text, last = text + (own if joins else f" {own}"), own
    return text


def _short(value: float, digits: int = 1) -> str:
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits else f"{value:.0f}"
    return "0" if text == "-0" else text.replace("0.", ".", 1) if text.startswith(("0.", "-0.")) else text


def _rounded(found: re.Match[str]) -> str:
    return _NUMBER.sub(lambda number: _short(float(number[0])), found[0])


def _styled(found: re.Match[str]) -> str:
    text = re.sub(r"\s*([:;])\s*", r"\1", found[0]).strip(";")
    text = re.sub(r"(?<=font-family:)[^;]*", _FONTS, text)
    text = _NUMBER.sub(lambda number: _short(float(number[0]), 2), text)
    return re.sub(r"#(\w)\1(\w)\2(\w)\3\b", r"#\1\2\3", text)


def _flat(svg: str) -> str:
    """Without space between tags, and without groups that have no property or nothing in them."""
    kept: list[str] = []
    says: list[bool] = []
    for piece in _PIECE.findall(svg):
        if piece == "</g>":
            if not says.pop():
                continue
        elif piece.startswith("<g"):
            if piece.endswith("/>"):
                continue
            says.append(piece != "<g>")
            if not says[-1]:
                continue
        elif not piece.strip():
            continue
        kept.append(re.sub(r"\s+", " ", piece))
    return "".join(kept)


def _marks(svg: str) -> str:
    """Marks of one kind, one after another, as one path; shapes of many corners in a group, which says once how they look."""
    shapes = {name: (corners, look) for name, corners, look in _SHAPE.findall(svg)}

    def together(found: re.Match[str]) -> str:
        kinds = groupby(_MARK.findall(found[0]), key=lambda mark: (mark[0], mark[3]))
        return "".join(_drawn_once(name, look, [(x, y) for _, x, y, _ in own], shapes) for (name, look), own in kinds)

    svg = re.sub(rf"(?:{_MARK.pattern})+", together, svg)
    svg = _SHAPE.sub(lambda shape: shape[0] if f'"#{shape[1]}"' in svg else "", svg)
    return svg.replace("<defs></defs>", "")


def _drawn_once(name: str, look: str, places: Sequence[tuple[str, str]], shapes: Mapping[str, tuple[str, str]]) -> str:
    corners, own = shapes.get(name.removeprefix("#"), ("", ""))
    said = dict(part.split(":", 1) for part in (*look.split(";"), *own.split(";")) if part)
    if (across := _dot(corners)) and said.get("stroke", said.get("fill")) == said.get("fill", "#000"):
        wide = across + (float(said.get("stroke-width", 1)) if "stroke" in said else 0)
        opacity = f";stroke-opacity:{said['fill-opacity']}" if "fill-opacity" in said else ""
        dots = "".join(f"M{_joined([round(10 * float(x)), round(10 * float(y))])}h0" for x, y in places)
        round_ = f"stroke:{said.get('fill', '#000')};stroke-width:{_short(wide, 2)};stroke-linecap:round{opacity}"
        return f'<path d="{dots}" style="fill:none;{round_}"/>'
    if corners and (len(places) == 1 or len(corners) <= _SIMPLE):
        moved = "".join(_START.sub(partial(_moved, x=float(x), y=float(y)), corners) for x, y in places)
        return f'<path d="{moved}" style="{";".join(f"{key}:{value}" for key, value in said.items())}"/>'
    marks = "".join(f'<use xlink:href="{name}" x="{x}" y="{y}"/>' for x, y in places)
    return f'<g style="{look}">{marks}</g>'


def _moved(found: re.Match[str], x: float, y: float) -> str:
    return "M" + _joined([round(10 * (float(found[1]) + x)), round(10 * (float(found[2]) + y))])


def _dot(corners: str) -> float:
    """Diameter of a circle, which matplotlib draws as eight curves from its lowest point; 0 of any other shape."""
    if corners.count("c") != 8 or not corners.startswith("M0 ") or "l" in corners:
        return 0.0
    return 2 * abs(float(corners[3 : corners.index("c")]))


def _renamed(svg: str) -> str:
    """Short names for what is referred to, and none for what is not."""
    for number, name in enumerate(dict.fromkeys(re.findall(r'(?<= id=")[^"]+(?=")', svg))):
        own = f"a{number}"
        svg = svg.replace(f' id="{name}"', f' id="{own}"' if f"#{name}" in svg else "")
        svg = svg.replace(f"#{name})", f"#{own})").replace(f'#{name}"', f'#{own}"')
    return svg


def _classed(svg: str) -> str:
    """Looks that occur more than once in the style sheet."""
    found = Counter(re.findall(r' style="([^"]*)"', svg))
    names = {style: f"b{number}" for number, style in enumerate(style for style, n in found.items() if n > 1)}
    rules = "".join(f".{name}{{{style}}}" for style, name in names.items())
    svg = re.sub(r' style="([^"]*)"', lambda look: f' class="{names[look[1]]}"' if look[1] in names else look[0], svg)
    return svg.replace("</style>", f"{rules}</style>", 1)
