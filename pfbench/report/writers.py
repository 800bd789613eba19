"""Writers of the files of a report: pages, figures, tables and decisions."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from pfbench.report import table_formats
from pfbench.report.plots.figure_files import FigureSpec, write_figure
from pfbench.report.plots.plotting import format_slug

_HERE = Path(__file__).parent
_MANY = 2000  # entries above which a JSON file is compressed


def render_template(
    template: str, folder: Path, context: Mapping[str, Any], home: Path = _HERE
) -> Path:
    """Write index.html and report.md from templates.

    Args:
        template: Name of the templates without suffixes.
        folder: Target folder.
        context: Variables of the templates.
        home: Folder of the templates.

    Returns:
        Path of index.html.
    """
    css = (_HERE / "style.css").read_text(encoding="utf-8")
    for kind, name in (("md", "report.md"), ("html", "index.html")):
        page = (
            _environment(kind == "html", home)
            .get_template(f"{template}.{kind}.jinja")
            .render({**context, "css": css})
        )
        (folder / name).write_text(page, encoding="utf-8")
    return folder / "index.html"


def write_json(folder: Path, name: str, typed: Sequence[Any]) -> str:
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
    for old in (folder / f"{name}.json", folder / f"{name}.json.gz"):
        old.unlink(missing_ok=True)
    if not many:
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        return f"{name}.json"
    (folder / f"{name}.json.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    return f"{name}.json.gz"


def render_figure(
    drawing: FigureSpec, prefix: str, folder: Path, formats: Sequence[str]
) -> dict[str, Any]:
    """Write the files of a figure and return its template variables.

    Args:
        drawing: Figure.
        prefix: Prefix of the file names.
        folder: Folder of the report.
        formats: Formats of the figure.
    """
    paths = write_figure(
        drawing._replace(name=f"{prefix}_{drawing.name}"), folder / "figures", formats
    )
    first = max(paths, key=lambda path: path.suffix)  # svg if available
    return {
        "file": f"figures/{first.name}",
        "caption": drawing.caption,
        "source": min(map(_data_address, paths), key=len),
        "name": drawing.name,
        "anchor": format_slug(f"{prefix}_{drawing.name}"),
        "broad": drawing.name.startswith("spread_"),
    }


def render_figures(
    drawings: Sequence[FigureSpec], prefix: str, folder: Path, formats: Sequence[str]
) -> list[dict[str, Any]]:
    """Write the files of figures and return their template variables.

    Args:
        drawings: Figures.
        prefix: Prefix of the file names.
        folder: Folder of the report.
        formats: Formats of the figures.
    """
    return [render_figure(drawing, prefix, folder, formats) for drawing in drawings]


def write_table(folder: Path, name: str, table: pd.DataFrame, note: str = "") -> None:
    """Write a table as CSV and LaTeX.

    Args:
        folder: Folder of the report.
        name: File name without suffix.
        table: Table.
        note: Note below the LaTeX table and in the last column of the CSV file.
    """
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    text = table_formats.format_csv(table.assign(note=note) if note else table)
    (folder / "tables" / f"{name}.csv").write_text(text, encoding="utf-8")
    (folder / "tables" / f"{name}.tex").write_text(
        table_formats.format_latex(table, note), encoding="utf-8"
    )


def remove_old_files(folder: Path) -> None:
    """Remove the figures and tables of an earlier report, which may belong to removed conditions."""
    for pattern in ("figures/*.svg", "figures/*.png", "tables/*.csv", "tables/*.tex"):
        for path in folder.glob(pattern):
            path.unlink()
    folder.mkdir(parents=True, exist_ok=True)


def _data_address(path: Path) -> str:
    """Return the image as a data URI, so that the page needs no file."""
    kind = "svg+xml" if path.suffix == ".svg" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


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


def _environment(escaping: bool, home: Path = _HERE) -> jinja2.Environment:
    """Return the template environment of HTML (escaping) or Markdown pages."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(home),
        autoescape=escaping,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "table": table_formats.format_html,
        "pipe": table_formats.format_markdown,
        "number": table_formats.format_number,
    }
    return environment
