"""Limits of files that are read: a file that would fill the memory is refused by what it states, before it is read."""

from __future__ import annotations

import base64
import gzip
import io
import os
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from pfbench.files import limits
from pfbench.files.table_file import read_table_file
from pfbench.filter.learned.checkpoint import read_checkpoint
from pfbench.report import RUNS_FILE, read_stored_study
from pfbench.results.store import read_metadata, read_result
from pfbench.scenario.simulated import _read


def write_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for number in range(2):  # each of them is within the limit
            file.writestr(f"{number}.npy", bytes(limits.INFLATED_FREE))


def write_gzip(path: Path) -> None:
    part = gzip.compress(bytes(2**20))
    path.write_bytes(part * 500)  # members, which a reader joins


def write_metadata(path: Path) -> None:
    bomb = base64.b64encode(gzip.compress(bytes(2**20)) * 250)
    table = pa.table({"filter": ["a"]}).replace_schema_metadata({b"pfbench": bomb})
    parquet.write_table(table, path)


def write_columns(path: Path) -> None:
    path.write_text(
        ",".join(f"c{i}" for i in range(40_000)) + "\n" + ",".join(["1"] * 40_000) + "\n"
    )


def write_rows(path: Path) -> None:
    column = pa.array(np.zeros(20_000_000))
    parquet.write_table(pa.table({"t": column}), path, compression="zstd")


CASES: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "a result": ("a.npz", write_zip, read_result),
    "metadata of a result": ("a.npz", write_zip, read_metadata),
    "a checkpoint": ("a.pt", write_zip, read_checkpoint),
    "an episode": ("a.npz", write_zip, _read),
    "a gzip file": ("a.gz", write_gzip, limits.read_gzip),
    "metadata of a study": (RUNS_FILE, write_metadata, lambda path: read_stored_study(path.parent)),
    "a table of columns": ("a.csv", write_columns, read_table_file),
    "a table of rows": ("a.parquet", write_rows, read_table_file),
    "a pipe": ("a.csv", os.mkfifo, read_table_file),
}


@pytest.mark.parametrize("name", CASES)
def test_a_bomb_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    file, write, read = CASES[name]
    path = tmp_path / file
    write(path)
    tracemalloc.start()
    start = time.process_time()
    with pytest.raises(ValueError, match=rf"{file}.* must (have|inflate to|be).*got .*\. [A-Z]"):
        read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * limits.INFLATED_FREE
    assert time.process_time() - start < 5.0


def test_files_within_the_limits_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.gz"
    content = os.urandom(3 * 2**20) + bytes(2**20)
    path.write_bytes(gzip.compress(content[: 2**20]) + gzip.compress(content[2**20 :]))
    assert limits.read_gzip(path) == content
    path.write_bytes(gzip.compress(content)[:-9])
    with pytest.raises(ValueError, match=r"a\.gz must be a gzip file"):
        limits.read_gzip(path)
    path.write_bytes(b"no gzip")
    with pytest.raises(ValueError, match=r"a\.gz must be a gzip file"):
        limits.read_gzip(path)
    stream = io.BytesIO()
    np.savez_compressed(stream, zeros=np.zeros(2**20))  # a ratio of a thousand, and 8 MB
    path.write_bytes(stream.getvalue())
    limits.check_zip(path)
