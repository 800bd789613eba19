"""Writers of the files of a report: pages, figures, tables and decisions."""

from __future__ import annotations

import base64
import itertools
import math
from collections.abc import Mapping, Sequence
from decimal import ROUND_HALF_UP, Context, Decimal
from typing import Any

import numpy as np
import pandas as pd

from pfbench.files.escapes import (
    escape_csv,
    escape_html,
    escape_latex,
    escape_markdown,
)
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.results.plotting import FigureSpec, draw_figure, format_slug

DASH = "–"


def render_figures(
    drawings: Sequence[FigureSpec], prefix: str, formats: Sequence[str]
) -> tuple[list[dict[str, Any]], dict[str, bytes]]:
    """Draw figures.

    Returns template variables of each figure, and the files by name.
    """
    entries: list[dict[str, Any]] = []
    files: dict[str, bytes] = {}
    for drawing in drawings:
        contents = draw_figure(drawing, formats)
        stem = f"figures/{prefix}_{drawing.name}"
        files |= {f"{stem}.{suffix}": content for suffix, content in contents.items()}
        entries.append({
            "file": f"{stem}.{max(contents)}",  # svg if available
            "caption": drawing.caption,
            "source": min(itertools.starmap(format_data_address, contents.items()), key=len),
            "name": drawing.name,
            "anchor": format_slug(f"{prefix}_{drawing.name}"),
        })  # fmt: skip
    return entries, files


def write_figures(
    drawings: Sequence[FigureSpec], prefix: str, folder: RecordedFolder, formats: Sequence[str]
) -> list[dict[str, Any]]:
    """Write the files of figures and return their template variables."""
    entries, files = render_figures(drawings, prefix, formats)
    for name, content in files.items():
        folder.write(name, content)
    return entries


def write_table(folder: RecordedFolder, name: str, table: pd.DataFrame, note: str = "") -> None:
    """Write a table as CSV and LaTeX."""
    text = format_csv(table.assign(note=note) if note else table)
    folder.write(f"tables/{name}.csv", text)
    folder.write(f"tables/{name}.tex", format_latex(table, note))


def format_data_address(suffix: str, content: bytes) -> str:
    """Return an image as a data URI, so that the page needs no file."""
    kind = "svg+xml" if suffix.removeprefix(".") == "svg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def to_json_types(value: Any) -> Any:
    """Convert a value to JSON types, with infinity as text."""
    if isinstance(value, Mapping):
        return {name: to_json_types(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_types(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


# --------------------------------------------------------------------------------------------------
# Formats of tables: HTML, Markdown, LaTeX, CSV, and numbers with three digits.


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
    """Format a table as a booktabs tabular."""
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


def format_short(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits, as the script of the page does."""
    if value is None:
        return DASH
    if value == math.inf:
        return "∞"
    rounded = Context(prec=digits, rounding=ROUND_HALF_UP).create_decimal(Decimal(value))
    if rounded == 0:
        return "0"
    exponent = rounded.adjusted()
    if not -4 <= exponent < 6:
        return f"{rounded:.{digits - 1}e}".replace("e+", "e")
    return f"{rounded:.{max(0, digits - 1 - exponent)}f}"


def format_number(value: Any) -> str:
    """Format a value with three significant digits; counts and texts are unchanged."""
    if (
        value is None
        or value is pd.NA
        or (isinstance(value, float | np.floating) and np.isnan(value))
    ):
        return DASH
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
