"""Whole commands in a stranger's folder open, import and start nothing undeclared, and a door that is opened is seen."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from faults import commands
from faults.tally import FINE
from pfbench.kernels.cpp_library import is_library_loaded


@pytest.fixture(autouse=True)
def loaded() -> None:
    """The operators are loaded before the processes that the tests fork."""
    is_library_loaded()
    commands.template()


@pytest.mark.parametrize("command", ["run", "report", "replay", "judge"])
def test_a_command_opens_and_starts_nothing_undeclared(command: str) -> None:
    outcome, _, example = commands.attempt(command, 1)
    assert outcome == FINE, example


@pytest.mark.slow
@pytest.mark.parametrize("command", commands.COMMANDS)
def test_a_new_process_of_each_command_is_watched_with_its_children(command: str) -> None:
    outcome, _, example = commands.attempt(command, 2, in_process=False)
    assert outcome == FINE, example


def ask_git() -> None:
    subprocess.run(["git", "-C", "reports", "ls-files"], capture_output=True)


def read_secret() -> None:
    Path("../outside/secret.csv").read_text()


def read_settings() -> None:
    Path("matplotlibrc").read_text()


def run_module() -> None:
    exec(compile(Path("json.py").read_text(), "json.py", "exec"))


def start_python() -> None:
    # without the switch that a command gives to its children
    subprocess.run(
        [commands.sys.executable, "-c", "import mylab"],
        env={**os.environ, "PYTHONSAFEPATH": ""},
        check=True,
    )


def run_shell() -> None:
    os.system("id")


DOORS: dict[Callable[[], object], str] = {
    ask_git: "code run", read_secret: "false", read_settings: "false", run_module: "code run", start_python: "code run",
    run_shell: "code run",
}  # fmt: skip


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_an_opened_door_is_seen(
    door: Callable[[], object], monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_door(words: list[str]) -> None:
        door()
        raise ValueError("the door must end the command here.")

    def plant_all(command: str, home: commands.Home, rng: object) -> None:
        commands.plant_settings(home, commands.random.Random(1))
        for name in ("json", "mylab"):
            home.write(f"{name}.py", f"open({str(home.marks / name)!r}, 'w').close()\n")

    monkeypatch.setattr(commands, "prepare", plant_all)
    monkeypatch.setattr("pfbench.cli.run.check_words", open_door)
    outcome, _, example = commands.attempt("run", 1)
    assert outcome == DOORS[door], example
