"""Every error is a sentence: what must be, what was got, what to do; of an error that nobody foresaw, where its trace is."""

import errno
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_results as synthetic
import torch
from command_line import Said, pfbench

from pfbench.cli import list as list_command
from pfbench.cli.messages import describe_unknown, format_error, is_named
from pfbench.job.trust import check_study
from pfbench.results.conditions import parse_label
from pfbench.stats.study_runs import natural_sort_key

SENTENCE = re.compile(r"error (\w+): \S.* (must|is not|does not|exists already)\b.*[^\s:]$")
DEMO = ("study=demo", "report.figure_formats=[svg]")
REPLAY = ("replay", "study=demo", "run=0", "filter=ekf")
# command lines of all commands, and a part of the sentence
MISTAKES: dict[tuple[str, ...], str] = {
    ("report", *DEMO, "report.alpha=[]"): "report.alpha must be a number between 0 and 1, got ()",
    ("report", *DEMO, "report.alpha=nan"): "report.alpha must be a number between 0 and 1, got nan",
    ("report", *DEMO, "report.metric=5"): "report.metric must be a name, got 5",
    ("report", *DEMO, "report.figure_formats=null"): "report.figure_formats must be a list of names",
    ("report", *DEMO, "report.figure_formats=[[svg]]"): "report.figure_formats must be a list of names",
    ("report", *DEMO, "report.start_time_s=x"): "report.start_time_s must be a number, got 'x'",
    ("report", *DEMO, "report.baseline=[]"): "report.baseline must be the label of a filter, got ()",
    ("report", *DEMO, "report.convergence_threshold=5"): "report.convergence_threshold must be numbers by group",
    ("report", *DEMO, "report.equivalence_margin=null"): "report.equivalence_margin must be a positive number, got None",
    ("report", *DEMO, "report.allow_mixed_versions=maybe"): "report.allow_mixed_versions must be true or false",
    ("report", "study=demo", "~report"): "report must have keys of alpha,",
    ("report", *DEMO, "+report.nope=1"): "report must have keys of alpha,",
    ("report", *DEMO, "reports_dir=null"): "reports_dir must be a folder, got None",
    ("report", *DEMO, "reports_dir=/dev/full"): "must be accessible, got 'Not a directory'. Set a folder",
    ("report", "study=[a]"): "study must be a name of letters",
    ("report", "study={a"): "each word must be key=value",
    ("paper", "study=demo", "journal=ieee", "report.alpha=x"): "report.alpha must be a number between 0 and 1, got 'x'",
    (*REPLAY[:2], "run=²", "filter=ekf"): "run must be a whole number of at least 0, got '²'",
    (*REPLAY, "results_dir=[]"): "results_dir must be a folder, got []",
    (*REPLAY, "noise="): "words must be key=value, each key once, got noise=",
    ("cost", "study=demo", "overwrite=maybe"): "overwrite must be true or false, got maybe",
    ("cost", "study=demo", "rounds=²"): "rounds must be a whole number in [5, 1000], got '²'",
    ("claims", "results_dir=null"): "results_dir must be a folder, got None",
    ("datasheet", "scenario="): "scenario= does not exist",
    ("list", "filter", "more"): "words must be pfbench list filter, got more",
    ("list", ""): "got an empty word",
    ("check", "more"): "check must be without words, got more",
    ("judge", "reference=/etc", "mine=/etc"): "/etc must be a file, got none",
    ("judge", "reference=a.csv", "mine=b.csv", "tolerance=inf"): "tolerance must be positive and finite, got inf",
    ("judge", "reference=a.csv", "mine=b.csv", "margin=1e-300"): "margin must be in [1e-6, 1e6]",
    ("judge", "reference=a.csv", "mine=b.csv", "study=claims"): "study must not be claims or datasheets",
    ("train", "filter=nobody"): "filter=nobody does not exist",
}  # fmt: skip


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mistakes")
    synthetic.study(folder / "results" / "demo", runs=4, steps=5)
    return folder


@pytest.fixture(autouse=True)
def traces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the traces."""
    folder = tmp_path / "traces"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def sentence(said: Said) -> str:
    """The one line of an error."""
    (line,) = [text for text in said.err.splitlines() if text.startswith("error ")]
    assert "Traceback" not in said.err
    assert SENTENCE.match(line), line
    return line


@pytest.mark.parametrize("words", MISTAKES, ids=" ".join)
def test_a_mistake_is_a_sentence_that_pfbench_wrote(
    words: tuple[str, ...],
    home: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    traces: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench(*words, home=home)
    assert said.code in (1, 2)
    assert MISTAKES[words] in sentence(said)
    assert not list(traces.iterdir())  # nothing that nobody foresaw


def test_only_what_pfbench_raises_itself_counts_as_a_sentence() -> None:
    def error_of(call: Any, *arguments: Any) -> BaseException:
        try:
            call(*arguments)
        except Exception as error:
            return error
        raise AssertionError

    assert is_named(error_of(check_study, []))
    assert is_named(ValueError("of another process"))
    for call, argument in ((parse_label, 3), (natural_sort_key, 3), (int, "x"), (torch.zeros(2).reshape, 3), (np.zeros, -1)):  # fmt: skip
        assert not is_named(error_of(call, argument))
    text = describe_unknown(error_of(natural_sort_key, 3))
    assert text.startswith("comparing the filters must succeed, got TypeError: expected string or")
    assert text.endswith(" and a class of your own by pfbench check.")


def test_the_trace_of_an_unforeseen_error_is_kept_in_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, traces: Path
) -> None:
    def fail() -> None:
        raise KeyError("own\nreason")

    monkeypatch.setattr(list_command, "list_groups", fail)
    said = pfbench("list", "noise", home=tmp_path)
    assert said.code == 2
    assert "running the command must succeed, got KeyError: " in sentence(said)
    (file,) = traces.iterdir()
    assert f"\ntraceback: {file}\n" in said.err
    kept = file.read_text()
    assert kept.startswith("pfbench list noise\n\nTraceback")
    assert "in fail" in kept

    def refuse(*words: Any, **more: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refuse)
    said = pfbench("list", "noise", home=tmp_path)
    assert "got KeyError" in sentence(said)
    assert "traceback: " not in said.err


def test_an_unforeseen_error_of_a_job_has_its_trace_in_the_note_of_the_job(
    tmp_path: Path, traces: Path
) -> None:
    words = (
        "scenario=linear_walk",
        "scenario.steps=5",
        "runs=2",
        "filter=sir",
        "filter.resampler=null",
    )
    with pytest.warns(UserWarning, match="must state whether it is asymptotically exact"):
        said = pfbench("run", *words, home=tmp_path)
    assert said.code == 1
    assert "running the filter must succeed, got TypeError: 'NoneType' object is not callable" in sentence(said)  # fmt: skip
    assert said.err.count("traceback: ") == 1
    assert ".failed.json" in said.err
    assert not list(traces.iterdir())


def test_memory_and_files_have_sentences_of_their_own() -> None:
    assert format_error(MemoryError()).startswith("memory must be enough for the command, got")
    for number in (errno.ENOENT, errno.EEXIST, errno.ELOOP, errno.EIO):
        text = format_error(OSError(number, "own reason", "file.csv"))
        assert text.startswith("file.csv must be accessible, got 'own reason'. ")
