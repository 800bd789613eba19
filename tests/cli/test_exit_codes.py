"""Exit codes follow from where an error arises: 2 before the work of a command starts, 1 after it."""

import errno
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import synthetic_results as synthetic
from command_line import pfbench

from pfbench import job
from pfbench.cli import list as list_command
from pfbench.files.command_start import has_work_started, reset_work, start_work
from pfbench.results import store

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=2")
# a filter of a user, whose error is of the given type in the constructor or at the fourth measurement
OWN_FILTER = """
import builtins
from pfbench.filter import GaussianFilter
from pfbench.noise import NominalNoise

def make_error(kind):
    return getattr(builtins, kind)("own reason")

class OwnFilter(GaussianFilter):
    def __init__(self, linearisation, place, kind):
        super().__init__(linearisation)
        self.place, self.kind, self.steps = place, kind, 0
        if place == "constructor":
            raise make_error(kind)

    def step(self, *arguments, **settings):
        self.steps += 1
        if self.place == "run" and self.steps == 4:
            raise make_error(self.kind)
        return super().step(*arguments, **settings)

class OwnNoise(NominalNoise):
    def __init__(self, kind):
        super().__init__()
        self.kind = kind

    def draw_errors(self, *arguments, **settings):
        raise make_error(self.kind)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Words that choose the filter of a user."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "own_filters.py").write_text(OWN_FILTER)
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    return ("trust=[own_filters]", "filter=ekf", "filter._target_=own_filters.OwnFilter")


def files(home: Path) -> list[Path]:
    return [file for file in (home / "results").rglob("*") if file.is_file()]


def notes(home: Path) -> list[Any]:
    return [json.loads(file.read_text()) for file in (home / "results").rglob("*.failed.json")]


@pytest.mark.parametrize("kind", ["ValueError", "TypeError", "RuntimeError", "OSError"])
def test_an_error_of_a_users_filter_has_the_code_of_its_place(
    kind: str, own: tuple[str, ...], tmp_path: Path
) -> None:
    """The type of the error does not matter; the same type is on both sides."""
    words = ("run", *WALK, *own, f"+filter.kind={kind}")
    said = pfbench(*words, "+filter.place=run", home=tmp_path)
    assert said.code == 1, said.err
    assert "own reason" in said.err
    assert "plan:" in said.out
    (note,) = notes(tmp_path)
    assert note["message"] == f"{kind}: own reason"
    assert "own_filters.py" in note["traceback"]
    shutil.rmtree(tmp_path / "results")
    said = pfbench(*words, "+filter.place=constructor", home=tmp_path)
    assert said.code == 2, said.err
    assert "own reason" in said.err
    assert "plan:" not in said.out
    assert files(tmp_path) == []


@pytest.mark.parametrize("kind", ["ValueError", "RuntimeError", "KeyError"])
def test_data_that_cannot_be_drawn_are_refused(
    kind: str, own: tuple[str, ...], tmp_path: Path
) -> None:
    words = ("noise._target_=own_filters.OwnNoise", f"+noise.kind={kind}")
    said = pfbench("run", *WALK, own[0], "filter=ekf", *words, home=tmp_path)
    assert said.code == 2, said.err
    assert "own reason" in said.err
    assert files(tmp_path) == []


def test_a_sweep_tries_own_parts_before_its_first_job(own: tuple[str, ...], tmp_path: Path) -> None:
    """An error of the first steps is said once and no job runs; one of a later step is that of its job."""
    for place, ends in {
        "constructor": (2, "", []),
        "run": (1, "1 finished, 0 skipped, 1 failed", [True]),
    }.items():
        own_words = (*own, "+filter.kind=ValueError", f"+filter.place={place},nowhere")
        said = pfbench("run", "-m", *WALK, *own_words, "study=mine", home=tmp_path / place)
        reasons = ["own reason" in note["message"] for note in notes(tmp_path / place)]
        assert (said.code, ends[1] in said.out, reasons) == (ends[0], True, ends[2]), said.err
        assert said.err.count("own reason") == (place == "constructor")


def test_a_result_that_cannot_be_stored_is_a_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, *content: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(store, "write_result", fail)
    said = pfbench("run", *WALK, "filter=ekf", home=tmp_path)
    assert said.code == 1
    assert "got 'No space left on device'. Free space" in said.err


def test_an_input_is_refused_by_any_type_of_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*words: Any) -> None:
        raise NotADirectoryError(20, "Not a directory", "conf")

    monkeypatch.setattr(list_command, "list_groups", fail)
    assert pfbench("list", home=tmp_path).code == 2
    words = ("scenario=recorded_quad_flights", "filter=ekf", "runs=1", "data.root=/nowhere")
    said = pfbench("run", *words, home=tmp_path)
    assert said.code == 2
    assert "data.root must contain the folder quad_rtk_mimu, got /nowhere" in said.err


def test_a_page_is_refused_before_and_fails_after_its_first_file(tmp_path: Path) -> None:
    synthetic.study(tmp_path / "results" / "demo", runs=4, steps=5)
    words = ("report", "study=demo", f"reports_dir={tmp_path}/reports")
    said = pfbench(*words, "report.baseline=ckf", home=tmp_path)
    assert said.code == 2
    assert "report.baseline must be a filter of the study, got ckf" in said.err
    assert not (tmp_path / "reports").exists()
    (tmp_path / "reports").write_text("")
    assert pfbench(*words, home=tmp_path).code == 1


def test_a_refused_paper_leaves_nothing(tmp_path: Path) -> None:
    synthetic.study(tmp_path / "results" / "demo", runs=4, steps=5)
    words = ("paper", "study=demo", "width=60mm", f"reports_dir={tmp_path}/reports")
    said = pfbench(*words, home=tmp_path)
    assert said.code == 2
    assert "must fit" in said.err
    assert not (tmp_path / "reports").exists()


def test_each_command_begins_without_work(tmp_path: Path) -> None:
    """A failure before does not change the code of a refusal in the same process."""
    start_work()
    assert pfbench("run", *WALK, "filter=ekf", "runs=0", home=tmp_path).code == 2
    assert not has_work_started()
    job.run(job.compose([*WALK, "filter=ekf", f"results_dir={tmp_path}"]))
    assert has_work_started()
    reset_work()
    assert not has_work_started()
