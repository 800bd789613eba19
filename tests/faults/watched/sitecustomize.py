"""Audit hook of the harness: each Python process with FAULTS_WATCH records what it opens, imports and starts undeclared.

The harness puts this folder on PYTHONPATH, so that processes that a command starts are watched too.
"""

import json
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

VARIABLE = "FAULTS_WATCH"
# beside Python itself: compilers of the operators, questions about the machine, and the browser of the harness
PROGRAMS = ("python", "c++", "g++", "gcc", "cc", "ld", "ldconfig", "lscpu", "uname", "fc-list", "pdflatex", "pgrep", "true")  # fmt: skip
# this machine, and the address at which Ray asks whether it runs in a cloud
LOCAL = ("127.0.0.1", "::1", "localhost", "169.254.169.254")
SYSTEM = ("/proc", "/sys", "/dev", "/etc", "/usr", "/lib", "/lib64", "/bin", "/opt", "/run")


def make_hook(home: str, declared: list[str], report: Callable[[str], Any]) -> Any:
    """Return the hook, which calls `report` with a line for each undeclared event.

    Args:
        home: Folder of a stranger. Of its files those below `declared` may be read.
        declared: Files and folders; those outside of `home` too.
        report: Receives kind and path, `open /home/secret`.
    """
    own = (*SYSTEM, sys.prefix, sys.base_prefix, *declared)

    def is_below(path: str, folders: tuple[str, ...]) -> bool:
        return any(path == folder or path.startswith(f"{folder}/") for folder in folders)

    def is_foreign(name: Any) -> bool:
        if isinstance(name, int) or not name:
            return False
        path = os.path.realpath(os.fsdecode(name))
        is_temporary = is_below(path, ("/tmp", "/var/tmp")) and not is_below(path, (home,))
        return os.path.isfile(path) and not is_temporary and not is_below(path, own)

    def list_programs(event: str, args: Any) -> Iterator[str]:
        words = args[0] if event == "os.system" else args[1]
        words = [os.fsdecode(w) for w in ([words] if isinstance(words, str | bytes) else words)]
        program = os.path.basename(words[0])
        place = args[2] if event == "subprocess.Popen" and args[2] else os.getcwd()
        folders = [words[i + 1] for i, word in enumerate(words[:-1]) if word == "-C"] or [place]
        is_known = program.startswith(PROGRAMS) or is_below(words[0], (sys.prefix,))
        if program == "git":
            is_known = not is_below(os.path.realpath(os.fsdecode(folders[0])), (home,))
        if not is_known or is_foreign(words[0]):
            yield f"program {' '.join(words)}"

    def hook(event: str, args: Any) -> None:
        if event == "open" and not (args[2] or 0) & (os.O_WRONLY | os.O_DIRECTORY):
            if is_foreign(args[0]):
                report(f"open {os.fsdecode(args[0])}")
        elif event == "exec" and not args[0].co_filename.startswith("<"):
            if is_foreign(args[0].co_filename):
                report(f"import {args[0].co_filename}")
        elif event in ("import", "ctypes.dlopen"):
            if is_foreign(name := args[0 if event == "ctypes.dlopen" else 1]):
                report(f"import {name}")
        elif event in ("subprocess.Popen", "os.posix_spawn", "os.exec", "os.system", "os.spawn"):
            for line in list_programs(event, args):
                report(line)
        elif event == "socket.connect" and isinstance(args[1], tuple) and args[1][0] not in LOCAL:
            report(f"connect {args[1][0]}")

    return hook


def install() -> None:
    """Watch this process as the environment says, if it does."""
    if text := os.environ.get(VARIABLE):
        settings = json.loads(text)
        log = os.open(settings["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        found = set[str]()

        def report(line: str) -> None:
            if line not in found:
                found.add(line)
                os.write(log, f"{line!r}\n".encode(errors="replace"))

        sys.addaudithook(make_hook(settings["home"], settings["declared"], report))


install()
