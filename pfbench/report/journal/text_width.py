"""Widths of text in a table, from the metrics of a font with the widths of Times."""

from __future__ import annotations

import unicodedata
from functools import cache
from pathlib import Path

import matplotlib
from matplotlib.ft2font import FT2Font, LoadFlags

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
