"""The files of a report: pages from templates, figures, tables and what was decided."""

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

from pfbench.report import figures, tables, vector
from pfbench.report.canvas import slug

_HERE = Path(__file__).parent
_MANY = 2000  # decisions; a file of more is compressed


def render(template: str, folder: Path, context: Mapping[str, Any]) -> Path:
    """Writes index.html and report.md by the templates of that name; returns the first."""
    css = (_HERE / "style.css").read_text(encoding="utf-8")
    for kind, name in (("md", "report.md"), ("html", "index.html")):
        page = _environment(kind == "html").get_template(f"{template}.{kind}.jinja").render({**context, "css": css})
        (folder / name).write_text(page, encoding="utf-8")
    return folder / "index.html"


def save_typed(folder: Path, name: str, typed: Sequence[Any]) -> str:
    """Writes dataclasses as JSON, compressed and with nine digits where they are thousands; returns the name of the file."""
    many = len(typed) > _MANY
    text = json.dumps([_plain(asdict(one), 9 if many else None) for one in typed], indent=None if many else 1, allow_nan=False)
    for old in (folder / f"{name}.json", folder / f"{name}.json.gz"):
        old.unlink(missing_ok=True)
    if not many:
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        return f"{name}.json"
    (folder / f"{name}.json.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    return f"{name}.json.gz"


def drawn(drawing: figures.Drawing, prefix: str, folder: Path, formats: Sequence[str]) -> dict[str, Any]:
    """What the templates need of one figure; writes its files."""
    paths = figures.save(drawing._replace(name=f"{prefix}_{drawing.name}"), folder / "figures", formats)
    first = max(paths, key=lambda path: path.suffix)  # svg where there is one
    return {
        "file": f"figures/{first.name}",
        "caption": drawing.caption,
        "source": min(map(_address, paths), key=len),
        "name": drawing.name,
        "anchor": slug(f"{prefix}_{drawing.name}"),
        "broad": drawing.name.startswith("spread_"),
    }


def save_table(folder: Path, name: str, table: pd.DataFrame, note: str = "") -> None:
    """As CSV and LaTeX; a note, such as the budget, stands below the LaTeX table and in a last column of the CSV."""
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    (folder / "tables" / f"{name}.csv").write_text(tables.csv(table.assign(note=note) if note else table), encoding="utf-8")
    (folder / "tables" / f"{name}.tex").write_text(tables.latex(table, note), encoding="utf-8")


def clear(folder: Path) -> None:
    """Removes what an earlier report drew, so that no figure of a cell that is gone stays behind."""
    for pattern in ("figures/*.svg", "figures/*.png", "tables/*.csv", "tables/*.tex"):
        for path in folder.glob(pattern):
            path.unlink()
    folder.mkdir(parents=True, exist_ok=True)


def _address(path: Path) -> str:
    """The picture as an address that needs no file."""
    if path.suffix == ".svg":
        return vector.linked(path.read_text(encoding="utf-8"))
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _plain(value: Any, digits: int | None = None) -> Any:
    """For JSON, which has no infinity; with so many digits, or all."""
    if isinstance(value, Mapping):
        return {name: _plain(below, digits) for name, below in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(below, digits) for below in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return str(value)
    return value if digits is None else float(f"{value:.{digits}g}")


def _environment(escaping: bool) -> jinja2.Environment:
    """Of one kind of page: what templates share is escaped, or not, as the page that imports it needs."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        autoescape=escaping,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"table": tables.html, "pipe": tables.markdown, "number": tables.number}
    return environment
