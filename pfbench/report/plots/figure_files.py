"""Figures with their captions, and the files that they are written to."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from pfbench.report.looks import installed_colours
from pfbench.report.plots.plotting import PLAIN_COLOURS, RC, SHADES


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
        drawing: Figure.
        formats: File formats, svg or png.

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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})  # equal bytes
    return buffer.getvalue()


def render_palette_png(figure: Figure) -> bytes:
    """Render a PNG with 256 colours at most, about a quarter of the size of full colour."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    image = Image.open(buffer).convert("RGB")
    image = image.quantize(palette=_palette(), dither=Image.Dither.NONE)
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


@cache
def _palette() -> Image.Image:
    """Build the palette: colours of methods in steps to white, the shades of maps, and greys."""
    plain = [colour for colour in PLAIN_COLOURS if colour != "#000000"]
    colours = list(dict.fromkeys([*installed_colours(), *plain, "#B35900"]))
    pure = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours])
    fractions = np.linspace(0, 1, 5, endpoint=False)[:, None]
    tints = (pure[:, None] + (255 - pure[:, None]) * fractions).reshape(-1, 3)
    tints = tints[np.ptp(tints, axis=1) > 16]  # paler ones would be nearest to greys
    shades = np.array([[int(shade[i : i + 2], 16) for i in (1, 3, 5)] for shade in SHADES])
    # Greys are so dense that no tint is the nearest colour of a grey.
    greys = np.repeat(np.minimum(np.arange(0, 257, 8), 255)[:, None], 3, axis=1)
    steps = np.round(np.concatenate([tints, shades, greys])).astype(np.uint8)
    padding = np.repeat(steps[-1:], 256 - len(steps), axis=0)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([steps, padding]).tobytes())
    return palette
