"""Results of another person, with a valid digest: each is refused with its file, or is read without harm."""

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results as synthetic
from refusals import check_refused

from pfbench.files.atomic_write import hash_content
from pfbench.job.replay import find_run
from pfbench.results import store
from pfbench.results.conditions import load_conditions

KEY = "0123456789abcdef"
Change = Callable[[dict[str, Any]], object]


def meta() -> dict[str, Any]:
    return {
        "format": 2, "key": KEY, "study": "s", "label": "ekf", "seed": 1, "runs": 2, "steps": 3,
        "particles": None, "choices": {"scenario": "walk", "filter": "ekf"}, "config": {},
        "versions": {"pfbench": "0.1.0"}, "seconds": {"filter": 1.0},
        "state": {"names": ["x"], "units": ["m"], "groups": {"position": [0]}},
    }  # fmt: skip


def arrays() -> dict[str, Any]:
    return {
        "time": np.arange(3.0), "error": np.ones((2, 3, 1)), "sd": np.ones((2, 3, 1)),
        "nees": np.ones((2, 3, 1)), "log_evidence": np.ones(2), "lost": np.zeros(2, bool),
        "health": np.zeros(2, np.int8),
    }  # fmt: skip


def forge(folder: Path, about: dict[str, Any], data: dict[str, Any]) -> Path:
    """Write a result without the checks of the writer."""
    text = np.array(json.dumps(about))
    digest = np.array(hash_content({"meta": text, **data}))
    path = folder / f"{KEY}.npz"
    with path.open("wb") as file:
        np.savez(file, meta=text, digest=digest, **data)
    return path


def test_a_plain_forged_result_is_read(tmp_path: Path) -> None:
    assert store.read_result(forge(tmp_path, meta(), arrays())).meta["label"] == "ekf"


METADATA: dict[str, Change] = {
    "state must": lambda m: m["state"].update(units=None),
    "state must have groups of components from 0 to 0, got 99": lambda m: m["state"].update(groups={"a": [99]}),
    "state must have groups of components from 0 to 0, got -1": lambda m: m["state"].update(groups={"a": [-1]}),
    "state must have groups of components, got": lambda m: m["state"].update(groups=[0]),
    "state must have lists of texts": lambda m: m["state"].update(names=[1]),
    "state must have one unit": lambda m: m["state"].update(units=["m", "m"]),
    "state must have names": lambda m: m.update(state=7),
    "choices must": lambda m: m.update(choices={"scenario": ["a"]}),
    "steps must": lambda m: m.update(steps="many"),
    "runs must": lambda m: m.update(runs=-5),
    "seed must": lambda m: m.update(seed=10**400),
    "particles must": lambda m: m.update(particles=[1]),
    "label must": lambda m: m.update(label="x" * 100_000),
    "versions must": lambda m: m.update(versions="x"),
    "seconds must": lambda m: m.update(seconds={"filter": "x"}),
    "config must": lambda m: m.update(config="x"),
    "inputs must be a dictionary of dictionaries": lambda m: m.update(inputs="x"),
    "inputs must": lambda m: m.update(inputs={"scenario": "x"}),
}  # fmt: skip
ARRAYS: dict[str, Change] = {
    "error must be real numbers": lambda d: d.update(error=d["error"].astype(str)),
    "sd must be real numbers": lambda d: d.update(sd=d["sd"] * 1j),
    "sd must not be negative": lambda d: d.update(sd=-d["sd"]),
    "time must increase": lambda d: d.update(time=d["time"][::-1].copy()),
    "lost must be booleans": lambda d: d.update(lost=np.array([0.5, 0.0])),
    "health must be from 0 to 7": lambda d: d.update(health=np.array([0, 99], np.int8)),
}


@pytest.mark.parametrize("message", METADATA)
def test_metadata_of_another_kind_are_refused(tmp_path: Path, message: str) -> None:
    about = meta()
    METADATA[message](about)
    path = forge(tmp_path, about, arrays())
    with pytest.raises(ValueError, match=message) as caught:
        store.read_result(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


@pytest.mark.parametrize("message", ARRAYS)
def test_arrays_of_another_kind_are_refused(tmp_path: Path, message: str) -> None:
    data = arrays()
    ARRAYS[message](data)
    check_refused(
        [(message, lambda: store.read_result(forge(tmp_path, meta(), data)))], remedy=False
    )


def write_pickle(path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(path.with_name("evil")),)

    with path.open("wb") as file:
        np.savez(file, meta=np.array([Evil()], dtype=object))


def write_huge_array(path: Path) -> None:
    head = io.BytesIO()
    about: dict[str, Any] = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    np.lib.format.write_array_header_1_0(head, about)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("meta.npy", head.getvalue())


def write_deep_json(path: Path) -> None:
    text = '{"a":' + "[" * 100_000 + "]" * 100_000 + "}"
    with path.open("wb") as file:
        np.savez(file, meta=np.array(text))


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "pickle": (write_pickle, "is damaged"),
    "array of 80 TB": (write_huge_array, "is damaged"),
    "deep JSON": (write_deep_json, "move it away"),
    "pipe": (os.mkfifo, "must be a file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "must be a file"),
    "folder": (Path.mkdir, "must be a file"),
}


@pytest.mark.parametrize("name", FILES)
def test_files_that_are_no_result_are_refused(tmp_path: Path, name: str) -> None:
    write, message = FILES[name]
    write(tmp_path / f"{KEY}.npz")
    check_refused([(message, lambda: store.read_result(tmp_path / f"{KEY}.npz"))], remedy=False)
    assert [path.name for path in tmp_path.iterdir()] == [f"{KEY}.npz"]


NOTES: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/urandom"),
    "deep JSON": lambda path: path.write_text("[" * 100_000),
    "key of another type": lambda path: path.write_text(
        json.dumps({"key": [1], "digest": hash_content({"key": [1]})})
    ),
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("name", NOTES)
def test_a_failure_note_of_another_kind_is_a_failure_without_text(
    tmp_path: Path, name: str
) -> None:
    NOTES[name](tmp_path / f"{KEY}.failed.json")
    (failure,) = store.list_failures(tmp_path)
    assert failure["key"] == KEY
    assert failure["message"] == f"{KEY}.failed.json is damaged. Run the job again"


def test_a_file_that_is_no_result_stops_no_report(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is named in a line and stays where it is; the rest is reported."""
    folder = tmp_path / "demo"
    synthetic.study(folder, runs=4, steps=5)
    good = len(list(folder.glob("*.npz")))
    np.savez(folder / "foreign.npz", x=np.zeros(3))
    np.save(folder / "single.npy", np.zeros(3))
    (folder / "single.npy").rename(folder / "single.npz")
    forge(folder, meta() | {"format": 3}, arrays())
    (condition,) = load_conditions("demo", tmp_path)
    assert len(condition.jobs) == good
    for name in ("foreign", "single", KEY):
        (line,) = [text for text in caplog.messages if f"{folder / name}.npz   left out: " in text]
        assert "must" in line
        assert (folder / f"{name}.npz").is_file()
    run = find_run("demo", tmp_path, 1, "ekf", {"scenario": "flight", "noise": "surge"})
    assert run.job.meta["label"] == "ekf"
