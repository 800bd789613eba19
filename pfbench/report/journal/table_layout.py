"""Tables of a paper: cells with known widths, and the LaTeX of a table that fits."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from functools import cache
from itertools import accumulate, chain
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.ft2font import FT2Font, LoadFlags

from pfbench.files.escapes import escape_latex

SIZE, INTERVAL_SIZE = 8.0, 6.0  # of entries and of intervals, points
THIN_SPACE = SIZE / 6
_SEPARATIONS = (6.0, 5.0, 4.0, 3.0, 2.4)  # candidates of \tabcolsep, points
_SLACK = 1.5  # points of rounding
LINE = 9.6  # points, distance of rows


class LatexCell(NamedTuple):
    """Entry of a table.

    Attributes:
        tex: LaTeX.
        width: Width in points.
        span: Number of columns.
        alignment: Alignment over several columns.
    """

    tex: str
    width: float
    span: int = 1
    alignment: str = "c"


class Column(NamedTuple):
    """Column of a table.

    Attributes:
        spec: Column type of LaTeX.
        is_close: Whether a thin space separates it from the column before.
    """

    spec: str
    is_close: bool = False


class LatexTable(NamedTuple):
    """Table before its width is known.

    Attributes:
        name: Name of the file and the label.
        caption: Caption, LaTeX.
        columns: Columns.
        head: Rows of the head.
        groups: Groups of rows, with a rule between them.
    """

    name: str
    caption: str
    columns: Sequence[Column]
    head: Sequence[Sequence[LatexCell]]
    groups: Sequence[Sequence[Sequence[LatexCell]]]

    @property
    def rows(self) -> int:
        """Number of rows with the head."""
        return len(self.head) + sum(map(len, self.groups))


def text_cell(text: str, *, size: float = SIZE, is_bold: bool = False, span: int = 1) -> LatexCell:
    """Return a cell with a text, which is escaped."""
    tex = rf"\textbf{{{escape_latex(text)}}}" if is_bold else escape_latex(text)
    if size != SIZE and text:
        tex = rf"{{\fontsize{{{size:g}}}{{{SIZE:g}}}\selectfont {tex}}}"
    return LatexCell(tex, text_width(text, size, is_bold=is_bold), span)


def measure_table(table: LatexTable, separation: float) -> float:
    r"""Compute the width of a table."""
    widths = [0.0] * len(table.columns)
    gaps = [THIN_SPACE if column.is_close else 2 * separation for column in table.columns]
    placed = [
        (start, cell)
        for row in (*table.head, *chain.from_iterable(table.groups))
        for start, cell in zip(accumulate((c.span for c in row), initial=0), row, strict=False)
    ]
    for start, cell in sorted(
        placed, key=lambda item: item[1].span > 1
    ):  # those of one column first
        inside = sum(widths[start : start + cell.span]) + sum(gaps[start + 1 : start + cell.span])
        widths[start + cell.span - 1] += max(0.0, cell.width - inside)
    return sum(widths) + sum(gaps[1:])


def fit_table(table: LatexTable, width: float) -> float | None:
    """Return the largest separation of columns with which a table fits, or None."""
    fitting = (s for s in _SEPARATIONS if measure_table(table, s) <= width - _SLACK)
    return next(fitting, None)


def format_table(table: LatexTable, separation: float, *, is_wide: bool) -> str:
    r"""Format a table as LaTeX.

    Returns the environment `table`, for booktabs, siunitx and xcolor.
    """
    star = "*" if is_wide else ""
    specs = "".join((r"@{\,}" if column.is_close else "") + column.spec for column in table.columns)
    head = [_format_row(row) for row in table.head]
    body = "\n\\midrule\n".join(
        "\n".join(map(_format_row, group)) for group in table.groups if group
    )
    lines = [
        f"% {table.rows} rows, {measure_table(table, separation):.1f} pt wide; needs booktabs, siunitx, xcolor",
        rf"\begin{{table{star}}}[t]\centering",
        rf"\caption{{{table.caption}}}",
        rf"\label{{tab:{table.name}}}",
        rf"\fontsize{{{SIZE:g}}}{{{LINE:g}}}\selectfont\setlength{{\tabcolsep}}{{{separation:g}pt}}%",
        rf"\begin{{tabular}}{{@{{}}{specs}@{{}}}}",
        r"\toprule",
        *head,
        r"\midrule",
        body,
        r"\bottomrule",
        r"\end{tabular}",
        rf"\end{{table{star}}}",
    ]
    return "\n".join(lines) + "\n"


def _format_row(row: Sequence[LatexCell]) -> str:
    """Format a row."""
    cells = [
        cell.tex
        if cell.span == 1
        else rf"\multicolumn{{{cell.span}}}{{{cell.alignment}}}{{{cell.tex}}}"
        for cell in row
    ]
    return " & ".join(cells) + r" \\"


_FONTS = {False: "STIXGeneral.ttf", True: "STIXGeneralBol.ttf"}
_OTHER_WIDTHS = {"%": 0.833}  # in which Times differs
_UNITS = 1000  # size at which the glyphs are measured, in points


@cache
def _font(is_bold: bool) -> FT2Font:
    """Open a font that matplotlib contains."""
    font = FT2Font(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / _FONTS[is_bold]))
    font.set_size(_UNITS, 72)
    return font


@cache
def _letter_width(letter: str, is_bold: bool) -> float:
    """Return the advance of a letter, or of what `escape_latex` writes for it, in units of the size."""
    if letter in _OTHER_WIDTHS:
        return _OTHER_WIDTHS[letter]
    font = _font(is_bold)
    base = unicodedata.normalize("NFD", letter)[0]
    if not font.get_char_index(ord(base)):
        return sum(_letter_width(sign, is_bold) for sign in f"(U+{ord(letter):04X})")
    glyph = font.load_char(ord(base), LoadFlags.NO_HINTING)
    return glyph.linearHoriAdvance / 65536 / _UNITS  # a number with 16 binary places


def text_width(text: str, size: float, *, is_bold: bool = False) -> float:
    """Compute the width of a text on one line, without kerning.

    Args:
        text: Text before its escape for LaTeX.
        size: Size of the font in points.
        is_bold: Whether it is bold.

    Returns:
        Width in the unit of the size.
    """
    return size * sum(_letter_width(letter, is_bold) for letter in text)
