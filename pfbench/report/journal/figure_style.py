"""Marks, scales and sizes of the figures of a paper, and the page formats of journals."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.results.plotting import set_plain_ticks

ROW = 0.135  # inches, height of a row with a name
MARGIN = 0.42  # inches, axis below the rows
DAGGER = "†"

_LEGEND_ROW = 0.15  # inches
_WIDE = 4.0  # inches, width from which a legend has four columns

LookData = Mapping[str, Any]
Escape = Callable[[str], str]
LegendEntries = Sequence[tuple[str, Mapping[str, Any]]]  # names and arguments of `Axes.plot`


class FigureSetting:
    """Setting of the figures of a paper."""

    def __init__(self, page: PageFormat, escape: Escape = str) -> None:
        self.page, self.escape = page, escape

    def make_figure(self, height: float, *, is_wide: bool = False) -> Figure:
        """Create a figure of exactly one column, or of the whole text."""
        width = (self.page.text if is_wide else self.page.column) / POINTS_PER_INCH
        return Figure(figsize=(width, height), layout="constrained")

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Apply the settings of matplotlib."""
        with matplotlib.rc_context(self.page.rc()):
            yield


def mark_style(look: LookData) -> dict[str, Any]:
    """Return the arguments of `Axes.plot` for the mark of a filter: filled if it is proposed."""
    colour = str(look["colour"])
    face = colour if look["proposed"] else "white"
    return {
        "marker": str(look["marker"]), "markerfacecolor": face, "markeredgecolor": colour,
        "markeredgewidth": 0.8, "color": colour,
    }  # fmt: skip


def line_style(look: LookData) -> dict[str, Any]:
    """Return the arguments of `Axes.plot` for the curve of a filter: solid if it is proposed."""
    return {**mark_style(look), "linestyle": "-" if look["proposed"] else (0, (3.5, 1.5))}


def break_name(name: str, page: PageFormat) -> str:
    """Break a long name into lines that leave room for an axis."""
    return "\n".join(textwrap.wrap(name, int(page.column / page.tick_size)))


def measure_rows(names: Sequence[str], page: PageFormat) -> float:
    """Return the height of rows with names, in inches."""
    lines = [break_name(name, page).count("\n") for name in names]
    return ROW * max(len(names), 2) * (1 + 0.7 * max(lines, default=0))


def label_rows(axis: Axes, names: Sequence[str], setting: FigureSetting) -> None:
    """Write the names of rows at the left axis, the first on top."""
    texts = [setting.escape(break_name(name, setting.page)) for name in names]
    axis.set_yticks(range(len(names)), texts, linespacing=0.9)
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.tick_params(axis="y", length=0)
    axis.grid(visible=False, axis="y")


def use_ratio_scale(axis: Axes, low: float, high: float) -> None:
    """Use a logarithmic x axis with plain numbers and a line at 1."""
    axis.set_xscale("log")
    axis.set_xlim(low, high)
    set_plain_ticks(axis.xaxis, np.array([low, high]))
    axis.axvline(1.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)


def ratio_limits(values: Sequence[float], most: float = 3.0) -> tuple[float, float]:
    """Return limits of an axis of ratios that outliers do not stretch."""
    finite = np.array([v for v in values if np.isfinite(v) and v > 0] or [1.0])
    quartiles = np.quantile(finite, [0.25, 0.75])
    low = max(float(finite.min()), min(1.0, float(quartiles[0])) / most)
    high = min(float(finite.max()), max(1.0, float(quartiles[1])) * most)
    return min(low, 0.95) / 1.08, max(high, 1.05) * 1.08


def draw_interval(
    axis: Axes,
    y: float,
    ends: tuple[float, float, float],
    look: LookData,
    limits: tuple[float, float],
) -> None:
    """Draw a value with its interval; outside the limits a triangle at the edge."""
    value, *bounds = ends
    inner = limits[0] * 1.02, limits[1] / 1.02
    bar: Any = {"color": str(look["colour"]), "lw": 1.6, "alpha": 0.5, "solid_capstyle": "butt"}
    axis.plot(np.clip(bounds, *inner), [y, y], zorder=2, **bar)
    style, is_inside = {**mark_style(look), "linestyle": "none"}, limits[0] <= value <= limits[1]
    if not is_inside:
        style["marker"] = ">" if value > limits[1] else "<"
        value = np.clip(value, *inner)
    axis.plot([value], [y], zorder=3, clip_on=is_inside, **style)


def add_legend_below(axis: Axes, entries: LegendEntries, setting: FigureSetting) -> None:
    """Add a legend below the figure of some axes, and make the figure higher by it; none without names.

    It has as many columns as fit.
    """
    if not entries:
        return
    figure: Any = axis.figure
    handles = [axis.plot([], [], **style)[0] for _, style in entries]
    names = [setting.escape(name) for name, _ in entries]
    width, height = figure.get_size_inches()
    for columns in range(min(len(names), 4 if width > _WIDE else 3), 0, -1):
        legend = figure.legend(
            handles, names, loc="outside lower center", ncols=columns, handlelength=2.4
        )
        figure.set_size_inches(width, height + _LEGEND_ROW * -(-len(names) // columns))
        figure.draw_without_rendering()
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()


# --------------------------------------------------------------------------------------------------
# Page formats of journals: widths of columns, fonts and document classes.

POINTS_PER_INCH = 72.27  # TeX points
# signs of powers of ten at axes, which LaTeX does not know
SUPERSCRIPTS = {
    ord(sign): rf"\textsuperscript{{{digit}}}"
    for sign, digit in zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True)
}
_POINTS_PER_MM = POINTS_PER_INCH / 25.4
_NARROWEST, _WIDEST = 60 * _POINTS_PER_MM, 400 * _POINTS_PER_MM


class PageFormat(NamedTuple):
    """Format of the pages of a journal. Lengths are TeX points: 72.27 per inch.

    Attributes:
        name: Name of the journal or the width.
        column: Width of a column.
        text: Width of both columns.
        height: Height of the text.
        serif: Font of figures: Times-like, or without serifs.
        size: Size of text in figures.
        tick_size: Size of tick labels in figures.
        head: Lines of LaTeX from the document class to its packages.
        bibliography: Style of BibTeX.
    """

    name: str
    column: float
    text: float
    height: float
    serif: bool
    size: float
    tick_size: float
    head: str
    bibliography: str

    @property
    def has_columns(self) -> bool:
        """Number of columns: true for two."""
        return self.text > self.column

    def rc(self) -> Any:
        """Return the settings of matplotlib."""
        family = "STIXGeneral" if self.serif else "DejaVu Sans"
        return {
            "font.family": [family, "DejaVu Sans"],  # STIX lacks some superscripts
            "mathtext.fontset": "stix" if self.serif else "dejavusans",
            "font.size": self.size,
            "axes.labelsize": self.size,
            "axes.titlesize": self.size,
            "axes.titlelocation": "left",
            "axes.titley": 1.0,
            "legend.fontsize": self.tick_size,
            "legend.frameon": False,
            "xtick.labelsize": self.tick_size,
            "ytick.labelsize": self.tick_size,
            "axes.linewidth": 0.5,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.linewidth": 0.4,
            "grid.color": "0.9",
            "xtick.major.width": 0.5,
            "ytick.major.width": 0.5,
            "xtick.minor.width": 0.4,
            "ytick.minor.width": 0.4,
            "lines.linewidth": 0.9,
            "lines.markersize": 3.5,
            "pdf.fonttype": 42,  # TrueType: journals refuse Type 3
            "ps.fonttype": 42,
            "text.parse_math": False,  # a name may contain $ as a plain character
            "pgf.texsystem": "pdflatex",
            "pgf.rcfonts": False,  # the fonts of the document
            "pgf.preamble": "\n".join(
                rf"\DeclareUnicodeCharacter{{{sign:04X}}}{{{code}}}"
                for sign, code in SUPERSCRIPTS.items()
            ),
            "figure.constrained_layout.h_pad": 0.02,
            "figure.constrained_layout.w_pad": 0.02,
        }


def _own_geometry(text: float, gap: float, height: float) -> str:
    """Return the package that sets the widths of an article."""
    return (
        rf"\usepackage[textwidth={text:.3f}pt,columnsep={gap:.3f}pt,"
        rf"textheight={height:g}pt,a4paper]{{geometry}}"
    )


_TIMES = r"\usepackage{mathptmx}"
_ELSEVIER = (90 * _POINTS_PER_MM, 190 * _POINTS_PER_MM, 690.0)
_SPRINGER = (84 * _POINTS_PER_MM, 174 * _POINTS_PER_MM, 660.0)
JOURNALS = {
    "ieee": PageFormat(
        "ieee", 252.0, 516.0, 690.0, True, 8.0, 7.0,
        r"\documentclass[journal]{IEEEtran}" "\n" r"\usepackage{cite}", "IEEEtran",
    ),
    "elsevier": PageFormat(
        "elsevier", *_ELSEVIER, False, 7.0, 6.5,
        "\\documentclass[final,5p,times,twocolumn]{elsarticle}\n"
        f"\\geometry{{textwidth={_ELSEVIER[1]:.3f}pt,"
        f"columnsep={_ELSEVIER[1] - 2 * _ELSEVIER[0]:.3f}pt,textheight=690pt}}\n"
        "\\biboptions{sort&compress}\n\\journal{}",
        "elsarticle-num",
    ),
    "springer": PageFormat(
        "springer", *_SPRINGER, False, 8.0, 7.0,
        "\\documentclass[twocolumn]{article}\n"
        + _own_geometry(_SPRINGER[1], _SPRINGER[1] - 2 * _SPRINGER[0], 660)
        + "\n" + _TIMES,
        "unsrt",
    ),
}  # fmt: skip


def find_page_format(journal: str = "", width: str = "") -> PageFormat:
    """Return the format of a journal, or that of one column of a given width.

    Args:
        journal: Name of a journal.
        width: Width with its unit, such as "120mm" or "345pt" (TeX points).

    Raises:
        ValueError: If not exactly one of both is given, or its value is not valid.
    """
    if bool(journal) == bool(width):
        got = f"journal={journal} and width={width}" if journal else "none of them"
        raise ValueError(
            f"journal or width must be set, got {got}. Use journal={'|'.join(JOURNALS)} or width=120mm."
        )
    if journal:
        require(
            journal in JOURNALS,
            "journal",
            f"be one of {', '.join(JOURNALS)}",
            journal,
            "Use width=120mm for other pages.",
        )
        return JOURNALS[journal]
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(mm|pt)", width)
    points = float(match[1]) * (_POINTS_PER_MM if match[2] == "mm" else 1.0) if match else 0.0
    require(
        _NARROWEST <= points <= _WIDEST,
        "width",
        "be 60mm to 400mm, in mm or pt",
        width,
        "Use width=120mm or width=345pt.",
    )
    head = f"\\documentclass{{article}}\n{_own_geometry(points, 10, 640)}\n{_TIMES}"
    return PageFormat(width, points, points, 640.0, False, 8.0, 7.0, head, "unsrt")
