"""`pfbench ...` without a new process, whose start costs seconds; and with one, where that is the point."""

import contextlib
import io
import logging
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from hydra._internal.hydra import Hydra

from pfbench import cli

GONE = (ProcessLookupError, FileNotFoundError, PermissionError)


class Said(NamedTuple):
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


def pfbench(*words: object, home: Path) -> Said:
    """The command line in this process; results and worlds below `home`, no recorded data.

    Hydra composes everything once more, only to ask whether `hydra.mode` is set, which nothing here does: a third of a small
    job's time.
    """
    out, err, root = io.StringIO(), io.StringIO(), logging.getLogger()
    handlers, level, code = list(root.handlers), root.level, 0
    with (
        mock.patch.dict(os.environ, environment(home)),
        mock.patch.object(sys, "argv", ["pfbench"]),
        mock.patch.object(Hydra, "get_mode", return_value=None),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        os.environ.pop("PFBENCH_DATA", None)
        try:
            cli.main([str(word) for word in words])
        except SystemExit as stop:
            code = int(stop.code or 0)
        finally:
            root.handlers[:], root.level = (
                handlers,
                level,
            )  # Hydra's point at streams that close now
    return Said(code, out.getvalue(), err.getvalue())


def block(code: str, home: Path) -> None:
    """A page's block of commands, in this process; each line is one."""
    for line in filter(None, code.splitlines()):
        name, *words = shlex.split(line)
        said = pfbench(*words, home=home)
        assert (name, said.code) == ("pfbench", 0), line + said.err


def process(*words: object, home: Path, cwd: Path, **more: str) -> Said:
    """`python -m pfbench ...` in a folder of its own."""
    env = (
        {name: value for name, value in os.environ.items() if name != "PFBENCH_DATA"}
        | environment(home)
        | more
    )
    command = [sys.executable, "-m", "pfbench", *map(str, words)]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, env=env, check=False, timeout=600
    )
    return Said(done.returncode, done.stdout, done.stderr)


def environment(home: Path) -> dict[str, str]:
    return {"PFBENCH_RESULTS": str(home / "results"), "PFBENCH_EPISODES": str(home / "worlds")}


def processes_of(home: Path, doing: str) -> list[int]:
    """Processes that belong to the sweep of this home, by what they say of themselves."""
    found, mark = [], f"PFBENCH_RESULTS={home / 'results'}".encode()
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(*GONE):
            own = entry.name.isdigit() and int(entry.name) != os.getpid()
            if (
                own
                and mark in (entry / "environ").read_bytes().split(b"\0")
                and doing in (entry / "cmdline").read_text()
            ):
                found.append(int(entry.name))
    return found


def run_git(folder: Path, *words: str) -> str:
    """Git in a folder, with an author."""
    names = ("-c", "user.name=a", "-c", "user.email=a@b")
    command = ["git", "-C", str(folder), *names, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def plant_programs(folder: Path) -> Path:
    """Let a monitor and a filter of the repository of a folder run a program when git looks at its files.

    Returns the file that the program leaves.
    """
    run_git(folder, "add", ".")
    run_git(folder, "commit", "--allow-empty", "-qm", "theirs")
    ran, program = folder / ".git" / "ran", folder / ".git" / "program"
    program.write_text(f"#!/bin/sh\ntouch {ran}\ncat\n")
    program.chmod(0o755)
    (folder / ".gitattributes").write_text("* filter=x diff=x\n")
    for key in ("core.fsmonitor", "filter.x.clean", "diff.x.textconv", "diff.external"):
        run_git(folder, "config", key, str(program))
    for file in folder.glob("*.*"):
        if file.is_file():
            os.utime(file, (0, 0))
    return ran
