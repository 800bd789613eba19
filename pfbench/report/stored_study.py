"""A study in one file: the values of all runs, and all other data of its page but the decisions.

Git stores this file of a published study, so that its page and every decision are made again in a fresh clone by the
rules and words of the program.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa
from pyarrow import parquet

from pfbench.core.parameter_checks import require
from pfbench.files import limits
from pfbench.files.table_file import check_parquet
from pfbench.report.board.entries import StudyFacts
from pfbench.report.board.pack import decide_parts
from pfbench.report.methods_text import read_facts

RUNS_FILE = "runs.parquet"  #: name of the file with the values of all runs of a study
_KEY = b"pfbench"  # of the metadata of the file
_FIGURE = re.compile(r"figures/paper_[\w.+-]+\.(svg|png)")

_OMITTED = ("tracks", "downloads", "definitions")  # large, or made again with the page
_DECIDED = (
    "alpha", "margin", "filters", "metrics", "baselines", "views", "planned", "decisions", "recorded", "warnings", "calibration", "runs", "sweeps",
)  # fmt: skip


class StoredStudy(NamedTuple):
    """A study that is decided: the data of its page, and the values of all runs."""

    pack: dict[str, Any]
    table: pd.DataFrame


def round_runs(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table of runs in single precision, from which all decisions are made."""
    numbers = table.select_dtypes("float64").columns
    return table.astype(dict.fromkeys(numbers, "float32"))


def format_runs(table: pd.DataFrame, pack: Mapping[str, Any]) -> bytes:
    """Format the runs of a study with the data of its page. Equal data give equal bytes.

    Args:
        table: Values of all runs.
        pack: Data of the page.

    Returns:
        Content of the Parquet file.
    """
    parts = {key: value for key, value in pack.items() if key not in (*_DECIDED, *_OMITTED)}
    parts["curves"] = [[list(key), value] for key, value in pack["curves"].items()]
    parts["paper_figures"] = [{k: v for k, v in f.items() if k != "source"} for f in pack.get("paper_figures", ())]  # fmt: skip
    text = json.dumps(parts, separators=(",", ":"), allow_nan=False)
    packed = base64.b64encode(gzip.compress(text.encode(), mtime=0))
    arrow = pa.Table.from_pandas(round_runs(table), preserve_index=False)
    arrow = arrow.replace_schema_metadata({**(arrow.schema.metadata or {}), _KEY: packed})
    buffer = io.BytesIO()
    parquet.write_table(arrow, buffer, compression="zstd")
    return buffer.getvalue()


def read_stored_study(folder: Path, decides: bool = True) -> StoredStudy:
    """Read a study from its file, and decide it.

    Args:
        folder: Folder of the report.
        decides: Whether the views of its page are decided: seconds for a large study, which its runs alone do not need.

    Raises:
        ValueError: If the file is damaged, or is of another version of pfbench.
    """
    path = folder / RUNS_FILE
    try:
        check_parquet(path)
        arrow = parquet.read_table(path)
        packed = base64.b64decode((arrow.schema.metadata or {})[_KEY])
        pack: dict[str, Any] = json.loads(limits.inflate(path, packed))
        pack["curves"] = {tuple(key): value for key, value in pack["curves"]}
        table = arrow.to_pandas()
        missing = {look["key"] for look in pack["facts"]["looks"]} - set(table["filter"])
        facts = StudyFacts.from_pack(pack)
        decided = decide_parts(table, facts) if decides and not missing else {}
    except limits.LimitError:
        raise
    except (OSError, EOFError, ValueError, TypeError, KeyError, AttributeError, pa.ArrowException) as error:  # fmt: skip
        raise ValueError(
            f"{path} must be the runs of a study with the data of its page, got {error}. "
            "Run the study and write its report again."
        ) from error
    require(
        not missing,
        path,
        "have runs of all filters of the page",
        f"none of {', '.join(sorted(missing))}",
        "Run the study and write its report again.",
    )
    read_facts(pack.get("methods"), str(path))
    for figure in pack[
        "paper_figures"
    ]:  # the file may come from a stranger, and the page shows what it names
        is_own, file = bool(_FIGURE.fullmatch(figure["file"])), repr(figure["file"])
        require(is_own, f"paper_figures of {path}", "name figures/paper_NAME.svg or .png", file, "Write its report again.")  # fmt: skip
    figures = [figure for figure in pack["paper_figures"] if (folder / figure["file"]).is_file()]
    return StoredStudy({**pack, "tracks": {}, "paper_figures": figures, **decided}, table)
