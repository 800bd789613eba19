"""Limits of files that are read: a file that would fill the memory is refused by what it states, before it is read."""

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
from refusals import check_refused

from pfbench.files import limits
from pfbench.files.table_file import read_table_file
from pfbench.filter.learned.checkpoint import read_checkpoint
from pfbench.logs.judge.formats import read_trajectories
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.sky.ephemeris import read_ephemeris, read_rinex
from pfbench.logs.worlds.log_tables import find_dataset, list_tables
from pfbench.logs.worlds.rinex_source import RinexSource
from pfbench.noise.error_replay import ErrorReplay
from pfbench.report import RUNS_FILE, read_stored_study
from pfbench.results.store import read_metadata, read_result
from pfbench.scenario.simulated import _read

OUTSIDE = (
    "../private/s.csv",
    "logs/../../private/s.csv",
    "{top}/private/s.csv",
    "logs/link.csv",
    "logs/away/s.csv",
)


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_named_file_lies_in_the_folder_of_the_user(tmp_path: Path, name: str) -> None:
    """No parent, other place or link below a data set leaves it. A data set itself may be a link of the user's."""
    root, private = tmp_path / "data", tmp_path / "private"
    for folder in (root / "logs", private):
        folder.mkdir(parents=True)
    (private / "s.csv").write_text("t,x\n1,2\n")
    (root / "logs" / "own.csv").write_text("t,x\n1,2\n")
    (root / "logs" / "link.csv").symlink_to(private / "s.csv")
    (root / "logs" / "away").symlink_to(private)
    (root / "mine").symlink_to(private)
    for is_data_set in (False, True):
        with pytest.raises(limits.LimitError, match="must be a file or a folder below"):
            limits.find_input(root, name.format(top=tmp_path), is_data_set=is_data_set)
        own = limits.find_input(root, "logs/own.csv", is_data_set=is_data_set)
        assert own.read_text().startswith("t,x")
    assert limits.find_input(root, "mine/s.csv", is_data_set=True).is_file()
    with pytest.raises(limits.LimitError, match="Copy it there, or name another folder"):
        limits.find_input(root, "mine/s.csv")


PLACES: dict[str, Callable[[str, str], object]] = {
    "table": lambda root, name: list_tables(root, "logs", (name,)),
    "data set": lambda root, name: find_dataset(root, name),
    "rinex": lambda root, name: RinexSource(observations=name).list_files(root, "logs"),
    "rinex folder": lambda root, name: RinexSource().list_files(root, name),
    "orbits": lambda root, name: BroadcastConstellation(root, name, 0.0).input_files(),
    "ephemerides": lambda root, name: read_ephemeris(root, name),
    "record": lambda root, name: ErrorReplay(root, "logs", name).input_files(),
    "record of a folder": lambda root, name: ErrorReplay(root, name).read_record(),
}


@pytest.mark.parametrize("reader", PLACES)
def test_every_reader_refuses_a_name_that_leaves_the_data(tmp_path: Path, reader: str) -> None:
    (tmp_path / "data" / "logs").mkdir(parents=True)
    for name in ("../../private", "logs/../../../private"):
        with pytest.raises(limits.LimitError, match="private"):
            PLACES[reader](str(tmp_path / "data"), name)


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


def write_one_line(path: Path) -> None:
    """A text of 400 MB without a line end, which takes no space on the disk."""
    path.write_bytes(START[path.suffix])
    os.truncate(path, 400 * 2**20)


def write_gigabytes(path: Path) -> None:
    path.write_bytes(START[path.suffix])
    os.truncate(path, 5 * 2**30)


def write_empty_lines(path: Path) -> None:
    path.write_bytes(START[path.suffix] + b"\n" * (limits.TEXT_LINES + 1))


def write_old_line_ends(path: Path) -> None:
    path.write_bytes(START[path.suffix] + b"\r" * (limits.TEXT_LINES + 1))


def write_pose_columns(path: Path) -> None:
    path.write_text("1 " * 30_000 + "\n")


def write_brackets(path: Path) -> None:
    """Comments in which each bracket may begin a unit."""
    path.write_text(("#" + "[" * 90_000 + "\n") * 11)


START = {
    ".csv": b"t,pn,pe,pd\n",
    ".nmea": b"$GPGGA,\n",
    ".tum": b"0 0 0 0 0 0 0 1\n",
    ".20n": b"     2.11           N: GPS NAV DATA                         RINEX VERSION / TYPE\n",
}
READERS: dict[str, Callable[[Path], object]] = {
    ".csv": read_table_file,
    ".nmea": lambda path: read_trajectories(path, SourceOptions()),
    ".tum": lambda path: read_trajectories(path, SourceOptions(frame="ned")),
    ".20n": read_rinex,
}
TEXTS: dict[str, Callable[[Path], None]] = {
    "one line": write_one_line,
    "gigabytes": write_gigabytes,
    "empty lines": write_empty_lines,
    "old line ends": write_old_line_ends,
}

CASES: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "a result": ("a.npz", write_zip, read_result),
    "metadata of a result": ("a.npz", write_zip, read_metadata),
    "a checkpoint": ("a.pt", write_zip, read_checkpoint),
    "an episode": ("a.npz", write_zip, _read),
    "a gzip file": ("a.gz", write_gzip, lambda path: limits.inflate(path, path.read_bytes())),
    "metadata of a study": (RUNS_FILE, write_metadata, lambda path: read_stored_study(path.parent)),
    "a table of columns": ("a.csv", write_columns, read_table_file),
    "a table of rows": ("a.parquet", write_rows, read_table_file),
    "a pipe": ("a.csv", os.mkfifo, read_table_file),
    "poses of columns": ("a.tum", write_pose_columns, READERS[".tum"]),
    "units in a comment": ("a.txt", write_brackets, READERS[".tum"]),
    **{
        f"{name}: {kind}": (f"a{kind}", write, read)
        for kind, read in READERS.items()
        for name, write in TEXTS.items()
    },
}


@pytest.mark.parametrize("name", CASES)
def test_a_bomb_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    file, write, read = CASES[name]
    path = tmp_path / file
    write(path)
    tracemalloc.start()
    start = time.process_time()
    check_refused(
        [(rf"{file}.* must (have|inflate to|be).*got .*\. [A-Z]", lambda: read(path))], remedy=False
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * limits.INFLATED_FREE
    assert time.process_time() - start < 5.0


def test_files_within_the_limits_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.gz"
    content = os.urandom(3 * 2**20) + bytes(2**20)
    path.write_bytes(gzip.compress(content[: 2**20]) + gzip.compress(content[2**20 :]))
    assert limits.inflate(path, path.read_bytes()) == content
    path.write_bytes(gzip.compress(content)[:-9])
    check_refused(
        [(r"a\.gz must be a gzip file", lambda: limits.inflate(path, path.read_bytes()))],
        remedy=False,
    )
    path.write_bytes(b"no gzip")
    check_refused(
        [(r"a\.gz must be a gzip file", lambda: limits.inflate(path, path.read_bytes()))],
        remedy=False,
    )
    stream = io.BytesIO()
    np.savez_compressed(stream, zeros=np.zeros(2**20))  # a ratio of a thousand, and 8 MB
    path.write_bytes(stream.getvalue())
    limits.check_zip(path)


def test_a_text_at_the_limits_is_read_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lines and bytes are counted alike wherever the pieces end."""
    path = tmp_path / "a.txt"
    for end in (b"\n", b"\r", b"\r\n"):
        content = end.join([b"a" * 7, b"b" * 10, b"", b"c"]) + end
        path.write_bytes(content)
        for piece in range(1, len(content) + 1):
            for name, most in (("_PIECE", piece), ("LINE_BYTES", 10), ("TEXT_LINES", 4)):
                monkeypatch.setattr(limits, name, most)
            assert limits.read_text(path) == content
            monkeypatch.setattr(limits, "LINE_BYTES", 9)
            with pytest.raises(limits.LimitError, match="at most 9 bytes, got a longer one"):
                limits.read_text(path)
            monkeypatch.setattr(limits, "LINE_BYTES", 10)
            monkeypatch.setattr(limits, "TEXT_LINES", 3)
            with pytest.raises(limits.LimitError, match="at most 3 lines"):
                limits.read_text(path)
