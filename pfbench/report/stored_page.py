"""Data of a page as a file, from which the page is written again where the results are missing.

All that follows from the runs is decided again from runs.parquet, so that a published page has the
rules and the words of the program. Times per step and curves are those of the file.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa

from pfbench.config.folders import name_run_command
from pfbench.files import limits
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.files.table_file import check_parquet
from pfbench.report.board.decided_parts import StudyFacts, decide_parts
from pfbench.report.journal.references import renew_bibliography
from pfbench.report.methods_facts import MethodsFacts
from pfbench.report.study_files import list_figure_files
from pfbench.report.study_page import write_page
from pfbench.report.verdict_files import format_verdicts

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
        ValueError: If the file is damaged, or lacks facts of the methods paragraph.
    """
    path = folder / PAGE_DATA
    try:
        pack: dict[str, Any] = json.loads(limits.read_gzip(path))
        pack["facts"]["looks"]  # a file of an early version has none
        for name in _KEYED:
            keys = [tuple(key) for key in pack[name]["keys"]]
            pack[name] = dict(zip(keys, pack[name]["values"], strict=True))
    except limits.LimitError:
        raise
    except (OSError, EOFError, ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} must be the data of a page, got {error}. Run the study and write its report again."
        ) from error
    MethodsFacts.from_entries(pack.get("methods"), str(path))
    return pack


def decide_again(pack: Mapping[str, Any], runs: Path) -> dict[str, Any]:
    """Decide the parts of a page again from the runs of a study.

    Args:
        pack: Data of the page.
        runs: File runs.parquet of the report.

    Raises:
        ValueError: If the file lacks runs of a filter of the page.
    """
    try:
        check_parquet(runs)
        table = pd.read_parquet(runs)
        missing = {look["key"] for look in pack["facts"]["looks"]} - set(table["filter"])
        parts = {} if missing else decide_parts(table, StudyFacts.from_pack(pack))
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise ValueError(
            f"{runs} must have the runs of the page in its folder, got {error}. "
            "Run the study and write its report again."
        ) from error
    if missing:
        raise ValueError(
            f"{runs} must have runs of all filters of the page, got none of "
            f"{', '.join(sorted(missing))}. Run the study and write its report again."
        )
    return {**pack, **parts}


def rebuild_page(folder: Path) -> Path:
    """Write the page of a study again, from the data of the page and from its runs if they are there.

    Files that are missing are not offered.

    Args:
        folder: Folder of the report.

    Returns:
        Path of index.html.

    Raises:
        ValueError: If a file is damaged.
    """
    pack, runs = read_page_data(folder), folder / "runs.parquet"
    if has_runs := runs.is_file():
        pack = decide_again(pack, runs)
    pack["bibtex"] = renew_bibliography(pack)
    with RecordedFolder(folder, is_complete=False) as target:
        if has_runs:
            target.write("verdicts.csv", format_verdicts(pack))
            write_page_data(pack, target)
        pack["replay_first"] = name_run_command(str(pack["study"]))
        stored = [d for d in pack["downloads"] if (folder / d["href"]).is_file()]
        pack["downloads"] = stored + list_figure_files(folder)
        return write_page(pack, target)
