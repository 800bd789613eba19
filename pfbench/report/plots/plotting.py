"""Common parts of figures: size, palette, line styles, legends, quantiles over runs."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image

COLUMN = 3.5  # inches, width of a column of print
INSTANTS = 180  # points of a curve at most: a column of print is 250 points wide
SMALL = 6.5  # points, smallest font size
LETTER = 0.62 * SMALL  # points, mean width of a letter of that size
_WIDE_LABEL = 24  # letters; a legend with longer labels has a single column
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
    "svg.hashsalt": "pfbench",  # SVG identifiers are random otherwise
    "svg.fonttype": "none",  # text stays text, which is searchable and smaller than outlines
}
# Okabe and Ito 2008, without yellow, which has too little contrast on white.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00")
# Tints and shades of one blue in equal steps of lightness, which stay distinct in grey print.
SHADES = (
    "#dfedf5", "#aad0e5", "#74b2d5", "#3e94c5", "#0474b3", "#005788", "#003c5d", "#002235",
)  # fmt: skip
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
        quiet: Whether the filter is drawn in grey and without a label.
        instants: Points of a curve over time at most.
    """

    colour: str
    dash: _Dash
    marker: str
    width: float
    quiet: bool = False
    instants: int = INSTANTS

    def line(self, label: str = "") -> dict[str, Any]:
        """Return the keyword arguments of `Axes.plot`, with the label unless the filter is grey."""
        labelled = {} if self.quiet or not label else {"label": label}
        order = 1.5 if self.quiet else 2.0
        return {
            "color": self.colour,
            "ls": self.dash,
            "lw": self.width,
            "zorder": order,
            **labelled,
        }


def line_styles(labels: Sequence[str]) -> dict[str, LineStyle]:
    """Assign each filter a colour, a dash and a marker.

    All three differ for neighbours, so that any of them suffices in grey print. Later lines are
    thinner: where filters agree exactly, the earlier lines remain visible on both sides.
    """
    names = list(dict.fromkeys(labels))
    first = min(len(names), 8)
    widths = [1.3]
    if first > 1:
        thick = np.linspace(1.0 + min(0.25 * first, 1.0), 1.0, first)
        widths = [*thick, *[1.0] * (len(names) - first)]
    rows = zip(names, cycle(_COLOURS), cycle(_DASHES), cycle(_MARKERS), widths, strict=False)
    return {
        name: LineStyle(colour, dash, mark, float(width))
        for name, colour, dash, mark, width in rows
    }


def mute_others(style: Mapping[str, LineStyle], highlighted: Iterable[str]) -> dict[str, LineStyle]:
    """Return the line styles with all filters grey except the highlighted ones.

    Args:
        style: Line styles by label.
        highlighted: Labels that keep their style.
    """
    selection = set(highlighted)
    return {
        label: look._replace(instants=2 * INSTANTS // 5)
        if label in selection
        else look._replace(colour="0.78", dash="-", width=0.6, quiet=True, instants=INSTANTS // 5)
        for label, look in style.items()
    }


def stacked_axes(n: int, height: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """Create a figure of one column with n panels below each other.

    Args:
        n: Number of panels.
        height: Height of a panel in inches.
        sharex: Whether the panels share the x axis.
    """
    figure = Figure(figsize=(COLUMN, 0.3 + height * n), layout="constrained")
    return figure, list(figure.subplots(n, 1, squeeze=False, sharex=sharex)[:, 0])


def build_padded_layout() -> ConstrainedLayoutEngine:
    """Return a layout engine with padding for labels of full width."""
    return ConstrainedLayoutEngine(w_pad=0.1)


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


def render_palette_png(figure: Figure) -> bytes:
    """Render a PNG with 97 colours, about a quarter of the size of full colour."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    image = Image.open(buffer).convert("RGB")
    image = image.quantize(palette=_palette(), dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


@cache
def _palette() -> Image.Image:
    """Build the palette: filter colours in steps to white, the shades of maps, and greys."""
    colours = [*(colour for colour in _COLOURS if colour != "#000000"), "#B35900"]
    pure = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours])
    fractions = np.linspace(0, 1, 8, endpoint=False)[:, None]
    tints = pure[:, None] + (255 - pure[:, None]) * fractions
    shades = np.array([[int(shade[i : i + 2], 16) for i in (1, 3, 5)] for shade in SHADES])
    # Greys are so dense that no tint is the nearest colour of a grey.
    greys = np.repeat(np.minimum(np.arange(0, 257, 8), 255)[:, None], 3, axis=1)
    steps = np.round(np.concatenate([tints.reshape(-1, 3), shades, greys])).astype(np.uint8)
    padding = np.repeat(steps[-1:], 256 - len(steps), axis=0)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([steps, padding]).tobytes())
    return palette


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


def select_indices(size: int, most: int = INSTANTS) -> np.ndarray:
    """Select at most `most` evenly spaced indices of `size`.

    Args:
        size: Number of elements.
        most: Number of indices at most.
    """
    return np.unique(np.linspace(0, size - 1, min(size, most)).astype(int))


def compute_run_quantiles(values: np.ndarray, q: Sequence[float]) -> np.ndarray:
    """Compute quantiles over runs.

    Args:
        values: Values, [R, T]. NaN marks a missing value.
        q: Probabilities, n of them.

    Returns:
        Quantiles, [n, T]. NaN where all runs are missing.
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


def compute_jitter(n: int) -> np.ndarray:
    """Return n deterministic offsets [n] from multiples of the golden ratio."""
    return 0.4 * ((np.arange(n) * 0.6180339887) % 1 - 0.5)
