"""Figures with their captions, and the files that they are written to."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.figure import Figure

from pfbench.report.plots.plotting import RC, render_palette_png


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


def write_figure(drawing: FigureSpec, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw a figure and write a file per format.

    Args:
        drawing: Figure.
        folder: Target folder.
        formats: File formats, svg or png.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = draw_figure(drawing, formats)
    for suffix, content in contents.items():
        (folder / f"{drawing.name}.{suffix}").write_bytes(content)
    return [folder / f"{drawing.name}.{suffix}" for suffix in contents]


def _render(figure: Figure, suffix: str) -> bytes:
    """Render a figure in one format."""
    if suffix == "png":
        return render_palette_png(figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})  # equal bytes
    return buffer.getvalue()
