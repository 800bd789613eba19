"""Formats of tables: HTML, Markdown, LaTeX, CSV, and numbers with three digits."""

from __future__ import annotations

import re
import unicodedata
from html import escape
from typing import Any

import numpy as np
import pandas as pd


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


def format_html(table: pd.DataFrame) -> str:
    """Format a table as HTML, with classes for the alignment.

    Optional end tags are left out, because they would be most of a page of tables.
    """
    numeric = [_is_number(table[name]) for name in table]
    head = "".join(
        f"<th{' class=number' if right else ''}>{escape(str(name))}"
        for name, right in zip(table, numeric, strict=True)
    )
    kinds = ["<td>" if right else "<td class=t>" for right in numeric]
    body = "\n".join(
        "<tr>"
        + "".join(
            kind + escape(format_number(value), quote=False)
            for kind, value in zip(kinds, values, strict=True)
        )
        for values in table.itertuples(index=False)
    )
    rows = f"<thead><tr>{head}</thead>\n<tbody>\n{body}\n</tbody>"
    return f'<div class="wide"><table class="plain">\n{rows}\n</table></div>'


def format_markdown(table: pd.DataFrame) -> str:
    """Format a table as Markdown, with columns padded to equal width."""
    cells = [
        [str(name) for name in table],
        *([format_number(v) for v in row] for row in table.itertuples(index=False)),
    ]
    cells = [[text.replace("|", r"\|") for text in row] for row in cells]
    width = [max(3, *(len(row[j]) for row in cells)) for j in range(len(table.columns))]
    right = [_is_number(table[name]) for name in table]
    rows = [
        "| "
        + " | ".join(
            t.rjust(w) if r else t.ljust(w) for t, w, r in zip(row, width, right, strict=True)
        )
        + " |"
        for row in cells
    ]
    rule = (
        "|"
        + "|".join("-" * (w + 1) + (":" if r else "-") for w, r in zip(width, right, strict=True))
        + "|"
    )
    return "\n".join([rows[0], rule, *rows[1:]])


def format_latex(table: pd.DataFrame, note: str = "") -> str:
    """Format a table as a booktabs tabular.

    Args:
        table: Table.
        note: Note below the last rule.
    """
    layout = "".join("r" if _is_number(table[name]) else "l" for name in table)
    rows = [
        [str(name) for name in table],
        *([format_number(v) for v in row] for row in table.itertuples(index=False)),
    ]
    lines = [" & ".join(map(_tex, row)) + r" \\" for row in rows]
    body = ["\\toprule", lines[0], "\\midrule", *lines[1:], "\\bottomrule"]
    if note:
        body.append(rf"\multicolumn{{{len(table.columns)}}}{{l}}{{\footnotesize {_tex(note)}}} \\")
    return "\n".join([rf"\begin{{tabular}}{{{layout}}}", *body, r"\end{tabular}", ""])


def _tex(text: str) -> str:
    """Escape a text for LaTeX, which stops at unsupported characters."""
    return re.sub(r"[^\x00-\x7f]", _escape_character, text.translate(_LATEX)).replace(
        r"$-$$\infty$", r"$-\infty$"
    )


def _escape_character(sign: re.Match[str]) -> str:
    """Return an accent command, or the code point of other characters."""
    parts = unicodedata.normalize("NFD", sign[0])
    if len(parts) == 2 and parts[0].isascii() and parts[1] in _ACCENTS:
        return rf"\{_ACCENTS[parts[1]]}{{{parts[0]}}}"
    return f"(U+{ord(sign[0]):04X})"


def format_csv(table: pd.DataFrame) -> str:
    """Format a table as CSV with all digits."""
    return table.to_csv(index=False, lineterminator="\n")


def format_number(value: Any) -> str:
    """Format a value with three significant digits; counts and texts are unchanged."""
    if (
        value is None
        or value is pd.NA
        or (isinstance(value, float | np.floating) and np.isnan(value))
    ):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    size = abs(float(value))
    if size == 0:
        return "0"  # not -0
    if not 1e-3 <= size < 1e5:
        return f"{value:.2e}"
    digits = 2 - int(np.floor(np.log10(float(f"{size:.2e}"))))
    return f"{value:.{max(digits, 0)}f}"


def _is_number(column: pd.Series) -> bool:
    """Return whether a column contains numbers."""
    return bool(pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column))
