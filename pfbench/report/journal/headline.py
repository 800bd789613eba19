"""Static figure of a published study: the leaderboard, drawn as for a paper."""

from __future__ import annotations

import io
from typing import Any

import matplotlib

from pfbench.report.journal.figure_style import FigureSetting
from pfbench.report.journal.page_format import find_page_format
from pfbench.report.journal.ratio_figures import plot_leaderboard
from pfbench.report.journal.study_pack import Pack

HEADLINE = "headline.svg"
_WIDTH = "150mm"
_SVG: Any = {"svg.hashsalt": "pfbench", "svg.fonttype": "none"}  # equal bytes, text as text


def render_headline(pack: Pack) -> bytes:
    """Draw the error of each filter relative to the baseline as SVG. Equal data give equal bytes.

    Args:
        pack: Data of the page.
    """
    setting, buffer = FigureSetting(find_page_format(width=_WIDTH)), io.BytesIO()
    with setting.applied(), matplotlib.rc_context(_SVG):
        plot_leaderboard(pack, setting).savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
