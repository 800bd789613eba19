"""Marks, scales and sizes of all figures of a paper."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.report.journal.page_format import POINTS_PER_INCH, PageFormat
from pfbench.report.plots.axis_ticks import set_plain_ticks

ROW = 0.135  # inches, height of a row with a name
MARGIN = 0.42  # inches, axis below the rows
DAGGER = "†"

LookData = Mapping[str, Any]
Escape = Callable[[str], str]


class FigureSetting:
    """Setting of the figures of a paper.

    Args:
        page: Page format.
        escape: Function of each name that is written, the identity for PDF.
    """

    def __init__(self, page: PageFormat, escape: Escape = str) -> None:
        self.page, self.escape = page, escape

    def make_figure(self, height: float, *, is_wide: bool = False) -> Figure:
        """Create a figure of exactly one column, or of the whole text.

        Args:
            height: Height in inches.
            is_wide: Whether it is as wide as the text.
        """
        width = (self.page.text if is_wide else self.page.column) / POINTS_PER_INCH
        return Figure(figsize=(width, height), layout="constrained")

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Apply the settings of matplotlib."""
        with matplotlib.rc_context(self.page.rc()):
            yield


def mark_style(look: LookData) -> dict[str, Any]:
    """Return the arguments of `Axes.plot` for the mark of a filter: filled if it is proposed.

    Args:
        look: LookData of the filter.
    """
    colour = str(look["colour"])
    face = colour if look["proposed"] else "white"
    return {
        "marker": str(look["marker"]), "markerfacecolor": face, "markeredgecolor": colour,
        "markeredgewidth": 0.8, "color": colour,
    }  # fmt: skip


def line_style(look: LookData) -> dict[str, Any]:
    """Return the arguments of `Axes.plot` for the curve of a filter: solid if it is proposed.

    Args:
        look: LookData of the filter.
    """
    return {**mark_style(look), "linestyle": "-" if look["proposed"] else (0, (3.5, 1.5))}


def label_rows(axis: Axes, names: Sequence[str], setting: FigureSetting) -> None:
    """Write the names of rows at the left axis, the first on top.

    Args:
        axis: Panel with a row per unit of y.
        names: Names.
        setting: Setting of the figures.
    """
    axis.set_yticks(range(len(names)), [setting.escape(name) for name in names])
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.tick_params(axis="y", length=0)
    axis.grid(visible=False, axis="y")


def use_ratio_scale(axis: Axes, low: float, high: float) -> None:
    """Use a logarithmic x axis with plain numbers and a line at 1.

    Args:
        axis: Panel.
        low: Lower limit.
        high: Upper limit.
    """
    axis.set_xscale("log")
    axis.set_xlim(low, high)
    set_plain_ticks(axis.xaxis, np.array([low, high]))
    axis.axvline(1.0, color="0.25", lw=0.6, ls=(0, (2, 1.2)), zorder=1)


def ratio_limits(values: Sequence[float], most: float = 3.0) -> tuple[float, float]:
    """Return limits of an axis of ratios that outliers do not stretch.

    Args:
        values: Ratios and ends of intervals.
        most: Largest upper limit, relative to the upper quartile or 1.

    Returns:
        Lower and upper limit, with 1 between them.
    """
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
) -> bool:
    """Draw a value with its interval; outside the limits a triangle at the edge.

    Args:
        axis: Panel.
        y: Row.
        ends: Value, lower and upper end.
        look: LookData of the filter.
        limits: Limits of the x axis.

    Returns:
        True if the value is within the limits.
    """
    value, low, high = ends
    colour = str(look["colour"])
    inner = limits[0] * 1.02, limits[1] / 1.02
    start, stop = np.clip([low, high], *inner)
    axis.plot(
        [start, stop], [y, y], color=colour, lw=1.6, alpha=0.5, solid_capstyle="butt", zorder=2
    )
    if limits[0] <= value <= limits[1]:
        axis.plot([value], [y], zorder=3, **{**mark_style(look), "linestyle": "none"})
        return True
    edge = inner[1] if value > limits[1] else inner[0]
    style = {**mark_style(look), "marker": ">" if value > limits[1] else "<"}
    axis.plot([edge], [y], zorder=3, clip_on=False, **{**style, "linestyle": "none"})
    return False
