"""Static figure of a published study: the leaderboard, drawn as for a paper."""

from __future__ import annotations

import io
import re
from typing import Any

import matplotlib

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.figure_style import FigureSetting
from pfbench.report.journal.page_format import find_page_format
from pfbench.report.journal.ratio_figures import plot_leaderboard
from pfbench.report.journal.study_pack import Pack

HEADLINE = "headline.svg"
_WIDTH = "150mm"
_NUMBER = re.compile(r"(?<![\w#.])-?\d+\.\d+(?!\w)")  # not in names
_CLOSE = 1e-3  # units of the drawing
_SVG: Any = {"svg.hashsalt": "pfbench", "svg.fonttype": "none"}  # equal bytes, text as text


def write_headline(pack: Pack, folder: RecordedFolder) -> bool:
    """Write the figure, or remove it if no filter has an error. A stored drawing that is equal stays.

    Args:
        pack: Data of the page.
        folder: Folder of the report.

    Returns:
        Whether there is a figure.
    """
    opening = next(iter(pack["views"].values()))
    if all(row["ratio"] is None for row in opening["rows"]):
        folder.remove(HEADLINE)
        return False
    drawing, file = render_headline(pack), folder.path / HEADLINE
    stored = file.read_bytes() if file.is_file() else b""
    folder.write(HEADLINE, stored if stored and is_equal_drawing(stored, drawing) else drawing)
    return True


def is_equal_drawing(first: bytes, second: bytes) -> bool:
    """Return whether two SVG drawings differ in their numbers by less than 0.001 at most.

    The last digit of a coordinate differs between processors.

    Args:
        first: SVG.
        second: SVG.
    """
    texts = [_NUMBER.sub("#", drawing.decode()) for drawing in (first, second)]
    if texts[0] != texts[1]:
        return False
    numbers = zip(*(_NUMBER.findall(drawing.decode()) for drawing in (first, second)), strict=True)
    return all(abs(float(a) - float(b)) < _CLOSE for a, b in numbers)


def render_headline(pack: Pack) -> bytes:
    """Draw the error of each filter relative to the baseline as SVG. Equal data give equal bytes.

    Args:
        pack: Data of the page.
    """
    setting, buffer = FigureSetting(find_page_format(width=_WIDTH)), io.BytesIO()
    with setting.applied(), matplotlib.rc_context(_SVG):
        plot_leaderboard(pack, setting).savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
