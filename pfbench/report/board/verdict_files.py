"""Files next to the page: verdicts.csv with all that the board shows, and runs.parquet."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import pandas as pd

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.table_formats import format_csv


def write_verdict_files(
    pack: Mapping[str, Any], table: pd.DataFrame, folder: RecordedFolder
) -> list[dict[str, Any]]:
    """Write verdicts.csv and runs.parquet.

    Args:
        pack: Data of the page, of `build_pack`.
        table: Table of `build_run_table`.
        folder: Folder of the report.

    Returns:
        Entries of the downloads of the page.
    """
    rows = [
        {**dict(zip(("metric", "world", "regime", "baseline"), key.split("/"), strict=True)), **row}
        for key, view in pack["views"].items()
        for row in view["rows"]
    ]
    verdicts = format_csv(pd.DataFrame(rows))
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False, compression="zstd")
    contents: list[tuple[str, str, str | bytes]] = [
        ("Verdicts of all views (CSV)", "verdicts.csv", verdicts),
        ("Values of all runs (Parquet)", "runs.parquet", buffer.getvalue()),
    ]
    downloads = []
    for title, name, content in contents:
        size = folder.write(name, content).stat().st_size
        downloads.append({"name": title, "href": name, "bytes": size, "group": "Numbers"})
    return downloads
