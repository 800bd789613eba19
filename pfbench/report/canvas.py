"""What all figures share: size, palette, legends, ticks, quantiles over runs."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from PIL import Image

COLUMN = 3.5  # inches
INSTANTS = 180  # drawn at most: a column of print is 250 points wide
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
    "savefig.dpi": 150,
    "svg.hashsalt": "pfbench",  # identifiers of an SVG are random otherwise
    "svg.fonttype": "none",  # letters, which can be read and searched, and take less room than their outlines
}
# Okabe and Ito 2008, without the yellow that white paper swallows.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00")
_Dash = str | tuple[int, tuple[float, ...]]
_DASHES: tuple[_Dash, ...] = ("-", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)), (0, (3, 1, 1, 1, 1, 1)))
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
    """The figure as a PNG of 74 colours: those of the filters and greys, in steps to white; a quarter as large."""
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
    greys = np.repeat(np.linspace(0, 255, 18)[:, None], 3, axis=1)
    steps = np.round(np.concatenate([whiter.reshape(-1, 3), greys])).astype(np.uint8)
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


def plain_ticks(side: Axis, values: Sequence[float] | np.ndarray) -> None:
    """Plain numbers on a logarithmic axis: 1, 2, 5 where it is short, decades where it is long."""
    flat = _finite([np.asarray(values)])
    flat = flat[flat > 0]
    reach = flat.max() / flat.min() if flat.size else 1.0
    if reach < 10:
        side.set_major_locator(ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
    else:
        side.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0) if reach < 100 else (1.0,), numticks=8))
    side.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    if reach < 100:  # 1, 2 and 5 have their own; minor ones between them only cost time
        side.set_minor_locator(ticker.NullLocator())
    side.set_minor_formatter(ticker.NullFormatter())


def zoom(axis: Axes, curves: Sequence[np.ndarray]) -> None:
    """Symmetric limits that leave out the first fifth where it dwarfs the rest; never what comes later."""
    rest = np.abs(_finite([curve[len(curve) // 5 :] for curve in curves])).max(initial=0.0)
    if np.abs(_finite(curves)).max(initial=0.0) > 3 * rest > 0:
        axis.set_ylim(-1.1 * rest, 1.1 * rest)


def broken(label: str, width: int = 26) -> str:
    """A filter's label on as many lines as a column has room for: settings in brackets on lines of their own."""
    if len(label) <= width or "[" not in label:
        return label
    name, _, told = label.partition("[")
    return f"{name}\n[{told}"
