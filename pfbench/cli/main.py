"""Entry point of the command line: selects the command and reports errors."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import pfbench
from pfbench.cli.command import list_commands
from pfbench.cli.messages import (
    describe_unknown,
    format_error,
    format_flag,
    keep_trace,
    notes_of,
    suggest_similar,
)
from pfbench.cli.terminal import SignalStop, lasting_outputs, stop_workers, stopped_by_signals
from pfbench.files.command_start import collect_as_usual, has_work_started, reset_work
from pfbench.files.foreign_folder import make_child_environment
from pfbench.job.trust import ENVIRONMENT, split_trust

_ENVIRONMENT = (ENVIRONMENT, "PYTHONSAFEPATH", "PYTHONPATH")
USAGE = """\
pfbench {version}: benchmarks of particle filters in integrated navigation

{commands}

  pfbench COMMAND --help     options and examples of a command
  pfbench --version          version
  --traceback                print the traceback of an error (or set PFBENCH_TRACEBACK=1)

Exit codes: 0 done, 1 failed after work had started, 2 refused before it, 3 warnings of inspect, 128 + number of a signal that ended it (130 interrupted)

First study: pfbench run -m +experiment=quickstart, then pfbench report study=quickstart
Python: import pfbench, then pfbench.run("growth", ["sir", "ekf"]); your own filter: pfbench new filter NAME
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Run the command line."""
    words = list(sys.argv[1:] if argv is None else argv)
    before, arguments = {key: os.environ.get(key) for key in _ENVIRONMENT}, sys.argv
    os.environ.update(make_child_environment())  # of the processes that a launcher starts
    if os.path.exists("matplotlibrc"):  # which matplotlib reads before the settings of the user
        with contextlib.chdir(Path(pfbench.__file__).parent):
            import_module("matplotlib")
    with lasting_outputs() as output, stopped_by_signals():
        try:
            _dispatch(words)
        except (KeyboardInterrupt, SignalStop) as stop:
            number = stop.number if isinstance(stop, SignalStop) else signal.SIGINT
            print(
                f"\nEnded by {signal.Signals(number).name}. Finished jobs are kept. Repeat the command to resume.",
                file=sys.stderr,
            )
            raise SystemExit(128 + number) from None
        finally:
            stop_workers()  # they keep the environment of this command
            # the next command of this process trusts nothing by this one
            for key, value in before.items():
                os.environ.pop(key, None)
                os.environ.update({key: value} if value is not None else {})
            sys.argv = arguments
        output.flush()
        if output.error and not isinstance(output.error, BrokenPipeError):
            reason = f"{output.error.strerror}. Direct it to another file"
            print(f"\nerror: the output must be writable, got {reason}", file=sys.stderr)
            raise SystemExit(1)


def _dispatch(words: Sequence[str]) -> None:
    """Print help or version, or run a command."""
    if not words or words[0] in ("-h", "--help", "help"):
        print(_usage())
        return
    if words[0] == "--version":
        print(f"pfbench {pfbench.__version__}")
        return
    command, options = words[0], words[1:]
    commands = list_commands()
    if command not in commands:
        similar = suggest_similar(command, list(commands))
        print(f"error: command '{command}' does not exist.{similar}\n\n{_usage()}", file=sys.stderr)
        raise SystemExit(2)
    if {"-h", "--help"} & set(options):
        print(commands[command].load().format_help())
        return
    _run_command(command, options)


def _run_command(command: str, options: Sequence[str]) -> None:
    """Run a command and report its errors."""
    shows_traceback = "--traceback" in options or bool(os.environ.get("PFBENCH_TRACEBACK"))
    words = [word for word in options if word != "--traceback"]
    reset_work()
    try:
        loaded = list_commands()[command].load()
        if loaded.keys is None:
            from pfbench.cli.list import add_search_path  # which imports numpy

            words = add_search_path(words)
        flag = next((w for w in words if w.startswith("--") and w != "--multirun"), None)
        if flag and command != "run":  # which has the flags of Hydra
            raise ValueError(format_flag(words, flag, command))
        words, packages = split_trust(words)
        os.environ[ENVIRONMENT] = ",".join(
            packages
        )  # for all parts, and the processes of a launcher
        loaded(words)
    except Exception as error:
        if shows_traceback:
            raise
        _report(command, words, error)
        raise SystemExit(1 if has_work_started() else 2) from error
    finally:
        collect_as_usual()


def _report(command: str, words: Sequence[str], error: Exception) -> None:
    """Print the sentence of an error, its notes, and where its trace is."""
    message, notes = format_error(error, words), notes_of(error)
    print(f"\nerror {command}: {message}", file=sys.stderr)
    is_unknown = message.startswith(describe_unknown(error))
    if is_unknown and not any(note.startswith("traceback: ") for note in notes):
        trace = keep_trace(error, [command, *words])
        notes += [f"traceback: {trace}"] if trace else []
    for note in notes:
        print(note, file=sys.stderr)
    print("(add --traceback to see the traceback)", file=sys.stderr)


def _usage() -> str:
    """Format the overview of all commands."""
    lines = (f"  pfbench {name:10} {file.summary}" for name, file in list_commands().items())
    return USAGE.format(version=pfbench.__version__, commands="\n".join(lines)).rstrip()
