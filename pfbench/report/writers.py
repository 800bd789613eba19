"""Writers of the files of a report: pages, figures, tables and decisions."""

from __future__ import annotations

import base64
import gzip
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup

from pfbench.files.escapes import escape_code_block, escape_markdown
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import provenance, table_formats
from pfbench.report.plots.figure_files import FigureSpec, draw_figure
from pfbench.report.plots.plotting import format_slug

_HERE = Path(__file__).parent
_MANY = 2000  # entries above which a JSON file is compressed


def render_template(
    template: str,
    folder: RecordedFolder,
    context: Mapping[str, Any],
    home: Path = _HERE,
) -> Path:
    """Write a page as Markdown and HTML from templates.

    Args:
        template: Name of the templates without suffixes.
        folder: Target folder.
        context: Variables of the templates.
        home: Folder of the templates.

    Returns:
        Path of the HTML page.
    """
    css = (_HERE / "style.css").read_text(encoding="utf-8")
    for kind, name in (("md", "report.md"), ("html", "index.html")):
        environment = template_environment(home, is_html=kind == "html")
        page = environment.get_template(f"{template}.{kind}.jinja").render({**context, "css": css})
        folder.write(name, page)
    return folder.path / "index.html"


def write_json(folder: RecordedFolder, name: str, typed: Sequence[Any]) -> str:
    """Write dataclasses as JSON, compressed and with nine digits if there are thousands.

    Args:
        folder: Target folder.
        name: File name without suffix.
        typed: Dataclass instances.

    Returns:
        File name.
    """
    many = len(typed) > _MANY
    rows = [to_json_types(asdict(row), 9 if many else None) for row in typed]
    text = json.dumps(rows, indent=None if many else 1, allow_nan=False)
    if not many:
        return folder.write(f"{name}.json", text + "\n").name
    return folder.write(f"{name}.json.gz", gzip.compress(text.encode(), mtime=0)).name


def render_figure(
    drawing: FigureSpec, prefix: str, folder: RecordedFolder, formats: Sequence[str]
) -> dict[str, Any]:
    """Write the files of a figure and return its template variables.

    Args:
        drawing: Figure.
        prefix: Prefix of the file names.
        folder: Folder of the report.
        formats: Formats of the figure.
    """
    contents = draw_figure(drawing, formats)
    for suffix, content in contents.items():
        folder.write(f"figures/{prefix}_{drawing.name}.{suffix}", content)
    return {
        "file": f"figures/{prefix}_{drawing.name}.{max(contents)}",  # svg if available
        "caption": drawing.caption,
        "source": min(itertools.starmap(_data_address, contents.items()), key=len),
        "name": drawing.name,
        "anchor": format_slug(f"{prefix}_{drawing.name}"),
    }


def render_figures(
    drawings: Sequence[FigureSpec], prefix: str, folder: RecordedFolder, formats: Sequence[str]
) -> list[dict[str, Any]]:
    """Write the files of figures and return their template variables.

    Args:
        drawings: Figures.
        prefix: Prefix of the file names.
        folder: Folder of the report.
        formats: Formats of the figures.
    """
    return [render_figure(drawing, prefix, folder, formats) for drawing in drawings]


def write_table(folder: RecordedFolder, name: str, table: pd.DataFrame, note: str = "") -> None:
    """Write a table as CSV and LaTeX.

    Args:
        folder: Folder of the report.
        name: File name without suffix.
        table: Table.
        note: Note below the LaTeX table and in the last column of the CSV file.
    """
    text = table_formats.format_csv(table.assign(note=note) if note else table)
    folder.write(f"tables/{name}.csv", text)
    folder.write(f"tables/{name}.tex", table_formats.format_latex(table, note))


def _data_address(suffix: str, content: bytes) -> str:
    """Return an image as a data URI, so that the page needs no file."""
    kind = "svg+xml" if suffix == "svg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def to_json_types(value: Any, digits: int | None = None) -> Any:
    """Convert a value to JSON types, with infinity as text.

    Args:
        value: Value, list or mapping.
        digits: Number of significant digits, None for all.
    """
    if isinstance(value, Mapping):
        return {name: to_json_types(item, digits) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_types(item, digits) for item in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return str(value)
    return value if digits is None else float(f"{value:.{digits}g}")


def template_environment(home: Path, *, is_html: bool) -> jinja2.Environment:
    """Return the environment of templates of HTML or Markdown. Each value is escaped once.

    Args:
        home: Folder of the templates.
        is_html: Whether pages are HTML.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(home),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=None if is_html else _escape_value,
    )
    environment.filters |= {
        "table": lambda table: Markup(table_formats.format_html(table)),
        "pipe": lambda table: Markup(table_formats.format_markdown(table)),
        "code": lambda text: Markup(escape_code_block(text)),
        "number": table_formats.format_number,
    }
    environment.filters["name_build"] = provenance.name_build
    return environment


def _escape_value(value: Any) -> Markup:
    """Escape a value of a Markdown template, unless a template or a table made it."""
    return value if hasattr(value, "__html__") else Markup(escape_markdown(str(value)))
