"""Entry point of the command line: selects the command and reports errors."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import pfbench
from pfbench.cli.current_folder import add_search_path
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

# command: function of the module of the same name, summary
COMMANDS = {
    "run": ("run_jobs", "run one job, or a sweep with -m"),
    "report": ("report_study", "write the report of a study: figures, tables and tests"),
    "compare": ("compare_study", "compare an own study with a published one in the same runs"),
    "cost": ("measure_cost", "measure the time per step of the filters of a study in turn"),
    "paper": ("write_study_paper", "write figures, tables and text of a study for a journal"),
    "claims": ("report_claims", "write the page of the papers' claims and verdicts"),
    "datasheet": ("report_scenario", "write the datasheet of a scenario"),
    "replay": ("replay_run", "compute one stored run again, with all its traces"),
    "import": ("import_log", "write the tables of an own log from files of other programs"),
    "inspect": ("inspect_folder", "name the faults of an own log, and the settings that mend them"),
    "estimate": ("estimate_log", "estimate the track of an own log without a reference"),
    "judge": ("judge_trajectories", "compare trajectories of other programs with a reference"),
    "tune": ("tune_filters", "tune the baselines of a study of robustness alike"),
    "train": ("train_network", "train the network of a neural_* filter or of kalman_net"),
    "infer": ("infer_parameters", "infer parameters of a model by NUTS, SVI, PMMH or SMC2"),
    "data": ("list_data", "list the recorded data sets, and check a folder of them"),
    "status": ("report_status", "print what is finished, failed and running, and the time left"),
    "open": (
        "open_report",
        "show the report of a study in a browser, and write it if it is missing",
    ),
    "new": (
        "write_script",
        "write a script of your own filter, proposal, model, scenario, noise regime or log",
    ),
    "list": ("list_options", "list what a configuration can choose"),
    "check": ("check_installation", "compose all configurations and print versions"),
    "completion": ("print_completion", "print the completion of words for a shell"),
}
_OF_LOGS = ("data", "estimate", "import", "inspect", "judge")  # in pfbench/logs/cli
_COMPOSING = (
    "run",
    "tune",
    "train",
    "infer",
    "datasheet",
    "list",
)  # that may choose files of the current folder
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
    if command not in COMMANDS:
        similar = suggest_similar(command, list(COMMANDS))
        print(f"error: command '{command}' does not exist.{similar}\n\n{_usage()}", file=sys.stderr)
        raise SystemExit(2)
    if {"-h", "--help"} & set(options):
        print(open_module(command).HELP)
        return
    _run_command(command, options)


def open_module(command: str) -> Any:
    """Import the module of a command; `import` is a word of Python and no name of a module."""
    folder = "logs.cli" if command in _OF_LOGS else "cli"
    return import_module(f"pfbench.{folder}.{'own_files' if command == 'import' else command}")


def _run_command(command: str, options: Sequence[str]) -> None:
    """Run a command and report its errors."""
    shows_traceback = "--traceback" in options or bool(os.environ.get("PFBENCH_TRACEBACK"))
    words = [word for word in options if word != "--traceback"]
    reset_work()
    try:
        if command in _COMPOSING:
            words = add_search_path(words)
        flag = next((w for w in words if w.startswith("--") and w != "--multirun"), None)
        if flag and command != "run":  # which has the flags of Hydra
            raise ValueError(format_flag(words, flag, command))
        words, packages = split_trust(words)
        os.environ[ENVIRONMENT] = ",".join(
            packages
        )  # for all parts, and the processes of a launcher
        getattr(open_module(command), COMMANDS[command][0])(words)
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
    lines = (f"  pfbench {name:10} {summary}" for name, (_, summary) in COMMANDS.items())
    return USAGE.format(version=pfbench.__version__, commands="\n".join(lines)).rstrip()
