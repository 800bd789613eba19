"""Common parts of figures: size, palette, axes, legends, quantiles over runs, and files with captions."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from PIL import Image
from typing_extensions import override

from pfbench.results.looks import MethodLook, find_looks
from pfbench.results.paper_block import MARKERS

COLUMN = 3.5  #: inches, width of a column of print
CURVE_RANGE = 1e4  # of an axis, above the typical value of the best filter
INSTANTS = 180  # points of a curve at most: a column of print is 250 points wide
SMALL = 6.5  # points, smallest font size
_WIDE_LABEL = 24  # letters; a legend with longer labels has a single column
#: settings of matplotlib for all figures
RC: Any = {
    "font.size": 8,
    "font.family": ["DejaVu Sans", "sans-serif"],  # the second is for SVG viewers without the first
    "font.sans-serif": ["DejaVu Sans"],  # the longer default list would be searched for each text
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # automatic placement takes longer than drawing a panel
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
    "figure.dpi": 150,  # equal to savefig.dpi, so that text widths of the layout hold in the file
    "savefig.dpi": 150,
    "text.parse_math": False,  # a label from a file may contain $ as a plain character
    "pdf.fonttype": 42,  # TrueType: journals refuse Type 3
    "svg.hashsalt": "pfbench",  # SVG identifiers are random otherwise
    "svg.fonttype": "none",  # text stays text, which is searchable and smaller than outlines
}
# Okabe and Ito 2008, without yellow, which has too little contrast on white; for lines of no method.
PLAIN_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00")
_COORDINATES = re.compile(rb' (?:d|x|y|transform)="[^"]*"')
_DIGITS = re.compile(rb"-?\d+\.\d+")
_LINES = re.compile(rb"M [\d. e-]+(?:\nL [\d. e-]+)+")  # of a path, whose letters may be left out
_STYLE = re.compile(rb'style="([^"]*)"')
_INDENT = re.compile(rb"\n\s+(?=<)")
_Dash = str | tuple[int, tuple[float, ...]]
_DASHES: tuple[_Dash, ...] = (
    "-",
    (0, (5, 1.5)),
    (0, (1.5, 1)),
    (0, (6, 1.5, 1.5, 1.5)),
    (0, (3, 1, 1, 1, 1, 1)),
)
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")


class LineStyle(NamedTuple):
    """Line style of a filter in all figures of a study.

    Attributes:
        colour: Line colour.
        dash: Dash pattern of matplotlib.
        marker: Marker of matplotlib.
        width: Line width in points.
        filled: Whether marks are filled.
    """

    colour: str
    dash: _Dash
    marker: str
    width: float
    filled: bool = True

    def mark(self) -> dict[str, Any]:
        """Return the keyword arguments of `Axes.plot` for its marks; hollow unless proposed."""
        face = self.colour if self.filled else "white"
        return {"marker": self.marker, "mfc": face, "mec": self.colour, "mew": 0.8}

    def line(self, label: str = "") -> dict[str, Any]:
        """Return the keyword arguments of `Axes.plot`."""
        labelled = {"label": label} if label else {}
        return {"color": self.colour, "ls": self.dash, "lw": self.width, "zorder": 2.0, **labelled}


def line_styles(
    labels: Sequence[str], looks: Mapping[str, MethodLook] | None = None
) -> dict[str, LineStyle]:
    """Return the line style of each filter, by the look of its method.

    Proposed methods have solid lines and filled marks, others dashed lines and hollow marks. Labels
    that name no method differ in colour, dash and marker. Later lines are thinner: where filters agree
    exactly, the earlier lines remain visible on both sides.

    Args:
        labels: Labels of filters, or names of other curves.
        looks: Looks by label, None for those of the installed methods.
    """
    names = list(dict.fromkeys(labels))
    first = min(len(names), 8)
    thick = np.linspace(1.0 + min(0.25 * first, 1.0), 1.0, first) if first > 1 else [1.3]
    widths = [*thick, *[1.0] * (len(names) - first)]
    rows = zip(names, cycle(PLAIN_COLOURS), cycle(_DASHES), cycle(_MARKERS), widths, strict=False)
    styles = {
        name: LineStyle(colour, dash, mark, float(width))
        for name, colour, dash, mark, width in rows
    }
    method_looks = find_looks(names) if looks is None else looks
    return {
        name: _style_of_look(method_looks[name], style.width)
        if method_looks.get(name) and method_looks[name].family
        else style
        for name, style in styles.items()
    }


def _style_of_look(look: MethodLook, width: float) -> LineStyle:
    """Return the line style of a look; the dash of a baseline follows its marker."""
    dash = _DASHES[1:][MARKERS.index(look.marker) % (len(_DASHES) - 1)]
    return LineStyle(look.colour, "-" if look.proposed else dash, look.marker, width, look.proposed)


def stacked_axes(n: int, height: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """Create a figure of one column with n panels below each other.

    Args:
        n: Number of panels.
        height: Height of a panel in inches.
        sharex: Whether the panels share the x axis.
    """
    figure = Figure(figsize=(COLUMN, 0.3 + height * n), layout="constrained")
    return figure, list(figure.subplots(n, 1, squeeze=False, sharex=sharex)[:, 0])


def add_legend(figure: Figure, axis: Axes, columns: int = 2) -> None:
    """Add a legend below the figure and increase the figure height by its height.

    Args:
        figure: Figure.
        axis: Panel with the labelled lines.
        columns: Number of columns at most.
    """
    handles, labels = axis.get_legend_handles_labels()
    if not labels:  # all filters are grey
        return
    is_wide = max(map(len, labels), default=0) > _WIDE_LABEL
    columns = 1 if is_wide else min(columns, len(labels))
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.1 + 0.16 * -(-len(labels) // columns))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns)


def format_axis_label(quantity: str, unit: str) -> str:
    """Format an axis label as `quantity [unit]`.

    Args:
        quantity: Quantity.
        unit: Unit, empty without one.
    """
    return f"{quantity} [{unit}]" if unit else quantity


def format_slug(text: str) -> str:
    """Replace all characters except letters and digits by underscores."""
    return "".join(c if c.isalnum() else "_" for c in text).strip("_")


def compute_run_quantiles(values: np.ndarray, q: Sequence[float]) -> np.ndarray:
    """Compute quantiles over runs.

    Shapes: values [R, T].
    """
    result = np.full((len(q), values.shape[1]), np.nan)
    finite_mask = ~np.isnan(values)
    complete = finite_mask.all(axis=0) & bool(len(values))
    partial = finite_mask.any(axis=0) & ~finite_mask.all(axis=0)
    if complete.any():
        result[:, complete] = np.quantile(values[:, complete], q, axis=0)
    if partial.any():
        result[:, partial] = np.nanquantile(values[:, partial], q, axis=0)
    return result


_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def use_log_if_wide(
    axis: Axes, side: Axis, values: Sequence[np.ndarray], narrow: bool = False
) -> None:
    """Use a logarithmic scale if the values span more than a factor of 10."""
    positive = _finite(values)
    positive = positive[positive > 0]
    if positive.size and np.quantile(positive, 0.995) > 10 * np.quantile(positive, 0.005):
        (axis.set_xscale if side is axis.xaxis else axis.set_yscale)("log")
        set_plain_ticks(side, positive, narrow)


def set_plain_ticks(side: Axis, values: Sequence[float] | np.ndarray, narrow: bool = False) -> None:
    """Label a logarithmic axis with plain numbers."""
    positive = _finite([np.asarray(values)])
    positive = positive[positive > 0]
    span = positive.max() / positive.min() if positive.size else 1.0
    if span < 10:
        side.set_major_locator(ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
    else:
        narrow = narrow or (side is side.axes.xaxis and positive.max() >= 1e4)
        factors = (1.0, 3.0) if narrow else (1.0, 2.0, 5.0)
        subs = factors if span < 100 else (1.0,)
        side.set_major_locator(ticker.LogLocator(subs=subs, numticks=4 if narrow else 8))
    side.set_major_formatter(_PlainFormatter())
    if span < 100:  # major ticks are dense enough, and minor ticks cost time
        side.set_minor_locator(ticker.NullLocator())
    side.set_minor_formatter(ticker.NullFormatter())


def format_ticks(values: Sequence[float]) -> list[str]:
    """Format the numbers of one axis in one style: all plain, or all as powers of ten."""
    sizes = [abs(value) for value in values if value]
    if not sizes or (max(sizes) < 1e5 and min(sizes) >= 1e-4):
        return [f"{value:g}" for value in values]
    return list(map(_format_power, values))


def _finite(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return all finite values in one array."""
    if not values:
        return np.empty(0)
    flat = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values])
    return flat[np.isfinite(flat)]


def _format_power(value: float) -> str:
    """Format a number as a multiple of a power of ten."""
    if not value:
        return "0"
    digits, _, exponent = f"{value:.3e}".partition("e")
    factor, power = float(digits), "10" + str(int(exponent)).translate(_SUPERSCRIPTS)
    if abs(factor) != 1:
        return f"{factor:g}·{power}"
    return power if factor > 0 else f"-{power}"


class _PlainFormatter(ticker.Formatter):
    """Tick labels in the common style of the visible ticks."""

    @override
    def __call__(self, value: float, pos: int | None = None) -> str:
        return format_ticks([value])[0]

    @override
    def format_ticks(self, values: Any) -> list[str]:
        limits = (-np.inf, np.inf) if self.axis is None else self.axis.get_view_interval()
        low, high = sorted(limits)
        tolerance = 1e-9  # the ends of an axis are ticks up to rounding
        visible = [v for v in values if low * (1 - tolerance) <= v <= high * (1 + tolerance)]
        labels = dict(zip(visible, format_ticks(visible), strict=True))
        return [labels.get(value, "") for value in values]


# --------------------------------------------------------------------------------------------------
# Figures with their captions, and the files that they are written to.


class FigureSpec(NamedTuple):
    """A figure that is drawn on request.

    Attributes:
        name: File name without folder and suffix.
        caption: Caption.
        make: Function that draws the figure.
    """

    name: str
    caption: str
    make: Callable[[], Figure]


def draw_figure(drawing: FigureSpec, formats: Sequence[str]) -> dict[str, bytes]:
    """Draw a figure in several formats. Equal figures give equal bytes.

    Args:
        drawing: Figure with its name and caption.
        formats: Suffixes of files: svg, pdf or png.

    Returns:
        Content of the file of each format.
    """
    with matplotlib.rc_context(RC):
        figure = drawing.make()
        engine = figure.get_layout_engine()
        if engine is not None:  # lay out once, because each format would repeat this costly step
            engine.execute(figure)
            figure.set_layout_engine(None)
        return {suffix: _render(figure, suffix) for suffix in formats}


def _render(figure: Figure, suffix: str) -> bytes:
    """Render a figure in one format."""
    if suffix == "png":
        return render_palette_png(figure)
    buffer, dates = io.BytesIO(), ("CreationDate", "ModDate") if suffix == "pdf" else ("Date",)
    figure.savefig(buffer, format=suffix, metadata=dict.fromkeys(dates))  # equal bytes
    return slim_svg(buffer.getvalue()) if suffix == "svg" else buffer.getvalue()


def slim_svg(drawing: bytes) -> bytes:
    """Round the coordinates of a drawing to hundredths of a point, and write each style once.

    A drawing becomes half as large. It is used as an image, since the names of its styles are its own.
    """
    rounded = _COORDINATES.sub(
        lambda match: _DIGITS.sub(lambda n: b"%g" % round(float(n[0]), 2), match[0]), drawing
    )
    paths = _LINES.sub(lambda lines: lines[0].replace(b"\nL ", b""), rounded)
    classes = {style: b"s%d" % k for k, style in enumerate(dict.fromkeys(_STYLE.findall(paths)))}
    rules = b"".join(b".%s{%s}" % (name, style) for style, name in classes.items())
    short = _STYLE.sub(lambda style: b'class="%s"' % classes[style[1]], paths)
    return _INDENT.sub(b"\n", short.replace(b"</style>", rules + b"</style>", 1))


def render_palette_png(figure: Figure) -> bytes:
    """Render a PNG with 256 colours at most, about a quarter of the size of full colour."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    image = Image.open(buffer).convert("RGB")
    image = image.quantize(256, dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
