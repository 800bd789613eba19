"""Damaged and swapped files are found: none is read with other numbers than were written."""

import json
import logging
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import pfbench
from pfbench.experiments.study_parts import ResumableResults

from pfbench.files.atomic_write import (
    DIGEST,
    has_valid_digest,
    hash_content,
    set_aside,
    write_atomically,
)
from pfbench.filter.learned import checkpoint
from pfbench.results import store
from pfbench.scenario import simulated

TRIALS = 300  # of each kind of file
WALK = ("scenario=linear_walk", "scenario.steps=5", "filter=ekf", "runs=2")


def damage(content: bytes, rng: random.Random) -> bytes:
    """Flip a bit, change, cut, repeat or blank some bytes, or append others."""
    start = rng.randrange(len(content))
    length = rng.choice((1, 2, 16, 200))
    chunk = content[start : start + length]
    kind = rng.randrange(6)
    if kind == 0:
        changed = bytes([content[start] ^ (1 << rng.randrange(8))])
        return content[:start] + changed + content[start + 1 :]
    if kind == 1:
        return content[:start]
    new = {2: rng.randbytes(len(chunk)), 3: chunk + chunk, 4: bytes(len(chunk))}.get(kind)
    if new is None:
        return content + rng.randbytes(length)
    return content[:start] + new + content[start + len(chunk) :]


def trial(
    path: Path, read: Callable[[], Any], errors: tuple[type[Exception], ...]
) -> dict[str, int]:
    """Read damaged copies of a file and count what became of them."""
    content, rng = path.read_bytes(), random.Random(1)
    original = hash_content(read())
    counts = dict.fromkeys(("refused", "equal", "other content"), 0)
    for _ in range(TRIALS):
        path.write_bytes(damage(content, rng))
        try:
            counts["equal" if hash_content(read()) == original else "other content"] += 1
        except errors:
            counts["refused"] += 1
    path.write_bytes(content)
    return counts


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("result")
    assert pfbench("run", *WALK, home=home).code == 0
    (file,) = (home / "results" / "adhoc").iterdir()
    return file


def test_damaged_results_are_refused(result: Path) -> None:
    counts = trial(result, lambda: tuple(store.read_result(result)), (ValueError,))
    assert counts["other content"] == 0
    assert counts["refused"] > TRIALS / 2


def test_damaged_checkpoints_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "network.pt"
    generator = torch.Generator().manual_seed(1)
    weights = {"a.weight": torch.randn(6, 4, generator=generator), "a.bias": torch.zeros(6)}
    checkpoint.write_checkpoint(path, {"networks": {"proposal": weights}, "losses": [1.0, 0.5]})
    counts = trial(path, lambda: checkpoint.read_checkpoint(path), (ValueError,))
    assert counts["other content"] == 0
    assert counts["refused"] > TRIALS / 2


def test_damaged_episodes_are_built_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    expected = {"x": torch.arange(200.0), "y": torch.ones(3, 2, dtype=torch.float64)}
    builds = []

    def read() -> dict[str, torch.Tensor]:
        return simulated.load_or_build(tmp_path, "recipe", lambda: builds.append(1) or expected)

    read()
    (path,) = tmp_path.glob("*.npz")
    with caplog.at_level(logging.ERROR):
        counts = trial(path, read, ())
    assert counts == {"refused": 0, "equal": TRIALS, "other content": 0}
    assert len(builds) > TRIALS / 2
    assert len(list(tmp_path.glob("*.damaged*"))) == len(builds) - 1


def test_damaged_parts_of_a_study_are_computed_again(tmp_path: Path) -> None:
    path = tmp_path / "study.json"
    ResumableResults(path, {"a": 1})("part", lambda: [1.5, 2.5])
    assert has_valid_digest(json.loads(path.read_text()))

    def read() -> Any:
        return ResumableResults(path, {"a": 1})("part", lambda: [1.5, 2.5])

    assert trial(path, read, ()) == {"refused": 0, "equal": TRIALS, "other content": 0}


def test_a_result_under_the_name_of_another_job_is_not_its_result(result: Path) -> None:
    other = result.with_name("0123456789abcdef.npz")
    shutil.copy(result, other)
    with pytest.raises(
        store.DamagedResultError, match="must be the result of job 0123456789abcdef"
    ):
        store.read_result(other)
    other.unlink()
    (result.parent / "deep").mkdir()
    link = result.parent / "deep" / result.name
    link.symlink_to(result)
    with pytest.raises(store.DamagedResultError, match="must be a file of this folder"):
        store.read_result(link)


def test_a_report_leaves_a_damaged_job_out_and_says_so(tmp_path: Path) -> None:
    assert pfbench("run", "-m", *WALK[:2], "filter=ekf,ckf,ukf", "runs=2", home=tmp_path).code == 0
    folder = tmp_path / "results" / "adhoc"
    file = sorted(folder.glob("*.npz"))[0]
    file.write_bytes(file.read_bytes()[:-50])
    words = (
        "report",
        "study=adhoc",
        f"reports_dir={tmp_path / 'reports'}",
        "report.figure_formats=[svg]",
    )
    assert pfbench(*words, home=tmp_path).code == 0
    page = (tmp_path / "reports" / "adhoc" / "report.md").read_text()
    assert "1 job has no valid result and is missing from all tables" in page.splitlines()[4]
    assert "npz was damaged. Run the job again" in page
    assert file.stem in page
    assert not file.exists()
    assert "are mixed" not in page
    other = min(folder.glob("*.npz"))
    meta, data = store.read_result(other)
    store.write_result(other, {**meta, "versions": {**meta["versions"], "torch": "2.0.0"}}, data)
    assert pfbench(*words, home=tmp_path).code == 0
    said = "Results of torch 2.0.0 and "  # of another version: in the first lines of both pages, and in the state
    pages = [(tmp_path / "reports" / "adhoc" / f).read_text() for f in ("report.md", "index.html")]
    assert all(
        said in text for text in (*pages, pfbench("status", "study=adhoc", home=tmp_path).out)
    )


def test_equal_digests_mean_equal_contents() -> None:
    contents = [
        {}, {"a": 1}, {"a": 1.0}, {"a": "1"}, {"a": True}, {"a": None}, {"b": 1}, {"a": [1]}, {"a": [1, 2]},
        {"a": [[1], 2]}, {"a": np.zeros(2)}, {"a": np.zeros((1, 2))}, {"a": np.zeros(2, np.float32)},
        {"a": np.zeros(2), "b": 1}, {"a": {"b": 1}}, {"a": {"b": {"c": 1}}},
    ]  # fmt: skip
    assert len({hash_content(content) for content in contents}) == len(contents)
    assert hash_content({"a": 1, "b": 2}) == hash_content({"b": 2, "a": 1})
    assert hash_content({"a": torch.zeros(2).double()}) == hash_content({"a": np.zeros(2)})
    assert has_valid_digest({"a": 1, DIGEST: hash_content({"a": 1})})
    assert not has_valid_digest({"a": 1})


def test_files_are_set_aside_under_new_names(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        write_atomically(tmp_path / "a.npz", lambda file: file.write(b"x"))
        names.append(set_aside(tmp_path / "a.npz").name)
    assert names == ["a.npz.damaged", "a.npz.damaged2", "a.npz.damaged3"]
