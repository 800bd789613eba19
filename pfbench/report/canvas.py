"""What all figures share: size, palette, legends, ticks, quantiles over runs."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import cycle, pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

COLUMN = 3.5  # inches
SMALL = 6.5  # points of the smallest letters, where a name has to fit a row of many
LETTER = 0.62 * SMALL  # points that one of them is wide, on average
INSTANTS = 180  # drawn at most: a column of print is 250 points wide
_CLOSE = 9  # points between marks of which each has a line to its name
_BESIDE = 24  # letters of a label beside which another one has room
RC: Any = {
    "font.size": 8,
    "font.family": "DejaVu Sans",  # comes with matplotlib; a list of families would be searched for each text
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # no search for a place, which takes longer than drawing a panel
    "axes.grid": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.35,
    "grid.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "figure.dpi": 150,  # letters are as wide when a figure is laid out as when it is saved, and names are not cut
    "savefig.dpi": 150,
    "svg.hashsalt": "pfbench",  # identifiers of an SVG are random otherwise
    "svg.fonttype": "none",  # letters, which can be read and searched, and take less room than their outlines
}
# Okabe and Ito 2008, without the yellow that white paper swallows.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00")
# From light to dark in equal steps of lightness, which every eye and a grey printer tell apart: tints and shades of one blue.
SHADES = ("#dfedf5", "#aad0e5", "#74b2d5", "#3e94c5", "#0474b3", "#005788", "#003c5d", "#002235")
_Dash = str | tuple[int, tuple[float, ...]]
_DASHES: tuple[_Dash, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)), (0, (3, 1, 1, 1, 1, 1)))
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


class Look(NamedTuple):
    """How one filter is drawn in all figures of a study; a quiet one is one of many, grey and without a name.

    Curves over time have so many instants at most, fewer where many curves share a column.
    """

    colour: str
    dash: _Dash
    marker: str
    width: float
    quiet: bool = False
    instants: int = INSTANTS

    def line(self, label: str = "") -> dict[str, Any]:
        """How its line is drawn, and named where it is."""
        named = {} if self.quiet or not label else {"label": label}
        return {"color": self.colour, "ls": self.dash, "lw": self.width, "zorder": 1.5 if self.quiet else 2.0, **named}


def looks(labels: Sequence[str]) -> dict[str, Look]:
    """Colour, dash and marker of each filter; all three differ for neighbours, so that one suffices in grey.

    Later lines are thinner: where filters agree exactly, the earlier ones still show on both sides.
    """
    names = list(dict.fromkeys(labels))
    first = min(len(names), 8)
    widths = [*np.linspace(1.0 + min(0.25 * first, 1.0), 1.0, first), *[1.0] * (len(names) - first)] if first > 1 else [1.3]
    each = zip(names, cycle(_COLOURS), cycle(_DASHES), cycle(_MARKERS), widths, strict=False)
    return {label: Look(colour, dash, marker, float(width)) for label, colour, dash, marker, width in each}


def dimmed(style: Mapping[str, Look], kept: Iterable[str]) -> dict[str, Look]:
    """The same looks, with all but those kept made quiet."""
    own = set(kept)
    return {
        label: look._replace(instants=2 * INSTANTS // 5)
        if label in own
        else look._replace(colour="0.78", dash="-", width=0.6, quiet=True, instants=INSTANTS // 5)
        for label, look in style.items()
    }


def stack(n: int, height: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(COLUMN, 0.3 + height * n), layout="constrained")
    return figure, list(figure.subplots(n, 1, squeeze=False, sharex=sharex)[:, 0])


def roomy() -> ConstrainedLayoutEngine:
    """A layout in which a name that takes all the room does not touch the edge."""
    return ConstrainedLayoutEngine(w_pad=0.1)


def legend(figure: Figure, axis: Axes, columns: int = 2) -> None:
    """A legend below the figure, which grows by the height of it."""
    handles, labels = axis.get_legend_handles_labels()
    if not labels:  # all are quiet
        return
    columns = 1 if max(map(len, labels), default=0) > _BESIDE else min(columns, len(labels))
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.1 + 0.16 * -(-len(labels) // columns))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def indexed(figure: Figure) -> bytes:
    """The figure as a PNG of 97 colours: the filters' in steps to white, shades of maps, and greys; a quarter as large."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    picture = Image.open(buffer).convert("RGB").quantize(palette=_palette(), dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


@cache
def _palette() -> Image.Image:
    colours = [*(colour for colour in _COLOURS if colour != "#000000"), "#B35900"]
    pure = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours])
    whiter = pure[:, None] + (255 - pure[:, None]) * np.linspace(0, 1, 8, endpoint=False)[:, None]
    shades = np.array([[int(shade[i : i + 2], 16) for i in (1, 3, 5)] for shade in SHADES])
    greys = np.repeat(np.minimum(np.arange(0, 257, 8), 255)[:, None], 3, axis=1)  # so near that no tint is nearer to a grey
    steps = np.round(np.concatenate([whiter.reshape(-1, 3), shades, greys])).astype(np.uint8)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([steps, np.repeat(steps[-1:], 256 - len(steps), axis=0)]).tobytes())
    return palette


def labelled(what: str, unit: str) -> str:
    return f"{what} in {unit}" if unit else what


def slug(text: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in text).strip("_")


def thinned(size: int, most: int = INSTANTS) -> np.ndarray:
    return np.unique(np.linspace(0, size - 1, min(size, most)).astype(int))


def quantiles(values: np.ndarray, q: Sequence[float]) -> np.ndarray:
    """Over runs [R, T] -> [len(q), T], NaN where no run is known."""
    found = np.full((len(q), values.shape[1]), np.nan)
    known = ~np.isnan(values)
    whole, some = known.all(axis=0) & bool(len(values)), known.any(axis=0) & ~known.all(axis=0)
    if whole.any():
        found[:, whole] = np.quantile(values[:, whole], q, axis=0)
    if some.any():
        found[:, some] = np.nanquantile(values[:, some], q, axis=0)
    return found


def jitter(n: int) -> np.ndarray:
    """Offsets that spread points, the same at every drawing: the fractional parts of multiples of the golden ratio."""
    return 0.4 * ((np.arange(n) * 0.6180339887) % 1 - 0.5)


def _finite(values: Sequence[np.ndarray]) -> np.ndarray:
    flat = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values]) if values else np.empty(0)
    return flat[np.isfinite(flat)]


def log_if_wide(axis: Axes, side: Axis, values: Sequence[np.ndarray]) -> None:
    flat = _finite(values)
    flat = flat[flat > 0]
    if flat.size and np.quantile(flat, 0.995) > 10 * np.quantile(flat, 0.005):
        (axis.set_xscale if side is axis.xaxis else axis.set_yscale)("log")
        plain_ticks(side, flat)


def plain_ticks(side: Axis, values: Sequence[float] | np.ndarray, narrow: bool = False) -> None:
    """Plain numbers on a logarithmic axis: 1, 2, 5 where it is short, decades where it is long.

    1 and 3 where there is little room: where it is said, and where long numbers lie abreast.
    """
    flat = _finite([np.asarray(values)])
    flat = flat[flat > 0]
    reach = flat.max() / flat.min() if flat.size else 1.0
    if reach < 10:
        side.set_major_locator(ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
    else:
        narrow = narrow or (side is side.axes.xaxis and flat.max() >= 1e4)
        short = (1.0, 3.0) if narrow else (1.0, 2.0, 5.0)
        side.set_major_locator(ticker.LogLocator(subs=short if reach < 100 else (1.0,), numticks=8))
    side.set_major_formatter(_Numbers())
    if reach < 100:  # 1, 2 and 5 have their own; minor ones between them only cost time
        side.set_minor_locator(ticker.NullLocator())
    side.set_minor_formatter(ticker.NullFormatter())


def told(values: Sequence[float]) -> list[str]:
    """Numbers of one axis in one style: plain, and where the largest or the smallest takes many digits all in powers of ten."""
    sizes = [abs(value) for value in values if value]
    if not sizes or (max(sizes) < 1e5 and min(sizes) >= 1e-4):
        return [f"{value:g}" for value in values]
    return list(map(_power, values))


def _power(value: float) -> str:
    if not value:
        return "0"
    digits, _, exponent = f"{value:.3e}".partition("e")
    factor, tens = float(digits), "10" + str(int(exponent)).translate(_RAISED)
    return f"{factor:g}·{tens}" if abs(factor) != 1 else tens if factor > 0 else f"-{tens}"


class _Numbers(ticker.Formatter):
    """Ticks in the style of those of them that are seen."""

    def __call__(self, value: float, pos: int | None = None) -> str:
        return told([value])[0]

    def format_ticks(self, values: Any) -> list[str]:
        low, high = sorted(self.axis.get_view_interval()) if self.axis is not None else (-np.inf, np.inf)
        near = 1e-9  # the ends of an axis are ticks too, but for rounding
        seen = [value for value in values if low * (1 - near) <= value <= high * (1 + near)]
        return [dict(zip(seen, told(seen), strict=True)).get(value, "") for value in values]


def zoom(axis: Axes, curves: Sequence[np.ndarray]) -> None:
    """Symmetric limits that leave out the first fifth where it dwarfs the rest; never what comes later."""
    rest = np.abs(_finite([curve[len(curve) // 5 :] for curve in curves])).max(initial=0.0)
    if np.abs(_finite(curves)).max(initial=0.0) > 3 * rest > 0:
        axis.set_ylim(-1.1 * rest, 1.1 * rest)


def named_beside(axis: Axes, points: np.ndarray, names: Mapping[int, str], reach: np.ndarray, path: np.ndarray) -> None:
    """Small names beside points of a panel that is laid out, each where it covers nothing, and a line where it is not close by.

    A name takes the cheapest place of a grid over the panel: close to its point, and clear of marks, of the path, and of other
    names and their lines; once all have a place, each looks for its own again.

    Args:
        axis: the panel.
        points: all marks [n, 2].
        names: by row of `points`.
        reach: of each mark, in points of print [n].
        path: corners of a line through the panel [m, 2].
    """
    scale = 72 / axis.figure.dpi
    at, corners = (axis.transData.transform(values) * scale for values in (points, path))
    low, high = axis.get_window_extent().get_points() * scale
    parts = np.linspace(0, 1, 25)[:, None]
    fixed = np.concatenate([at, *(a + parts * (b - a) for a, b in pairwise(corners))])
    clear = np.concatenate([reach, np.full(len(fixed) - len(at), 1.0)])
    weight = np.concatenate([np.full(len(at), 300.0), np.full(len(fixed) - len(at), 4.0)])
    sizes = {k: _size(name) for k, name in names.items()}
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # corner of each name, and where its line ends
    for k in 2 * sorted(names, key=lambda k: tuple(at[k])):
        found.pop(k, None)
        last = np.maximum(high - sizes[k] - 1, low + 1)
        across, up = (np.arange(low[i] + 1, last[i] + 1, step) for i, step in enumerate((4, 2.5)))
        boxes = np.stack(np.meshgrid(across, up), -1).reshape(-1, 2)
        ends = np.clip(at[k], boxes, boxes + sizes[k])
        cost = np.hypot(*(ends - at[k]).T) + 0.02 * np.abs(boxes + sizes[k] / 2 - at[k]).sum(-1)
        cost += _covered(boxes, sizes[k], fixed, clear) @ weight
        lines = at[k] + parts[::3] * (ends[:, None] - at[k])  # from the point to the name
        others = at[np.hypot(*(at - at[k]).T) > _CLOSE]
        cost += 20 * (((lines[:, :, None] - others) ** 2).sum(-1) < 3**2).any(1).sum(-1)
        for j, (box, end) in found.items():
            cost += 1000 * ((boxes < box + sizes[j] + 1) & (box < boxes + sizes[k] + 1)).all(-1)
            cost += 300 * _covered(boxes, sizes[k], at[j] + parts * (end - at[j]), np.ones(len(parts))).any(-1)
            cost += 300 * ((lines > box) & (lines < box + sizes[j])).all(-1).any(-1)
            cost += 60 * _cross(at[k], ends, at[j], end)
        best = int(np.argmin(cost))
        found[k] = boxes[best], ends[best]
    for k, (box, end) in found.items():
        far = np.hypot(*(end - at[k])) > reach[k] + 3 or (np.hypot(*(at - at[k]).T) < _CLOSE).sum() > 1
        line: Any = {"arrowstyle": "-", "lw": 0.4, "color": "0.35", "shrinkA": 0, "shrinkB": 0}
        part = (end - box) / sizes[k]
        side = 0.0 if part[0] < 0.1 else 1.0 if part[0] > 0.9 else 0.5  # the end that is held: how wide letters are is a guess
        axis.annotate(
            names[k], tuple(points[k]), tuple(box + (side, 0.5) * sizes[k] - at[k]), textcoords="offset points", fontsize=SMALL,
            ha={0.0: "left", 0.5: "center", 1.0: "right"}[side], va="center", linespacing=1.0, zorder=5,
            arrowprops=line | {"relpos": tuple(part)} if far else None, in_layout=False,
        )  # fmt: skip


def _size(text: str) -> np.ndarray:
    """Width and height of small letters in points of print."""
    lines = text.split("\n")
    return np.array([max(map(len, lines)) * LETTER, 1.2 * SMALL * len(lines)])


def _covered(boxes: np.ndarray, size: np.ndarray, points: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Which points [n] lie in boxes [m, 2] of that size, or nearer to them than they may: [m, n]."""
    off = np.clip(points, boxes[:, None], boxes[:, None] + size) - points
    return np.asarray((off**2).sum(-1) < clear**2)


def _cross(a: np.ndarray, ends: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Do lines from a to each of the ends [m, 2] meet that from c to d?"""
    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.asarray((q - p)[..., 0] * (r - p)[..., 1] - (q - p)[..., 1] * (r - p)[..., 0])

    return np.asarray((side(a, ends, c) * side(a, ends, d) < 0) & (side(c, d, a) * side(c, d, ends) < 0))


def broken(label: str, width: int = 26) -> str:
    """A filter's label on as many lines as a column has room for: settings in brackets on lines of their own."""
    if len(label) <= width or "[" not in label:
        return label
    name, _, told = label.partition("[")
    return f"{name}\n[{told}"


def wrapped(label: str, width: int = 18) -> str:
    """A filter's label on lines of no more letters where it can be broken: after a "_" or a ".", and before a "["."""
    lines = [""]
    for part in re.findall(r"\[?[^_.\[]+[_.]*|\[", label):
        if lines[-1] and len(lines[-1]) + len(part) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
