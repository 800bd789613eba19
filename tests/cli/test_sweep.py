"""A sweep that is killed goes on where it stopped, and ends as if nothing had happened."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import environment, pfbench, process

from pfbench.results import store

pytestmark = pytest.mark.slow

FILTERS = ("sir", "rpf", "apf", "ckf")
# cells of a second, so that a kill after the first result falls into another cell
SWEEP = (
    "run",
    "-m",
    "scenario=linear_walk",
    "scenario.steps=200",
    "runs=20",
    "particles=300",
    f"filter={','.join(FILTERS)}",
)


def files(home: Path) -> list[Path]:
    return sorted((home / "results" / "adhoc").glob("*.npz"))


def arrays(home: Path) -> dict[str, dict[str, np.ndarray]]:
    """The arrays of all cells, by filter."""
    return {found.meta["label"]: found.data for found in map(store.read_result, files(home))}


def same(a: dict[str, dict[str, np.ndarray]], b: dict[str, dict[str, np.ndarray]]) -> bool:
    def equal(x: np.ndarray, y: np.ndarray) -> bool:
        return np.array_equal(x, y, equal_nan=x.dtype.kind == "f")

    return a.keys() == b.keys() and all(
        a[f].keys() == b[f].keys() and all(equal(a[f][n], b[f][n]) for n in a[f]) for f in a
    )


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("undisturbed")
    said = pfbench(*SWEEP, home=home)
    assert said.code == 0, said.err
    return home


def killed_after_the_first_result(home: Path) -> None:
    command = [sys.executable, "-m", "pfbench", *SWEEP]
    env = os.environ | environment(home)
    quiet = subprocess.DEVNULL
    sweep = subprocess.Popen(
        command, env=env, cwd=home, stdout=quiet, stderr=quiet, start_new_session=True
    )
    try:
        while not files(home):
            assert sweep.poll() is None, "the sweep ended without a result"
            time.sleep(0.02)
        time.sleep(0.3)  # well into the second cell
    finally:
        os.killpg(sweep.pid, signal.SIGKILL)
        sweep.wait()


def test_a_killed_sweep_is_finished_by_the_same_command(tmp_path: Path, undisturbed: Path) -> None:
    killed_after_the_first_result(tmp_path)
    finished = {file: file.stat().st_mtime_ns for file in files(tmp_path)}
    assert 1 <= len(finished) < len(FILTERS)
    for file in finished:
        store.read_result(file)  # whole
    again = pfbench(*SWEEP, home=tmp_path)
    assert again.code == 0, again.err
    assert again.out.count("skipped   ") == len(finished)
    assert {file: file.stat().st_mtime_ns for file in finished} == finished
    assert not list((tmp_path / "results").rglob("*.tmp"))
    assert [file.name for file in files(tmp_path)] == [file.name for file in files(undisturbed)]
    assert same(arrays(tmp_path), arrays(undisturbed))

    pages = []
    for home in (tmp_path, undisturbed):
        said = pfbench(
            "report",
            "study=adhoc",
            f"reports_dir={home / 'reports'}",
            "report.figure_formats=[svg]",
            home=home,
        )
        assert said.code == 0, said.err
        pages.append(home / "reports" / "adhoc")
    ours, theirs = ((page / "decisions.csv").read_text() for page in pages)
    assert ours == theirs
    assert len(ours.splitlines()) == 7  # head and all pairs of four filters
    # the computer was not equally busy; all else is the same to the last digit
    left, right = (pd.read_csv(page / "metrics.csv") for page in pages)
    is_time = left["metric"] == "seconds_per_step"
    pd.testing.assert_frame_equal(left[~is_time], right[~is_time], check_exact=True)


def test_a_half_written_file_is_never_taken_for_a_result(tmp_path: Path) -> None:
    """A kill between writing and renaming leaves a temporary file: the cell counts as not done, and its success tidies up."""
    words = ("run", "scenario=linear_walk", "scenario.steps=5", "runs=2", "filter=ckf")
    assert pfbench(*words, home=tmp_path).code == 0
    (file,) = files(tmp_path)
    half = file.with_name(f"{file.stem}.0123abcd.tmp")
    half.write_bytes(file.read_bytes()[:300])
    file.unlink()
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0
    assert "skipped   " not in said.out
    assert store.read_result(file).meta["runs"] == 2
    assert not half.exists()


def test_several_processes_give_the_bits_of_one_and_a_bad_cell_fails_alone(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = (
        *("run", "-m", "scenario=linear_walk", "scenario.steps=30", "runs=4"),
        *("filter=sir", "scenario.steps=0,50,60"),
    )
    several, alone = tmp_path / "several", tmp_path / "alone"
    several.mkdir()
    launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    said = process(*words, *launcher, home=several, cwd=several)
    assert said.code == 1
    assert (
        "failed    linear_walk / nominal / sir   scenario.steps must be a whole number of at least 1"
        in said.out
    )
    assert len(list((several / "results" / "adhoc").glob("*.failed.json"))) == 1
    assert pfbench(*words, home=alone).code == 1
    ours, theirs = (
        {file.name: store.read_result(file).data for file in files(home)}
        for home in (several, alone)
    )
    assert len(ours) == 2
    assert same(ours, theirs)
