"""Data of a page as a file, from which the page is written again where the results are missing."""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.references import renew_bibliography
from pfbench.report.study_page import write_page

PAGE_DATA = "page.json.gz"
_OMITTED: dict[str, Any] = {"paper_figures": [], "tracks": {}}  # too large; they need the results
_KEYED = ("views", "curves", "calibration", "runs")  # parts with a tuple as key


def write_page_data(pack: Mapping[str, Any], folder: RecordedFolder) -> None:
    """Write the data of a page, without tracks of single runs and figures of the papers.

    Args:
        pack: Data of the page.
        folder: Folder of the report.
    """
    keyed = {
        name: {"keys": [list(key) for key in pack[name]], "values": list(pack[name].values())}
        for name in _KEYED
    }
    text = json.dumps({**pack, **_OMITTED, **keyed}, separators=(",", ":"), allow_nan=False)
    folder.write(PAGE_DATA, gzip.compress(text.encode(), mtime=0))


def read_page_data(folder: Path) -> dict[str, Any]:
    """Read the data of a page.

    Args:
        folder: Folder of the report.

    Raises:
        ValueError: If the file is damaged.
    """
    path = folder / PAGE_DATA
    try:
        pack: dict[str, Any] = json.loads(gzip.decompress(path.read_bytes()))
        for name in _KEYED:
            keys = [tuple(key) for key in pack[name]["keys"]]
            pack[name] = dict(zip(keys, pack[name]["values"], strict=True))
    except (OSError, EOFError, ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} must be the data of a page, got {error}. Run the study and write its report again."
        ) from error
    return pack


def rebuild_page(folder: Path) -> Path:
    """Write index.html and report.md from the data of a page. Files that are missing are not offered.

    Args:
        folder: Folder of the report.

    Returns:
        Path of index.html.
    """
    pack = read_page_data(folder)
    pack["bibtex"] = renew_bibliography(pack)
    pack["downloads"] = [d for d in pack["downloads"] if (folder / d["href"]).is_file()]
    with RecordedFolder(folder, is_complete=False) as target:
        return write_page(pack, target)
