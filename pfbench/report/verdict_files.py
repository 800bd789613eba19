"""Files next to the page: verdicts.csv with all that the board shows, runs.parquet and pfbench.bib."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import pandas as pd

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.board.pack_entries import ViewKey
from pfbench.report.table_formats import format_csv


def write_verdict_files(
    pack: Mapping[str, Any], table: pd.DataFrame, folder: RecordedFolder
) -> list[dict[str, Any]]:
    """Write verdicts.csv, runs.parquet and pfbench.bib.

    Args:
        pack: Data of the page, of `build_pack`.
        table: Table of `build_run_table`.
        folder: Folder of the report.

    Returns:
        Entries of the downloads of the page.
    """
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False, compression="zstd")
    contents: list[tuple[str, str, str, str | bytes]] = [
        ("Numbers", "Verdicts of all views (CSV)", "verdicts.csv", format_verdicts(pack)),
        ("Numbers", "Values of all runs (Parquet)", "runs.parquet", buffer.getvalue()),
        ("LaTeX", "References (BibTeX)", "pfbench.bib", pack["bibtex"]),
    ]
    downloads = []
    for group, title, name, content in contents:
        size = folder.write(name, content).stat().st_size
        downloads.append({"name": title, "href": name, "bytes": size, "group": group})
    return downloads


def format_verdicts(pack: Mapping[str, Any]) -> str:
    """Format all rows of all views as CSV.

    Args:
        pack: Data of the page.
    """
    rows = [
        {**dict(zip(ViewKey._fields, key, strict=True)), **row}
        for key, view in pack["views"].items()
        for row in view["rows"]
    ]
    return format_csv(pd.DataFrame(rows))
