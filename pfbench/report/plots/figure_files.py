"""Figures with their captions, and the files that they are written to."""

from __future__ import annotations

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


def write_figure(drawing: FigureSpec, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Draw a figure and write a file per format. Equal figures give equal bytes.

    Args:
        drawing: Figure.
        folder: Target folder.
        formats: File formats, svg or png.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(RC):
        figure = drawing.make()
        engine = figure.get_layout_engine()
        if engine is not None:  # lay out once, because each format would repeat this costly step
            engine.execute(figure)
            figure.set_layout_engine(None)
        paths = [folder / f"{drawing.name}.{suffix}" for suffix in formats]
        for path, suffix in zip(paths, formats, strict=True):
            if suffix == "png":
                path.write_bytes(render_palette_png(figure))
            else:
                figure.savefig(path, format="svg", metadata={"Date": None})  # equal bytes
    return paths
