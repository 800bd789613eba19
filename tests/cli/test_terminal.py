"""A command goes on without its reader, ends in words at a signal, takes its workers along, and leaves the process as it was."""

import contextlib
import errno
import io
import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from command_line import environment, pfbench, processes_of

from pfbench.cli import list as list_command
from pfbench.cli.main import main
from pfbench.cli.terminal import LastingOutput, SignalStop, stopped_by_signals
from pfbench.files.command_start import reset_work, start_work

WALK = ("scenario=linear_walk", "scenario.steps=5", "runs=2")


class Closed:
    """Stream that fails from the second text on."""

    def __init__(self, number: int) -> None:
        self.number, self.texts = number, list[str]()

    def write(self, text: str) -> int:
        if self.texts:
            raise OSError(self.number, os.strerror(self.number))
        self.texts.append(text)
        return len(text)

    def flush(self) -> None:
        pass

    def fileno(self) -> int:
        raise io.UnsupportedOperation


@pytest.mark.parametrize(("number", "code"), [(errno.EPIPE, 0), (errno.ENOSPC, 1)])
def test_a_job_is_finished_without_a_reader(
    number: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    """Only an output that loses what was asked for is an error at the end."""
    stream: Any = Closed(number)
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    ended = 0
    with contextlib.redirect_stdout(stream):
        try:
            main(["run", *WALK, "filter=ekf"])
        except SystemExit as stop:
            ended = int(stop.code or 0)
    assert ended == code
    assert len(stream.texts) == 1
    assert len(list((tmp_path / "results").rglob("*.npz"))) == 1
    said = capsys.readouterr().err
    assert "note: the output cannot be written any longer" in said
    assert ("error: the output must be writable, got No space left" in said) == (code == 1)
    assert "Logging error" not in said


def test_a_list_that_nobody_reads_on_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    stream: Any = Closed(errno.EPIPE)
    with contextlib.redirect_stdout(stream):
        main(["list", "noise"])
    assert capsys.readouterr().err == ""


def test_an_output_that_works_is_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    reset_work()
    start_work()
    output = LastingOutput(sys.stdout)
    output.write("text")
    output.flush()
    assert output.error is None
    assert not output.isatty()
    assert capsys.readouterr() == ("text", "")


def test_a_process_without_outputs_ends_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    main(["--version"])
    assert sys.stdout is None


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_ends_a_command_in_words(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = int(getattr(signal, name))
    before = signal.signal(number, signal.SIG_DFL)  # Ray leaves a handler of its own

    def stop() -> None:
        os.kill(os.getpid(), number)
        time.sleep(5)  # the handler runs before

    monkeypatch.setattr(list_command, "list_groups", stop)
    try:
        said = pfbench("list", home=tmp_path)
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert said.code == 128 + number
    assert f"Ended by {name}. Finished jobs are kept. Repeat the command to resume." in said.err
    assert "Traceback" not in said.err


def test_a_signal_that_the_program_around_ignores_stays_ignored() -> None:
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signals():
            os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not isinstance(SignalStop(signal.SIGHUP), Exception)  # no handler of errors catches it


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SIGTERM", "SIGKILL"])
def test_the_workers_of_a_sweep_end_with_it(name: str, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = (
        "scenario=linear_walk",
        "scenario.steps=5,30000",
        "runs=50",
        "particles=1000",
        "filter=sir",
    )
    launcher = ("hydra/launcher=cores", "hydra.launcher.n_jobs=2")
    said, end = tmp_path / "said", time.monotonic() + 120
    with said.open("w") as file:
        sweep = subprocess.Popen(
            [sys.executable, "-m", "pfbench", "run", "-m", *words, *launcher],
            env=os.environ | environment(tmp_path), cwd=tmp_path, stdout=file, stderr=file,
        )  # fmt: skip
    while not list((tmp_path / "results").rglob("*.npz")) and time.monotonic() < end:
        time.sleep(0.2)  # until one job is done: the other worker is at the long one
    assert len(processes_of(tmp_path, "loky")) >= 2
    sweep.send_signal(getattr(signal, name))
    code, end = sweep.wait(60), time.monotonic() + 30
    while processes_of(tmp_path, "loky") and time.monotonic() < end:
        time.sleep(0.2)
    assert processes_of(tmp_path, "loky") == []
    if name != "SIGKILL":
        assert code == 128 + getattr(signal, name)
        assert f"Ended by {name}. Finished jobs are kept." in said.read_text()


def test_two_commands_of_a_process_know_nothing_of_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("PFBENCH_TRUST", raising=False)
    before = sys.argv, sys.stdout, sys.stderr, list(logging.getLogger().handlers)
    codes = []
    for words in (
        ("run", *WALK, "filter=ekf", "study=a", "trust=[mylab]"),
        ("run", *WALK, "filter=nobody", "study=b"),
        ("run", *WALK, "filter=ekf", "study=b", "noise._target_=mylab.Noise"),  # trusted by the first alone
        ("run", "-m", *WALK, "filter=ekf,ukf", "study=c"),
        ("run", *WALK, "filter=ekf", "study=2024"),
    ):  # fmt: skip
        try:
            main(words)
            codes.append(0)
        except SystemExit as stop:
            codes.append(int(stop.code or 0))
        assert (sys.argv, sys.stdout, sys.stderr, logging.getLogger().handlers) == before
        assert "PFBENCH_TRUST" not in os.environ
    assert codes == [0, 2, 2, 0, 0]
    assert "add trust=[mylab]" in capsys.readouterr().err
    counts = {p.name: len(list(p.glob("*.npz"))) for p in (tmp_path / "results").iterdir()}
    assert {name: n for name, n in counts.items() if n} == {"a": 1, "c": 2, "2024": 1}
