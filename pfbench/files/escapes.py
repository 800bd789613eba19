"""Text of results, names and configurations in each format of a report."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from html import escape
from typing import Any

# Labels, names of states, units and error messages come from files that another person may have
# written. Each writer escapes them with the function of its format.


# control characters of a terminal but line ends, tabs and the return of a progress bar
ESCAPED = {c: f"\\x{c:02x}" for c in (*range(32), *range(127, 160)) if chr(c) not in "\n\r\t"}


def _greek(letter: str) -> str:
    """Return the LaTeX name of a Greek letter."""
    return unicodedata.name(letter).split()[-1].lower().replace("lamda", "lambda")


# Characters that require LaTeX math mode, or that the default encoding replaces ("<", ">", "|").
_MATHS = {
    "<": "<", ">": ">", "|": "|", "∞": r"\infty", "−": "-", "±": r"\pm",
    "×": r"\times", "÷": r"\div", "·": r"\cdot",
    "°": r"^\circ", "′": "'", "″": "''", "≥": r"\ge", "≤": r"\le", "≈": r"\approx",
    "≠": r"\ne", "→": r"\to", "√": r"\surd",
    "∑": r"\sum", "∂": r"\partial", "∈": r"\in", "‖": r"\|", "µ": r"\mu",
    **{sign: f"^{text}" for sign, text in zip("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789", strict=True)},
    **{sign: f"_{text}" for sign, text in zip("₀₁₂₃₄₅₆₇₈₉", "0123456789", strict=True)},
    **{letter: f"\\{_greek(letter)}" for letter in "αβγδεζηθικλμνξπρστυφχψω"},
    **{letter: f"\\{_greek(letter).capitalize()}" for letter in "ΓΔΘΛΞΠΣΥΦΨΩ"},
}  # fmt: skip
_LATEX = str.maketrans({
    "\\": r"\textbackslash ", "_": r"\_", "%": r"\%", "$": r"\$", "#": r"\#", "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde ", "^": r"\textasciicircum ", "&": r"\&", "–": "--",
    "—": "---", "…": r"\dots ", "“": "``", "”": "''",
    "‘": "`", "’": "'", "\u00a0": "~", "\u2009": r"\,", "\u202f": r"\,",
    "ß": r"\ss{}", "ø": r"\o{}", "Ø": r"\O{}",
    **{sign: f"${text}$" for sign, text in _MATHS.items()},
})  # fmt: skip
_ACCENTS = dict(zip("\u0300\u0301\u0302\u0303\u0308\u030a\u030c\u0327", "`'^~\"rvc", strict=True))
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f]")

# Markdown: signs that are syntax wherever they are; `_` only at the edge of a word; the start of a block
_SIGNS = re.compile(r"[\\`*|~$]|(?<!\w)_|_(?!\w)|(?<=\])[(\[]|&(?=#?\w+;)")
_BLOCK = re.compile(r"(\s*)(\d*)([#>=]|[-+](?=\s|$|-)|(?<=\d)[.)](?=\s|$)|\[(?=[^\]]*\]:))")

# a spreadsheet computes a cell that starts with one of these signs, also in their wide forms
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")
_NUMBER = re.compile(r"[-+]?(\d[\d.,]*|\.\d+)(e[-+]?\d+)?( ?%)?|[-+]?(inf|nan)", re.IGNORECASE)


def escape_html(text: str) -> str:
    """Escape a text for HTML, in content and in quoted attributes."""
    return escape(_CONTROL.sub("\ufffd", text))


def escape_markdown(text: str) -> str:
    """Escape a text for one line of Markdown, in a paragraph, a list or a table.

    A line break becomes a space. HTML, emphasis, code, links, images, formulas and the start of a
    block lose their meaning.
    """
    line = _CONTROL.sub("\ufffd", " ".join(text.splitlines()))
    line = _SIGNS.sub(lambda sign: "&amp;" if sign[0] == "&" else f"\\{sign[0]}", line)
    if block := _BLOCK.match(line):
        line = f"{block[1]}{block[2]}\\{line[block.start(3) :]}"
    return re.sub(r"<(?=[A-Za-z/!?])", "&lt;", line)  # others cannot start a tag or a link


def escape_code_block(text: str) -> str:
    """Escape a text for a Markdown block between lines of three backticks."""
    return re.sub(r"`{3,}|~{3,}", "'''", text)


def escape_latex(text: str) -> str:
    """Escape a text for LaTeX, which stops at unsupported characters.

    A bracket or an asterisk at the start would be an argument of the line break before it.
    """
    line = _CONTROL.sub("", " ".join(text.splitlines())).replace("\t", " ")
    plain = re.sub(r"[^\x00-\x7f]", _escape_character, line.translate(_LATEX))
    plain = re.sub(r"^(\s*)([\[*])", r"\1{\2}", plain)
    return plain.replace(r"$-$$\infty$", r"$-\infty$")


def escape_csv(text: str) -> str:
    """Escape a text for a cell of a CSV file, which a spreadsheet may open.

    A text that a spreadsheet would compute gets an apostrophe; numbers are unchanged. A line break
    becomes a space. Quotes and separators are left to the writer of the file.
    """
    is_formula = text.startswith(_FORMULA) and not _NUMBER.fullmatch(text)
    line = re.sub(r"[\r\n\x00]", " ", text)
    return f"'{line}" if is_formula else line


def _escape_character(sign: re.Match[str]) -> str:
    """Return an accent command, or the code point of other characters."""
    parts = unicodedata.normalize("NFD", sign[0])
    if len(parts) == 2 and parts[0].isascii() and parts[1] in _ACCENTS:
        return rf"\{_ACCENTS[parts[1]]}{{{parts[0]}}}"
    return f"(U+{ord(sign[0]):04X})"


# --------------------------------------------------------------------------------------------------
# Lines of Markdown, for studies that write their own page.

WIDTH = 130


def markdown_row(*cells: Any) -> str:
    """Format a row of a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def markdown_head(*cells: str) -> list[str]:
    """Format the first two lines of a table."""
    return [markdown_row(*cells), "|" + " --- |" * len(cells)]


def markdown_paragraph(text: str) -> list[str]:
    """Wrap a text and add an empty line."""
    return [*textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False), ""]


def markdown_bullets(*texts: str) -> list[str]:
    """Format a list with an item per text."""
    lines = [
        textwrap.wrap(f"- {text}", WIDTH, subsequent_indent="  ", break_on_hyphens=False)
        for text in texts
    ]
    return [*(line for item in lines for line in item), ""]
