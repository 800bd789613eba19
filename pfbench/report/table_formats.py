"""Formats of tables: HTML, Markdown, LaTeX, CSV, and numbers with three digits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from pfbench.files.escapes import escape_csv, escape_html, escape_latex, escape_markdown


def format_html(table: pd.DataFrame) -> str:
    """Format a table as HTML, with classes for the alignment.

    Optional end tags are left out, because they would be most of a page of tables.
    """
    numeric = [_is_number(table[name]) for name in table]
    head = "".join(
        f"<th{' class=number' if right else ''}>{escape_html(str(name))}"
        for name, right in zip(table, numeric, strict=True)
    )
    kinds = ["<td>" if right else "<td class=t>" for right in numeric]
    body = "\n".join(
        "<tr>"
        + "".join(
            kind + escape_html(format_number(value))
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
    cells = [[escape_markdown(text) for text in row] for row in cells]
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
    lines = [" & ".join(map(escape_latex, row)) + r" \\" for row in rows]
    body = ["\\toprule", lines[0], "\\midrule", *lines[1:], "\\bottomrule"]
    if note:
        body.append(
            rf"\multicolumn{{{len(table.columns)}}}{{l}}{{\footnotesize {escape_latex(note)}}} \\"
        )
    return "\n".join([rf"\begin{{tabular}}{{{layout}}}", *body, r"\end{tabular}", ""])


def format_csv(table: pd.DataFrame) -> str:
    """Format a table as CSV with all digits. A spreadsheet computes none of its texts."""
    plain = table.map(lambda value: escape_csv(value) if isinstance(value, str) else value)
    return plain.to_csv(
        index=False, lineterminator="\n", header=[escape_csv(str(name)) for name in table]
    )


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
